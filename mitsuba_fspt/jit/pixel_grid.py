"""Operations on the neighbourhoods of pixels as kernels: dilation, maxima, sums and gradients."""

from __future__ import annotations

import itertools
import math
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .from_numpy import from_numpy

if TYPE_CHECKING:
    PixelArray = mi.Float64  # h · w entries, row by row; masks likewise
    Mask = mi.Bool

COVERAGE_ROUNDING = 1e-4  # rounding error of a coverage, which is a sum of float32 weights
AROUND = [(dx, dy) for dx, dy in itertools.product((-1, 0, 1), repeat=2) if (dx, dy) != (0, 0)]
BLOCK = 4  # side of the squares of pixels that are processed together; each holds one pixel of the lattice of probes


class Grid:
    """Pixels of an image of `shape` (h, w), at least one; values on them are an array of h · w entries, row by row.

    Kernels receive sizes and radii as data, so that images of all shapes use the same compiled kernels.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.number = dr.arange(mi.UInt32, math.prod(shape))
        self._height, self._width = (dr.opaque(mi.Int, side) for side in shape)
        self.y = mi.Int(self.number) // self._width
        self.x = mi.Int(self.number) - self.y * self._width
        self._around = {(dx, dy): self._index(self.x + dx, self.y + dy) for dx, dy in AROUND}
        dr.eval(self.number, self.x, self.y)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def place(self, number: mi.UInt32) -> mi.UInt32:
        """Numbers in the whole image of these pixels of the grid, which are the same."""
        return number

    def border(self) -> Mask:
        """True on pixels with a neighbour that is not in the grid: on none."""
        return mi.Bool(False)

    def pixels(self, mask: Mask | None = None) -> mi.UInt32:
        """Numbers of all pixels or of the marked ones, in an order that keeps squares of sixteen together."""
        if mask is None:
            return self._by_squares
        return dr.gather(mi.UInt32, self._by_squares, dr.compress(dr.gather(mi.Bool, mask, self._by_squares)))

    @cached_property
    def _by_squares(self) -> mi.UInt32:
        """Numbers of all pixels, sorted by bands of `BLOCK` rows and by columns within a band."""
        number, full = mi.Int(self.number), BLOCK * self._width
        band = number // full
        # At least 1: kernels are also evaluated for some entries beyond the last pixel and must not divide by zero.
        position, rows = number - band * full, dr.clip(self._height - BLOCK * band, 1, BLOCK)
        column = position // rows
        ordered = mi.UInt32((BLOCK * band + position - column * rows) * self._width + column)
        dr.eval(ordered)
        return ordered

    def full(self, kind: type, value: Any) -> Any:
        """Image with the same value on every pixel."""
        return dr.full(kind, value, len(self))

    def flat(self, array: NDArray[Any]) -> Any:
        """Image or mask from an array (h, w)."""
        return from_numpy(mi.Bool if array.dtype == bool else mi.Float64, array)

    def array(self, image: Any) -> NDArray[Any]:
        """Array (h, w) of an image or mask."""
        return np.asarray(image.numpy()).reshape(self.shape)

    def lay(self, image: Any, array: NDArray[Any]) -> None:
        """Write values on the grid into an array (h, w) of the whole image."""
        array[:] = self.array(image)

    # ------------------------------------------------------------------ neighbours

    def at(self, image: Any, x: mi.Int, y: mi.Int) -> Any:
        """Values of an image at pixels (x, y); outside the grid that of the nearest pixel."""
        return dr.gather(type(image), image, self._index(x, y))

    def _index(self, x: mi.Int, y: mi.Int) -> mi.UInt32:
        """Numbers of the pixels (x, y), clamped to the grid."""
        return mi.UInt32(dr.clip(y, 0, self._height - 1) * self._width + dr.clip(x, 0, self._width - 1))

    def _neighbours(self, image: Any, step: int = 1) -> dict[tuple[int, int], Any]:
        """Values of the eight pixels `step` pixels away, by direction (dx, dy)."""
        if step == 1:
            return {way: dr.gather(type(image), image, index) for way, index in self._around.items()}
        k = dr.opaque(mi.Int, step)
        return {(dx, dy): self.at(image, self.x + dx * k, self.y + dy * k) for dx, dy in AROUND}

    def spread_max(self, image: Any, radius: int = 1) -> Any:
        """Largest value within `radius` pixels (square) of each pixel."""
        return self.spread_all((image,), radius)[0]

    def spread_all(self, images: tuple, radius: int = 1) -> tuple:
        """`spread_max` of several images in the same kernels."""
        reach, most = 0, min(radius, max(self.shape) - 1)
        while reach < most:
            step = min(2 * reach + 1, most - reach)  # a larger step would leave gaps
            dr.eval(images)  # together: gathers would evaluate each one alone
            images = tuple(reduce(_larger, self._neighbours(image, step).values(), image) for image in images)
            dr.eval(images)  # one kernel for all radii; as part of a larger kernel it would be compiled anew
            reach += step
        return images

    def dilate(self, mask: Mask, radius: int) -> Mask:
        """True within `radius` pixels (square) of a marked pixel."""
        return self.spread_max(mask, radius)

    def grow(self, mask: Mask, reach: mi.Int, most: int) -> Mask:
        """True within `reach` <= `most` pixels (square) of a marked pixel; each has its own `reach`, at least 1."""
        left = dr.select(mask, dr.maximum(reach, 1), -1)
        covered, step = 0, 1
        while covered < max(most, 1):
            left = self._reached(left, step)
            covered += 2 * step
            step *= 2
        return left >= 0

    def _reached(self, left: mi.Int, step: int) -> mi.Int:
        """Largest reach that remains at each pixel of the `left` reach of pixels up to two steps of `step` pixels away.

        Calls with steps of 1, 2, 4 … one after the other connect any two pixels by a shortest path.
        """
        k = dr.opaque(mi.Int, step)
        dr.eval(left)

        def row(j: mi.Int, most: mi.Int) -> tuple:
            for i in range(-2, 3):
                there = self.at(left, self.x + i * k, self.y + j * k)
                most = dr.maximum(most, there - k * dr.maximum(dr.abs(j), abs(i)))
            return j + 1, most

        _, most = dr.while_loop((mi.Int(-2), left), lambda j, most: j <= 2, row)
        return most

    def box_sum(self, image: PixelArray, radius: int) -> PixelArray:
        """Sum over the (2 radius + 1)² pixels around each, fewer at the border, at a cost independent of the radius."""
        reach = dr.opaque(mi.Int, radius)
        rows = _sliding_sum(image, self.y * self._width, self.x, self._width, reach)
        number = mi.Int(self.number)
        column = number // self._height
        turned = dr.gather(mi.Float64, rows, mi.UInt32((number - column * self._height) * self._width + column))
        return _sliding_sum(turned, self.x * self._height, self.y, self._height, reach)

    def mean_where(self, image: PixelArray, mask: Mask, radius: int) -> PixelArray:
        """Mean over the marked pixels among the (2 radius + 1)² around each pixel; 0 if there is none."""
        sums = dr.select(mask, image, 0), dr.select(mask, mi.Float64(1), 0)
        for dx, dy in ((1, 0), (0, 1)):
            dr.eval(sums)
            near = [self._beside(sums, k * dx, k * dy) for k in range(-radius, radius + 1)]
            sums = tuple(sum(column) for column in zip(*near, strict=True))
        total, count = sums
        mean = dr.select(count > 0, total / count, 0)
        dr.eval(mean)
        return mean

    def _beside(self, images: tuple[PixelArray, ...], dx: int, dy: int) -> list[PixelArray]:
        """Values at the pixels (dx, dy) away from each pixel; 0 outside the grid."""
        x, y = self.x + dx, self.y + dy
        here = (x >= 0) & (x < self._width) & (y >= 0) & (y < self._height)
        index = self._index(x, y)
        return [dr.gather(mi.Float64, image, index, here) for image in images]

    # ------------------------------------------------------------------ one pixel of sixteen

    def probes(self) -> Mask:
        """True on one pixel of sixteen, the rank-1 lattice x = 5 y mod 16, which differs from row to row."""
        return ((self.x - 5 * self.y) & (BLOCK * BLOCK - 1)) == 0

    def spread_over_probes(self, image: PixelArray) -> PixelArray:
        """Largest value on the lattice of `probes` in the 3 × 3 blocks of 4 × 4 pixels around each pixel's block."""
        dr.eval(image)
        near = []
        for dx, dy in [(0, 0), *AROUND]:
            x = dr.clip(self.x // BLOCK + dx, 0, (self._width - 1) // BLOCK)
            y = dr.clip(self.y // BLOCK + dy, 0, (self._height - 1) // BLOCK)
            k = (x - y) & (BLOCK - 1)  # position of the lattice pixel on the diagonal of the block
            near.append(self.at(image, BLOCK * x + k, BLOCK * y + k))
        return reduce(dr.maximum, near)

    # ------------------------------------------------------------------ differences

    def gradient(self, image: PixelArray) -> tuple[PixelArray, PixelArray]:
        """Central differences along x and y, one-sided at the border; 0 along an axis of a single pixel."""
        near = self._neighbours(image)
        at_border = [(n == 0) | (n == side - 1) for n, side in ((self.x, self._width), (self.y, self._height))]
        along_x, along_y = near[1, 0] - near[-1, 0], near[0, 1] - near[0, -1]
        return along_x * dr.select(at_border[0], 1.0, 0.5), along_y * dr.select(at_border[1], 1.0, 0.5)

    def second_differences(self, image: PixelArray) -> tuple[PixelArray, PixelArray]:
        """P(k - 1) - 2 P(k) + P(k + 1) along x and y; border pixels take their neighbour's value.

        0 along an axis of fewer than three pixels.
        """
        x, y = dr.clip(self.x, 1, self._width - 2), dr.clip(self.y, 1, self._height - 2)
        along_x = self.at(image, x - 1, self.y) - 2 * self.at(image, x, self.y) + self.at(image, x + 1, self.y)
        along_y = self.at(image, self.x, y - 1) - 2 * self.at(image, self.x, y) + self.at(image, self.x, y + 1)
        return dr.select(self._width > 2, along_x, 0), dr.select(self._height > 2, along_y, 0)

    def principal_angle(self, x: PixelArray, y: PixelArray, radius: int) -> PixelArray:
        """Angle [rad] of the principal axis of the vectors (x, y) within `radius` pixels (structure tensor)."""
        products = x * y, x * x - y * y
        dr.eval(products)
        cross, along = (self.box_sum(product, radius) for product in products)
        return 0.5 * dr.atan2(2 * cross, along)

    # ------------------------------------------------------------------ silhouettes

    def outline(self, coverage: PixelArray) -> Mask:
        """True within a pixel of both covered and uncovered lines of sight, which may pass a silhouette there."""
        near = self._neighbours(coverage).values()
        most, least = reduce(dr.maximum, near, coverage), reduce(dr.minimum, near, coverage)
        outline = (most > COVERAGE_ROUNDING) & (least < 1 - COVERAGE_ROUNDING)
        dr.eval(outline)
        return outline


def _larger(a: Any, b: Any) -> Any:
    """Larger value of two images; of masks True where either is."""
    return a | b if dr.is_mask_v(a) else dr.maximum(a, b)


def parted(coverage: PixelArray) -> Mask:
    """True where some lines of sight of a pixel are covered and some are not."""
    return (coverage > COVERAGE_ROUNDING) & (coverage < 1 - COVERAGE_ROUNDING)


def _sliding_sum(image: PixelArray, start: mi.Int, position: mi.Int, length: mi.Int, reach: mi.Int) -> PixelArray:
    """Sums within `reach` of a `position` on a line of `length` pixels, which is stored from index `start` on."""
    total = dr.cumsum(image)
    last = start + dr.minimum(position + reach, length - 1)
    before = start + dr.maximum(position - reach, 0) - 1
    upto = dr.gather(mi.Float64, total, mi.UInt32(dr.maximum(before, 0)), before >= 0)
    return dr.gather(mi.Float64, total, mi.UInt32(last)) - upto
