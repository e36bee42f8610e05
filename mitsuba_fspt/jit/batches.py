"""How much is computed at once: kernels so wide that they pay, whatever the size of the picture."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

LANES = 1 << 22  # lines of sight in flight: bounds the memory, not the picture


def chunks(index: mi.UInt32, lanes_each: int = 1) -> list[mi.UInt32]:
    """The listed numbers, in runs that take at most `LANES` lanes, so many each."""
    size, count = max(1, LANES // lanes_each), dr.width(index)
    if count <= size:
        return [index] if count else []
    starts = range(0, count, size)
    return [
        dr.gather(mi.UInt32, index, dr.arange(mi.UInt32, min(size, count - k)) + dr.opaque(mi.UInt32, k))
        for k in starts
    ]


def runs(lanes: NDArray[np.int64]) -> Iterator[slice]:
    """Runs of neighbours that take at most `LANES` lanes together, of so many `lanes` each; at least one a run."""
    ends = np.cumsum(lanes)
    first = 0
    while first < len(lanes):
        done = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, done + LANES, side="right")))
        yield slice(first, last)
        first = last


def numbered(lanes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of every lane which item it is for, and its number among that item's, where item k takes `lanes[k]` of them."""
    item = np.repeat(np.arange(len(lanes)), lanes)
    return item, np.arange(len(item)) - np.repeat(np.cumsum(lanes) - lanes, lanes)
