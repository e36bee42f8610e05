"""Light too narrow for lines of sight from the pixels: what is far below a pixel and outshines all around it.

Four nodes a pixel find what is as large as a pixel at the phantom, in focus or blurred. Smaller bodies and spots they
meet by chance or not at all, and no estimate made of them knows; the surface form starts where the light does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .elements import Elements, at_one_wavelength, elements_of, scalar
from .grid import Grid
from .window import Window

OUTSHINES = 2.0  # an element is narrow if it is so many times brighter than any pixel around, seen sharp
# So much of a pixel in narrow light no further apart than that some of the four nodes a pixel are sure to meet, and to
# find what belongs to it.
SEEN, AROUND = 0.5, 10
FEWEST_ELEMENTS = 1 << 12  # of a shape that is no mesh
LARGEST_GRID = 1 << 12  # pixels along each side that are told apart

Column = NDArray[np.float64]
Index = NDArray[np.int64]
Image = NDArray[np.float64]


@dataclass(frozen=True)
class NarrowLight:
    """Light of narrow spots on each pixel of the window (h, w), and of all surfaces on the brightest pixel.

    Mean radiance on film [W/mm²/sr], to a factor of two.
    """

    on_pixels: Image
    brightest: float


def narrow_light(emitters: list[mi.Emitter], lens: mi.Sensor, window: Window) -> NarrowLight:
    """What `lens` sees of the light of narrow spots; nothing where no emitter is an `fspt_surface`."""
    on_pixels = np.zeros(window.shape)
    parts = [_seen(emitter, lens) for emitter in emitters if type(emitter).__name__ == "FsptSurface"]
    if not parts or not on_pixels.size:
        return NarrowLight(on_pixels, 0.0)
    radiance, area, reach, blur, x, y = np.concatenate(parts, axis=1)
    x, y = x - window.left - window.crop_offset[0], y - window.top - window.crop_offset[1]
    height, width = window.shape
    near = (x > -blur) & (x < width + blur) & (y > -blur) & (y < height + blur) & (radiance * area > 0)
    if not near.any():
        return NarrowLight(on_pixels, 0.0)
    radiance, area, reach, blur, x, y = (column[near] for column in (radiance, area, reach, blur, x, y))
    # A blur disc spreads an element's light over so many pixels; discs that overlap add up.
    light = radiance * area / (math.pi * blur**2 + 1)
    hidden = _hidden(radiance, area, x, y) & (reach < 1)
    level = np.ceil(np.log2(np.maximum(blur, 1)))
    brightest = 0.0
    for k in np.unique(level):
        here = level == k
        brightest = max(brightest, _grid(light[here], x[here] / 2**k, y[here] / 2**k)[0].max())
        here &= hidden
        if here.any():
            on_pixels += _spread(light[here], x[here], y[here], int(2**k) + 1, window.shape)
    return NarrowLight(on_pixels, float(brightest))


def _hidden(radiance: Column, area: Column, x: Column, y: Column) -> NDArray[np.bool_]:
    """True of elements that outshine the pixels around, few enough for all lines of sight to miss them."""
    power, row, column = _grid(radiance * area, x, y)
    grid = Grid(power.shape)
    narrow = radiance > OUTSHINES * grid.array(grid.spread_max(grid.lanes(power)))[row, column]
    spots = grid.array(grid.box_sum(grid.lanes(_grid(area * narrow, x, y)[0]), AROUND))
    return narrow & (spots[row, column] < SEEN)


def _grid(weight: Column, x: Column, y: Column) -> tuple[Image, Index, Index]:
    """Sums of `weight` on unit cells, and each one's row and column there; what is too far off falls into the last."""
    column, row = (np.clip(np.floor(c - c.min()), 0, LARGEST_GRID - 1).astype(np.int64) for c in (x, y))
    height, width = row.max() + 1, column.max() + 1
    return np.bincount(row * width + column, weight, minlength=height * width).reshape(height, width), row, column


def _spread(light: Column, x: Column, y: Column, reach: int, shape: tuple[int, int]) -> Image:
    """Sums of `light` within `reach` pixels of each pixel of the window, (h, w)."""
    height, width = shape
    reach = min(reach, height + width)
    row, column = (np.floor(c).astype(np.int64) + reach for c in (y, x))
    on = (row >= 0) & (row < height + 2 * reach) & (column >= 0) & (column < width + 2 * reach)
    sums = np.zeros((height + 2 * reach, width + 2 * reach))
    np.add.at(sums, (row[on], column[on]), light[on])
    grid = Grid(sums.shape)
    return grid.array(grid.box_sum(grid.lanes(sums), reach))[reach : reach + height, reach : reach + width]


def _seen(emitter: mi.Emitter, lens: mi.Sensor) -> NDArray[np.float64]:
    """Of each element radiance to the lens, area of its sharp image [pixels²], reach, blur, x, y [pixels]; (6, n).

    `reach`: how far its corners lie from its middle; infinite where a corner lies beside or behind the lens.
    """
    shape = emitter.get_shape()
    elements: Elements = elements_of(shape, 1 if shape.is_mesh() else max(emitter.texels(), FEWEST_ELEMENTS))
    index = dr.arange(mi.UInt32, elements.count)
    si, area = elements.place(index, mi.Point2f(0.5))
    to_lens = dr.normalize(lens.world_transform() @ mi.Point3f(0) - si.p)
    si.initialize_sh_frame()
    si.wi = si.to_local(to_lens)
    at_one_wavelength(si)
    centre, blur, scale = lens.blur_disc(si.p)
    axis = lens.world_transform() @ mi.Vector3f(0, 0, 1)
    image = area * dr.abs(dr.dot(si.n, to_lens) / (dr.dot(axis, to_lens) * dr.square(scale)))
    reach = dr.zeros(mi.Float, elements.count)
    for corner in elements.corners:
        there, _, side = lens.blur_disc(elements.place(index, mi.Point2f(*corner))[0].p)
        reach = dr.maximum(reach, dr.select(side * scale > 0, dr.norm(there - centre), dr.inf))
    columns = (scalar(emitter.eval(si)), image, reach, dr.abs(blur), centre.x, centre.y)
    dr.eval(columns)
    seen = np.array([column.numpy() for column in columns], np.float64)
    seen[0, ~np.isfinite(np.delete(seen, 2, axis=0)).all(axis=0)] = 0
    return np.nan_to_num(seen, posinf=np.finfo(np.float32).max, neginf=0)
