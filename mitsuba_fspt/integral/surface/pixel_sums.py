"""Sums of whole numbers on pixels, to which all threads of a kernel add at once.

Light that is laid on pixels by small polygons (Eq. M.9, M.20) takes most of its time to add to memory: 15 ns for four
numbers by atomic additions, 2.5 ns in one operation to a thread's own copy of the sums. The copies are added up when
they are evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

PACKET = 4  # numbers of a pixel, added in one operation
BYTES = 8 * PACKET  # of a pixel
LEAST = 1 << 12  # pixels for which there is room at least
# Bytes that the copies of all threads take at the most; Dr.Jit keeps those of the kernel before, too.
COPIES = 1 << 29
# A pixel is cleared and added up in 4 ns a number and copy, a polygon is laid 250 ns sooner: copies of `SMALL` pixels
# take 4 ms, others are made where there is a polygon for so many pixels of all copies.
SMALL, PIXELS_PER_POLYGON = 1 << 18, 16


class PixelSums:
    """`PACKET` sums, 0 at first, of each of so many `pixels`."""

    def __init__(self, pixels: int) -> None:
        self.pixels = pixels
        self._sums = dr.zeros(mi.UInt64, room(pixels) * PACKET)

    def mode(self, polygons: int) -> dr.ReduceMode:
        """How a kernel that lays so many polygons adds: directly, or to copies where these are worth their time."""
        copied = room(self.pixels) * dr.thread_count()
        worth = copied <= max(SMALL, PIXELS_PER_POLYGON * polygons)
        alone = dr.backend_v(self._sums) == dr.JitBackend.LLVM and copied * BYTES <= COPIES
        return dr.ReduceMode.Expand if alone and worth else dr.ReduceMode.Direct

    def add(self, pixel: mi.UInt32, amounts: Sequence[mi.Int64], active: mi.Bool, mode: dr.ReduceMode) -> None:
        """Add up to `PACKET` amounts to the sums of a pixel."""
        packet = dr.zeros(dr.uint64_array_t(mi.Vector4f))
        for k, amount in enumerate(amounts):
            packet[k] = mi.UInt64(amount)  # unsigned, because that wraps around below zero and every backend can add it
        dr.scatter_add(self._sums, packet, pixel, active, mode=mode)

    def evaluate(self, *others: object) -> None:
        """Run the kernels that add, with those that compute `others`, as a later one would trace every ray again."""
        dr.eval(self._sums, *others)

    def array(self) -> NDArray[np.int64]:
        """The sums so far, (pixels, `PACKET`)."""
        return mi.Int64(self._sums).numpy()[: self.pixels * PACKET].reshape(self.pixels, PACKET)


def room(pixels: int) -> int:
    """Pixels that memory is taken for: 5 to 8 times a power of two, at most a quarter more than there are.

    A kernel that adds to copies is one for each size, so that there should be few.
    """
    step = max(1 << (pixels - 1).bit_length() - 3, 1) if pixels > LEAST else LEAST
    return max(-(-pixels // step), 1) * step


def most_pixels() -> int:
    """Pixels, a power of two, up to which all threads have copies."""
    return 1 << (COPIES // (BYTES * dr.thread_count())).bit_length() - 1


def memory_of(pixels: int) -> int:
    """Bytes that sums of up to so many pixels and their copies take at the most."""
    whole = room(pixels) * BYTES
    return whole + 2 * min(whole * dr.thread_count(), COPIES)
