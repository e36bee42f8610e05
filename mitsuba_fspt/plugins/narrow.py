"""Light too narrow for lines of sight from the pixels: what is far below a pixel and outshines all around it.

Four nodes a pixel find what is as large as a pixel at the phantom, or as its blur disc where that is larger. Smaller
bodies and spots they meet by chance or not at all, and no estimate made of them knows; the surface form starts where
the light does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..rules import PLASTIC
from .elements import Elements, at_one_wavelength, elements_of, scalar
from .grid import Grid
from .window import Window

OUTSHINES = 2.0  # a point is narrow if it is so many times brighter than any square around, seen sharp
SLANTED, COVERED = 0.5, 0.5  # cosine to the lens, share of a pixel: at the limb of a wide body transects look closely
FEWEST_ELEMENTS = 1 << 12  # of a shape that is no mesh
WIDE, MOST_POINTS = 2.0, 1 << 12  # so thick [pixels, blur radii] no element is narrow; points of a thin one
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
    radiance, area, slant, front, apart, blur, x, y = np.concatenate(parts, axis=1)
    x, y = x - window.left - window.crop_offset[0], y - window.top - window.crop_offset[1]
    height, width = window.shape
    near = (x > -blur) & (x < width + blur) & (y > -blur) & (y < height + blur) & (area > 0) & (slant > 0)
    if not (near & (radiance > 0)).any():
        return NarrowLight(on_pixels, 0.0)
    columns = radiance, area, slant, front, apart, blur, x, y
    radiance, area, slant, front, apart, blur, x, y = (column[near] for column in columns)
    # A blur disc spreads a point's light over so many pixels; discs that overlap add up.
    light = radiance * area / (math.pi * blur**2 + 1)
    level = np.round(np.log2(np.maximum(blur, 1)))
    brightest = 0.0
    for k in np.unique(level):
        here, reach = level == k, math.ceil(2 ** (k + 0.5))
        brightest = max(brightest, _cells(x[here] / 2**k, y[here] / 2**k).sums(light[here]).max())
        far = reach + 2 * 2**k  # beyond that the points of this level have no neighbours
        there = (x > -far) & (x < width + far) & (y > -far) & (y < height + far)
        here[there] &= _hidden(*(column[there] for column in (radiance, area, slant, front, x, y)), 2**k)
        here &= there & (apart < 1)
        if here.any():
            on_pixels += _spread(light[here], x[here], y[here], reach, window.shape)
    return NarrowLight(on_pixels, float(brightest))


def _hidden(
    radiance: Column, area: Column, slant: Column, front: Column, x: Column, y: Column, side: float
) -> NDArray[np.bool_]:
    """True of points that outshine the squares of a `side` [pixels] around, and are not the limb of a wide body.

    Beyond the limb lies what only a part of the pupil sees, beside what its middle does.
    """
    cells = _cells(x / side, y / side)
    grid = Grid(cells.shape)
    weights = radiance * area / side**2, area / side**2, (front > 0).astype(np.float64)
    around, most, facing = (
        grid.array(grid.spread_max(grid.lanes(cells.sums(weight)))).ravel()[cells.number] for weight in weights
    )
    limb = (slant < SLANTED) & (most > COVERED) | (front <= 0) & (facing > 0)
    return (radiance > OUTSHINES * around) & ~limb


@dataclass(frozen=True)
class _Cells:
    """Unit cells with points in them: `shape` (h, w) of their grid and, row by row, the `number` of each point's."""

    shape: tuple[int, int]
    number: Index

    def sums(self, weight: Column) -> Image:
        """Sum of the points' weights on each cell."""
        return np.bincount(self.number, weight, minlength=math.prod(self.shape)).reshape(self.shape)


