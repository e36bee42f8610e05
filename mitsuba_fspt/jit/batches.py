"""Batches: work divided into kernels that are large enough to be efficient and small enough to bound the memory."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

BATCH = 1 << 22  # most lines of sight in one kernel, which bounds the memory for images of any size


def batches(index: mi.UInt32, lines_each: int = 1, most: int = BATCH) -> list[mi.UInt32]:
    """Parts of the array `index`, each with at most `most` lines of sight, if an entry has `lines_each` of them."""
    size, count = max(1, most // lines_each), dr.width(index)
    if count <= size:
        return [index] if count else []
    starts = range(0, count, size)
    return [
        dr.gather(mi.UInt32, index, dr.arange(mi.UInt32, min(size, count - k)) + dr.opaque(mi.UInt32, k))
        for k in starts
    ]


def batch_slices(lines: NDArray[np.int64], most: int = BATCH) -> Iterator[slice]:
    """Slices of consecutive items with at most `most` lines of sight together, or of a single item with more.

    `lines`, shape (n,): number of lines of sight of each item.
    """
    ends = np.cumsum(lines)
    first = 0
    while first < len(lines):
        done = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, done + most, side="right")))
        yield slice(first, last)
        first = last


def numbered(lines: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each line of sight the item that it belongs to and its number in that item, both of shape (Σ lines,).

    lines : number of lines of sight of each item
    """
    item = np.repeat(np.arange(len(lines)), lines)
    return item, np.arange(len(item)) - np.repeat(np.cumsum(lines) - lines, lines)
