"""Square blocks of pixels of a large image, as a grid that does not contain the other pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .from_numpy import from_numpy
from .pixel_grid import AROUND, Grid

if TYPE_CHECKING:
    from .pixel_grid import Mask, PixelArray


class BlockGrid(Grid):
    """Pixels of the marked blocks of `side`² pixels; an array on the grid has one entry per pixel, block by block.

    blocks : (rows, columns) of blocks, True where a block belongs to the grid; at least one
    side : a power of two, so that shifts take the place of divisions, which processors have none of for vectors
    shape : (h, w) of the whole image that the blocks cover
    place : number of each pixel in the whole image, row by row

    In operations on neighbours, a pixel's own value takes the place of a neighbour that is not in the grid.
    """

    def __init__(self, blocks: NDArray[np.bool_], side: int) -> None:
        self.shape = (side * blocks.shape[0], side * blocks.shape[1])
        self.blocks, self.side = blocks, side
        row, column = np.nonzero(blocks)
        self._count = len(row) * side**2
        number = np.full(blocks.shape, -1, np.int32)
        number[row, column] = np.arange(len(row))
        self._blocks, self._rows = from_numpy(mi.Int, number), tuple(from_numpy(mi.Int, of) for of in (row, column))
        self._shift, self._columns = (dr.opaque(mi.Int, n) for n in (side.bit_length() - 1, blocks.shape[1]))
        self._height, self._width = (dr.opaque(mi.Int, n) for n in self.shape)
        self.number = dr.arange(mi.UInt32, self._count)
        number = mi.Int(self.number)
        block, inside = mi.UInt32(number >> (2 * self._shift)), (1 << self._shift) - 1
        self.y, self.x = (dr.gather(mi.Int, ends, block) << self._shift for ends in self._rows)
        self.y, self.x = self.y + ((number >> self._shift) & inside), self.x + (number & inside)
        self.position = mi.UInt32(self.y * self._width + self.x)
        dr.eval(self.number, self.x, self.y, self.position)
        self._around = {(dx, dy): self._index(self.x + dx, self.y + dy) for dx, dy in AROUND}
        dr.eval(self._around)

    def __len__(self) -> int:
        return self._count

    def place(self, number: mi.UInt32) -> mi.UInt32:
        """Number in the whole image of each of these pixels of the grid."""
        return dr.gather(mi.UInt32, self.position, number)

    def pixels(self, mask: Mask | None = None) -> mi.UInt32:
        """Numbers of all pixels or of the marked ones."""
        return self.number if mask is None else dr.compress(mask)

    def flat(self, array: NDArray[Any]) -> Any:
        """Values or mask on the grid, from an array (h, w) of the whole image."""
        side, (rows, columns) = self.side, self.blocks.shape
        own = array.reshape(rows, side, columns, side).swapaxes(1, 2)[self.blocks]
        return from_numpy(mi.Bool if own.dtype == bool else mi.Float64, own)

    def lay(self, image: Any, array: NDArray[Any]) -> None:
        """Write values on the grid into an array (h, w) of the whole image."""
        side, (rows, columns) = self.side, self.blocks.shape
        whole = array.reshape(rows, side, columns, side).swapaxes(1, 2)
        whole[self.blocks] = np.asarray(image.numpy()).reshape(-1, side, side)

    def border(self) -> Mask:
        """True on pixels with a neighbour that is not in the grid."""
        inside = mi.Bool(True)
        for (dx, dy), index in self._around.items():
            inside &= (dr.gather(mi.Int, self.x, index) == self.x + dx) & (
                dr.gather(mi.Int, self.y, index) == self.y + dy
            )
        return ~inside

    def box_sum(self, image: PixelArray, radius: int) -> PixelArray:
        """Sum over the pixels of the grid among the (2 radius + 1)² around each one."""
        reach = dr.opaque(mi.Int, radius)
        for along_x in (True, False):
            dr.eval(image)

            def add(step: mi.Int, total: PixelArray, image: PixelArray = image, along_x: bool = along_x) -> tuple:
                x, y = (self.x + step, self.y) if along_x else (self.x, self.y + step)
                index, here = self._looked_up(x, y)
                return step + 1, total + dr.gather(mi.Float64, image, index, here)

            start = (-reach + dr.zeros(mi.Int, len(self)), dr.zeros(mi.Float64, len(self)))
            _, image = dr.while_loop(start, lambda step, total: step <= reach, add)
        return image

    def _beside(self, images: tuple[PixelArray, ...], dx: int, dy: int) -> list[PixelArray]:
        index, here = self._looked_up(self.x + dx, self.y + dy)
        return [dr.gather(mi.Float64, image, index, here) for image in images]

    def _index(self, x: mi.Int, y: mi.Int) -> mi.UInt32:
        """Numbers of the neighbours (x, y) of each pixel; the pixel's own number for a neighbour beyond the grid."""
        index, here = self._looked_up(x, y)
        return dr.select(here, index, self.number)

    def _looked_up(self, x: mi.Int, y: mi.Int) -> tuple[mi.UInt32, Mask]:
        """Numbers of the pixels (x, y), and True where they belong to the grid."""
        here = (x >= 0) & (x < self._width) & (y >= 0) & (y < self._height)
        row, column, inside = y >> self._shift, x >> self._shift, (1 << self._shift) - 1
        block = dr.gather(mi.Int, self._blocks, mi.UInt32(row * self._columns + column), here)
        here &= block >= 0
        number = (((block << self._shift) + (y & inside)) << self._shift) + (x & inside)
        return mi.UInt32(dr.select(here, number, 0)), here