def _cells(x: Column, y: Column) -> _Cells:
    """Cells of points; what is too far off falls into the last."""
    column, row = (np.clip(np.floor(c - c.min()), 0, LARGEST_GRID - 1).astype(np.int64) for c in (x, y))
    width = int(column.max()) + 1
    return _Cells((int(row.max()) + 1, width), row * width + column)


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
    """Of points all over a surface radiance to the lens, area of the sharp image they stand for [pixels²], slant,
    front, how far they are apart, blur, x, y [pixels]; (8, n).

    Radiance 0 where a point has no image. `slant`: the largest cosine of the normal to a point of the pupil,
    `front` > 0 if its middle sees the point. How far apart: in pixels, or in blur radii where they are larger.
    """
    shape = emitter.get_shape()
    elements: Elements = elements_of(shape, 1 if shape.is_mesh() else max(emitter.texels(), FEWEST_ELEMENTS))
    counts = np.ones(elements.count, np.int64)
    _, area, _, _, blur, _ = (column.numpy() for column in _look(emitter, elements, lens, counts))
    unit = np.maximum(blur, 1)
    reach = _reach(elements, lens) / unit
    # A long and thin element is many points, a quarter of a unit apart; one that is wide may be wide at one.
    long = np.isfinite(reach) & (reach > MOST_POINTS)  # points all along would be too far apart to tell
    thin = np.isfinite(reach) & (area < WIDE * unit**2 * reach) & ~long
    counts = np.ceil(np.where(thin, 4 * reach, 1)).clip(1, MOST_POINTS).astype(np.int64)
    *columns, centre = _look(emitter, elements, lens, counts)
    seen = np.array([column.numpy() for column in (*columns, centre.x, centre.y)], np.float64)
    seen[1] /= np.repeat(counts, counts)
    seen[0, ~np.isfinite(seen).all(axis=0) | np.repeat(long, counts)] = 0
    seen = np.nan_to_num(seen, posinf=np.finfo(np.float32).max, neginf=0)
    # What is half as thick as a unit covers half of some square by itself.
    apart = np.where(area < unit**2 * reach, reach / counts, np.inf)
    return np.insert(seen, 4, np.repeat(apart, counts), axis=0)


def _look(
    emitter: mi.Emitter, elements: Elements, lens: mi.Sensor, counts: Index
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Float, mi.Point2f]:
    """At so many points of each element, the first its middle, radiance to where the lens sees most of it, area of the
    element's image from there, slant, front, blur, place on film.
    """
    index = np.repeat(np.arange(elements.count), counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    sample = mi.Point2f(*(mi.Float(np.mod(0.5 + step * number, 1.0)) for step in PLASTIC))
    si, area = elements.place(mi.UInt32(index), sample)
    to_lens = dr.normalize(_rim_above(si, lens) - si.p)
    si.initialize_sh_frame()
    si.wi = si.to_local(to_lens)
    at_one_wavelength(si)
    centre, blur, scale = lens.blur_disc(si.p)
    axis = lens.world_transform() @ mi.Vector3f(0, 0, 1)
    slant = dr.dot(si.n, to_lens)
    image = area * dr.abs(slant / (dr.dot(axis, to_lens) * dr.square(scale)))
    front = dr.dot(si.n, lens.world_transform() @ mi.Point3f(0) - si.p)
    columns = (scalar(emitter.eval(si)), image, slant, front, dr.abs(blur), centre)
    dr.eval(columns)
    return columns


def _rim_above(si: mi.SurfaceInteraction3f, lens: mi.Sensor) -> mi.Point3f:
    """The point of the pupil farthest above the tangent plane, the only side that a grazing surface shines on."""
    normal = lens.world_transform().inverse() @ mi.Vector3f(si.n)
    across = dr.norm(mi.Vector2f(normal.x, normal.y))
    return lens.arrival(si.p, dr.select(across > 0, mi.Point2f(normal.x, normal.y) / across, 0))[1]


def _reach(elements: Elements, lens: mi.Sensor) -> Column:
    """How far the corners of each element lie from its middle on the film [pixels]; inf where one has no image."""
    index = dr.arange(mi.UInt32, elements.count)
    centre, _, scale = lens.blur_disc(elements.place(index, mi.Point2f(0.5))[0].p)
    reach = dr.zeros(mi.Float, elements.count)
    for corner in elements.corners:
        there, _, side = lens.blur_disc(elements.place(index, mi.Point2f(*corner))[0].p)
        reach = dr.maximum(reach, dr.select(side * scale > 0, dr.norm(there - centre), dr.inf))
    return np.nan_to_num(reach.numpy().astype(np.float64), nan=np.inf, posinf=np.inf)
