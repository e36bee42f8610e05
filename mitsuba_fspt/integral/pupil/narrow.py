"""What points all over the surfaces tell of light that lines of sight may miss: narrow light, surfaces edge-on.

Four nodes of Eq. M.5 a pixel detect light from a region as large as a pixel at the phantom, or as its blur disc where
that is larger. They may miss smaller bodies and spots, and error estimates from the nodes do not show that. Such light
is detected from points all over the surfaces; the pixels that it reaches take the surface form (M.9).

A surface whose tangent plane crosses the pupil shines on a part of it. Where it is deep, as the flat end of a cylinder,
its nearer and its farther rim are edges of different blur on one pixel, of which few transects may miss one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from ...camera.camera import Camera
from ...camera.window import Window
from ...emission.elements import Elements, elements_of
from ...emission.emitting_surface import EmittingSurface
from ...emission.exitance import square_texels_of
from ...emission.of_emitter import surfaces_of
from ...jit.batches import numbered
from ...jit.from_numpy import from_numpy
from ...jit.loops import repeat
from ...jit.pixel_grid import Grid
from ...jit.spectra import at_one_wavelength, scalar
from ..lines.specular import Specular, transmission
from .node_rules import PLASTIC, twelve

NARROW = 0.1  # of the tolerance: pixels with more light of narrow spots, or shade, do not rely on lines of sight alone
UNCERTAINTY = 2.0  # largest ratio of narrow light, or of variation, and its estimate
OUTSHINES = 2.0  # a point is narrow light if it is so many times brighter than every square around, in focus
# The limb of a wide body is not narrow light, as transects integrate it: its cosine to the lens is below `SLANTED`, the
# body covers at least the share `COVERED` of a square around, the point is at most `GLARES` times as bright as that.
SLANTED, COVERED, GLARES = 0.5, 0.5, 4.0
FEWEST_ELEMENTS = 1 << 12  # of a shape that is no mesh
WIDE, MOST_POINTS = 2.0, 1 << 12  # least width of a wide element [pixels, blur radii]; most points of a thin one
SHARP = 0.5  # blur radius [pixels] below which a point counts on its own pixel and those beside it
LARGEST_GRID = 1 << 12  # cells along each side of the grid

Column = NDArray[np.float64]
Index = NDArray[np.int64]
PixelArray = NDArray[np.float64]


@dataclass(frozen=True)
class NarrowLight:
    """Light on each pixel of the window (h, w) of narrow spots; on the brightest pixel that is shown of all surfaces;
    of these on each pixel as if they were in focus; and of surfaces edge-on, times the difference of their blur radii
    [pixels], at most 1.

    Mean radiance on film [W/mm²/sr], to a factor of two. `radiance`: the largest one of narrow spots [W/mm²/sr];
    `variation`: that of each pixel by variation of J_n finer than lines of sight are apart, see `fine_variation`.
    """

    on_pixels: PixelArray
    brightest: float
    in_focus: PixelArray
    edge_on: PixelArray
    radiance: float
    variation: PixelArray

    @classmethod
    def none(cls, shape: tuple[int, int]) -> NarrowLight:
        """Of a window on which no surface shines."""
        return cls(np.zeros(shape), 0.0, np.zeros(shape), np.zeros(shape), 0.0, np.zeros(shape))

    @property
    def at_most(self) -> PixelArray:
        """Upper bound of `on_pixels`."""
        return UNCERTAINTY * self.on_pixels

    def plus(self, elsewhere: NarrowLight) -> NarrowLight:
        """With narrow light and surfaces edge-on mirrors or glass show; its `brightest` and `in_focus` are kept."""
        return replace(
            self,
            on_pixels=self.on_pixels + elsewhere.on_pixels,
            edge_on=self.edge_on + elsewhere.edge_on,
            radiance=max(self.radiance, elsewhere.radiance),
            variation=self.variation + elsewhere.variation,
        )

    def times(self, share: PixelArray) -> NarrowLight:
        """These shares (h, w) of the narrow light, of surfaces edge-on and of the variation."""
        most = float(share.max(initial=0.0))
        images = {name: getattr(self, name) * share for name in ("on_pixels", "edge_on", "variation")}
        return replace(self, radiance=self.radiance * most, **images)


def points_on_surfaces(
    scene: mi.Scene, camera: Camera, specular: Specular | None = None, hidden: bool = True, itself: bool = False
) -> Points | None:
    """Points all over the surfaces, imaged by `camera`; None where no emitter is an `fspt_surface`.

    Along straight lines only, also through `specular` shapes. `hidden`: those that surfaces hide are dark, in a scene
    of a single shape only if it may hide points `itself`.
    """
    hides = hidden and (itself or len(scene.shapes()) > 1)
    parts = [_seen(scene, surface, camera, specular, hides) for surface in surfaces_of(scene)]
    parts = [replace(part, varied=number * part.varied) for number, part in enumerate(parts, 1)]
    return Points.joined(parts) if parts else None


def narrow_light(points: Points | None, window: Window) -> NarrowLight:
    """The part of the light of points all over the surfaces that comes from narrow spots; 0 without points."""
    if points is None or not math.prod(window.shape):
        return NarrowLight.none(window.shape)
    on_pixels, points = np.zeros(window.shape), points.seen_in(window)
    if not (points.radiance > 0).any():
        return NarrowLight.none(window.shape)
    light, level = points.light(), points.level()
    shown = points.shown_in(window)
    if not (light[shown] > 0).any():
        shown[:] = True
    brightest = radiance = 0.0
    for k in np.unique(level):
        here, reach = level == k, math.ceil(2 ** (k + 0.5))
        if (counts := here & shown).any():
            brightest = max(brightest, points[counts].cells(2**k).sums(light[counts]).max())
        there = points.near(reach + 2 * 2**k, window.shape)  # beyond, those of this level have no neighbours
        here[there] &= _hidden(points[there], 2**k)
        here &= there & (points.apart < 1)
        if here.any():
            on_pixels += spread(light[here], points[here], reach, window.shape)
            radiance = max(radiance, float(points.radiance[here].max()))
    in_focus = points.on_pixels(light, window.shape)
    edge_on = _edge_on(points, light, window.shape)
    return NarrowLight(on_pixels, float(brightest), in_focus, edge_on, radiance, np.zeros(window.shape))


def most_narrow_light(points: Points | None) -> float:
    """Largest light of narrow spots on a pixel, wherever it may lie, and in focus there [W/mm²/sr]."""
    if points is None:
        return 0.0
    points = points[(points.area > 0) & (points.cosine > 0) & (points.radiance > 0)]
    points = replace(points, signed_blur=np.zeros_like(points.x))
    light, level, most = points.light(), points.level(), 0.0
    for k in np.unique(level):
        here = level == k
        here[here] &= _hidden(points[here], 2**k)
        here &= points.apart < 1
        side = 2 * (2 * math.ceil(2 ** (k + 0.5)) + 1)  # twice that of the pixels around that a spot may reach
        for right, down in ((0, 0), (side / 2, 0), (0, side / 2), (side / 2, side / 2)):
            place = ((points.x[here] + right) / side, (points.y[here] + down) / side)
            column, row = (np.floor(np.clip(c, -(2.0**30), 2.0**30)).astype(np.int64) for c in place)
            cell = np.unique(row * (1 << 32) + column, return_inverse=True)[1]
            most = max(most, float(np.bincount(cell, light[here], minlength=1).max()))
    return UNCERTAINTY * most


def peak_of_points(points: Points | None, window: Window) -> float:
    """Lower bound of the brightest pixel that is shown [W/mm²/sr], from points on surfaces; 0 without points.

    As `NarrowLight.brightest`, less the factor of two, for windows of any size.
    """
    if points is None:
        return 0.0
    points = points.seen_in(window)
    points = points[points.shown_in(window)]
    light, level, brightest = points.light(), points.level(), 0.0
    for k in np.unique(level):
        here = level == k
        column, row = (np.floor(c[here] / 2**k).astype(np.int64) for c in (points.x, points.y))
        cell = np.unique(row * (1 << 32) + column, return_inverse=True)[1]
        brightest = max(brightest, np.bincount(cell, light[here]).max())
    return float(brightest) / 2


@dataclass(frozen=True)
class Points:
    """Points all over surfaces, columns (n,).

    radiance : to the lens; 0 where a point has no image, or another body hides it
    varied : number, from 1, of a surface on which J_n varies; 0 on others, where a point has no image, or another body
        hides it
    area : of the sharp image that it stands for [pixels²]
    cosine, front : the largest cosine of the normal to a point of the pupil; > 0 if the pupil's middle sees the point
    edge_on : 1 if the tangent plane crosses the pupil, so that a part of it does not see the point; 0 if not
    apart : distance from the next point; in pixels, or in blur radii where these are larger
    signed_blur, x, y : on film [pixels]
    """

    radiance: Column
    varied: Column
    area: Column
    cosine: Column
    front: Column
    edge_on: Column
    apart: Column
    signed_blur: Column
    x: Column
    y: Column

    @property
    def blur(self) -> Column:
        """Blur radius on film [pixels]."""
        return np.abs(self.signed_blur)

    @classmethod
    def joined(cls, parts: list[Points]) -> Points:
        """All of them."""
        return cls(*(np.concatenate(columns) for columns in zip(*(vars(part).values() for part in parts), strict=True)))

    def __getitem__(self, which: NDArray[np.bool_]) -> Points:
        return Points(*(column[which] for column in vars(self).values()))

    def seen_in(self, window: Window, around: int = 0) -> Points:
        """The points whose light reaches a window, and those so many pixels, or blur radii, `around`, with positions
        relative to its corner.
        """
        left, top = window.corner
        points = replace(self, x=self.x - left, y=self.y - top)
        reach = points.blur + around * np.maximum(points.blur, 1)
        return points[points.near(reach, window.shape) & (points.area > 0) & (points.cosine > 0)]

    def light(self) -> Column:
        """Radiance on film [W/mm²/sr] that each point alone gives to a pixel.

        A point's light spreads over the pixels of its blur disc; discs that overlap add up. No element gives more than
        one that covers the whole disc.
        """
        return self.radiance * np.minimum(self.area / (math.pi * self.blur**2 + 1), 1)

    def level(self) -> Column:
        """Of each blur disc larger than a pixel the logarithm of its radius, rounded."""
        return np.round(np.log2(np.maximum(self.blur, 1)))

    def near(self, far: float | Column, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """True for points less than `far` [pixels] from an image of this shape."""
        (height, width), (x, y) = shape, (self.x, self.y)
        return (x > -far) & (x < width + far) & (y > -far) & (y < height + far)

    def shown_in(self, window: Window) -> NDArray[np.bool_]:
        """True where a blur disc reaches the shown part of a window."""
        rows, columns = window.inner
        moved = replace(self, x=self.x - columns.start, y=self.y - rows.start)
        return moved.near(self.blur, (rows.stop - rows.start, columns.stop - columns.start))

    def on_pixels(self, light: Column, shape: tuple[int, int]) -> PixelArray:
        """Sum of the points' `light` on each pixel of an image of this shape, as if all were in focus."""
        here = self.near(0, shape)
        column, row = (np.floor(c[here]).astype(np.int64) for c in (self.x, self.y))
        return _Cells(shape, row * shape[1] + column).sums(light[here])

    def cells(self, side: float) -> _Cells:
        """Square cells of a `side` [pixels]; points too far away are in the last."""
        column, row = (
            np.clip(np.floor((c - c.min()) / side), 0, LARGEST_GRID - 1).astype(np.int64) for c in (self.x, self.y)
        )
        width = int(column.max()) + 1
        return _Cells((int(row.max()) + 1, width), row * width + column)


def _edge_on(points: Points, light: Column, shape: tuple[int, int]) -> PixelArray:
    """`NarrowLight.edge_on` from the `light` of points."""
    found, level = np.zeros(shape), points.level()
    least, most = np.full(shape, np.inf), np.full(shape, -np.inf)
    for k in np.unique(level[points.edge_on > 0]):
        reach = min(math.ceil(2 ** (k + 0.5)), sum(shape))
        here = (level == k) & (points.edge_on > 0) & points.near(reach, shape)
        if not here.any():
            continue
        found += spread(light[here], points[here], reach, shape)
        row, column = (np.floor(c[here]).astype(np.int64) + reach for c in (points.y, points.x))
        low, high = (np.full([n + 2 * reach for n in shape], end) for end in (np.inf, -np.inf))
        np.minimum.at(low, (row, column), points.signed_blur[here])
        np.maximum.at(high, (row, column), points.signed_blur[here])
        inner = tuple(slice(reach, reach + n) for n in shape)
        least = np.minimum(least, minimum_filter(low, 2 * reach + 1, mode="constant", cval=np.inf)[inner])
        most = np.maximum(most, maximum_filter(high, 2 * reach + 1, mode="constant", cval=-np.inf)[inner])
    return found * np.clip(np.where(found > 0, most - least, 0), 0, 1)


def _hidden(points: Points, side: float) -> NDArray[np.bool_]:
    """True for points that are narrow light among squares of a `side` [pixels], and not the limb of a wide body.

    Points beyond the limb, visible from a part of the pupil only, lie beside points visible from the pupil's middle.
    """
    cells = points.cells(side)
    grid = Grid(cells.shape)
    share = np.minimum(points.area / side**2, 1)
    light, covered, front = (
        cells.sums(weight) for weight in (points.radiance * share, share, (points.front > 0).astype(np.float64))
    )
    mean = np.divide(light, covered, out=np.zeros_like(light), where=covered > 0)
    around, mean_around, most, facing = (
        grid.array(grid.spread_max(grid.flat(image))).ravel()[cells.number] for image in (light, mean, covered, front)
    )
    limb = (points.cosine < SLANTED) & (most > COVERED) & (points.radiance <= GLARES * mean_around)
    limb |= (points.front <= 0) & (facing > 0)
    return (points.radiance > OUTSHINES * around) & ~limb


@dataclass(frozen=True)
class _Cells:
    """Cells with points in them: `shape` (h, w) of their grid and, row by row, the `number` of each point's."""

    shape: tuple[int, int]
    number: Index

    def sums(self, weight: Column) -> PixelArray:
        """Sum of the points' weights on each cell."""
        return np.bincount(self.number, weight, minlength=math.prod(self.shape)).reshape(self.shape)


def spread(light: Column, points: Points, reach: int, shape: tuple[int, int]) -> PixelArray:
    """Sums of `light` within `reach` pixels of each pixel of the window, (h, w)."""
    height, width = shape
    reach = min(reach, height + width)
    row, column = (np.floor(c).astype(np.int64) + reach for c in (points.y, points.x))
    on = (row >= 0) & (row < height + 2 * reach) & (column >= 0) & (column < width + 2 * reach)
    sums = np.zeros((height + 2 * reach, width + 2 * reach))
    np.add.at(sums, (row[on], column[on]), light[on])
    grid = Grid(sums.shape)
    return grid.array(grid.box_sum(grid.flat(sums), reach))[reach : reach + height, reach : reach + width]


def most_on_pixels(points: Points, each: Column, shape: tuple[int, int]) -> PixelArray:
    """Largest sum (h, w) of what `each` point gives, times the share of the pixel, or of its blur disc, that it
    covers."""
    sharp = points.blur < SHARP
    image = np.zeros(shape)
    image += maximum_filter(points[sharp].on_pixels(points[sharp].area * each[sharp], shape), 3)
    blurred, each = points[~sharp], each[~sharp]
    covered, level = replace(blurred, radiance=np.ones_like(blurred.radiance)).light(), blurred.level()
    for k in np.unique(level):
        here = level == k
        reach = max(math.ceil(blurred.blur[here].max()), 1)
        image += spread(covered[here] * each[here], blurred[here], reach, shape)
    return image


def _seen(scene: mi.Scene, surface: EmittingSurface, camera: Camera, specular: Specular | None, hides: bool) -> Points:
    """Points all over a surface, with their images; dark where a surface `hides` them."""
    shape = surface.shape
    texels = square_texels_of(surface.exitance)
    if shape.is_mesh():  # whose elements lie across the texels
        elements: Elements = elements_of(shape, 4 * texels if texels > 1 else 1)
    else:
        elements = elements_of(shape, max(texels, FEWEST_ELEMENTS))

    def radiance(si: mi.SurfaceInteraction3f, to_lens: mi.Vector3f) -> mi.Float:
        return scalar(surface.radiance(si, to_lens, mi.Bool(True)))

    points = points_of(elements, camera, radiance, partial(in_sight, scene, camera, specular) if hides else None)
    return replace(points, varied=np.zeros_like(points.varied)) if surface.is_uniform() else points


def points_of(
    elements: Elements,
    camera: Camera,
    radiance: Callable[[mi.SurfaceInteraction3f, mi.Vector3f], mi.Float],
    visible: Callable[[mi.Point3f, mi.Normal3f], mi.Bool] | None = None,
) -> Points:
    """Points all over elements, with their images; those that are not `visible` have no radiance."""
    counts = np.ones(elements.count, np.int64)
    middles = _on_elements(elements, radiance, camera, counts)
    area, unit = middles.image.numpy(), np.maximum(np.abs(middles.blur.numpy()), 1)
    with np.errstate(invalid="ignore"):  # of elements without an image, which have no radiance
        reach = _reach(elements, camera) / unit
    # A long and thin element is represented by many points, a quarter of a unit apart, any other by one.
    long = np.isfinite(reach) & (reach > MOST_POINTS)  # `MOST_POINTS` points would be too far apart
    crossed = middles.edge_on.numpy() > 0
    thin = np.isfinite(reach) & ((area < WIDE * unit**2 * reach) | crossed) & ~long
    counts = np.ceil(np.where(thin, 4 * reach, 1)).clip(1, MOST_POINTS).astype(np.int64)
    at = _on_elements(elements, radiance, camera, counts)
    shown = dr.full(mi.Float, 1, dr.width(at.image))
    if visible:
        shown = dr.select(visible(at.place, at.normal), shown, 0)
        dr.eval(shown)
    columns = (shown * at.radiance, shown, at.image, at.cosine, at.front, at.edge_on, at.blur, at.centre.x, at.centre.y)
    seen = np.array([column.numpy() for column in columns], np.float64)
    unseen = ~np.isfinite(seen).all(axis=0) | np.repeat(long, counts)
    radiance, shown, image, cosine, front, edge_on, blur, x, y = np.nan_to_num(
        seen, posinf=np.finfo(np.float32).max, neginf=0
    )
    # An element half as thick as a unit covers half of some square: its points are not narrow.
    apart = np.repeat(np.where(area < unit**2 * reach, reach / counts, np.inf), counts)
    image = image / np.repeat(counts, counts)
    radiance, shown = (np.where(unseen, 0, column) for column in (radiance, shown))
    return Points(radiance, shown, image, cosine, front, edge_on, apart, blur, x, y)


@dataclass
class _OnElements:
    """Values at points of elements: `radiance` towards the point of the pupil highest above them, area of the element's
    `image` from there [pixels²]; cosine, front, edge_on, signed `blur`, `centre` on film as in `Points`; `place` and
    `normal` in the world.
    """

    radiance: mi.Float
    image: mi.Float
    cosine: mi.Float
    front: mi.Float
    edge_on: mi.Float
    blur: mi.Float
    centre: mi.Point2f
    place: mi.Point3f
    normal: mi.Normal3f


def _on_elements(
    elements: Elements,
    radiance: Callable[[mi.SurfaceInteraction3f, mi.Vector3f], mi.Float],
    camera: Camera,
    counts: Index,
) -> _OnElements:
    """Values at `counts` points of each element, the first in its middle."""
    index, number = numbered(counts)
    sample = mi.Point2f(*(from_numpy(mi.Float, np.mod(0.5 + step * number, 1.0)) for step in PLASTIC))
    si, area = elements.place(from_numpy(mi.UInt32, index), sample)
    to_rim = _rim_above(si, camera) - si.p
    to_lens = dr.normalize(to_rim)
    at_one_wavelength(si)
    centre, blur, scale = camera.blur_disc(si.p)
    cosine = dr.dot(si.n, to_lens)
    image = area * dr.abs(cosine / (dr.dot(camera.axis, to_lens) * dr.square(scale)))
    front = dr.dot(si.n, camera.to_world @ mi.Point3f(0) - si.p)
    place = camera.film_map.from_ideal(centre)
    # The rim below lies as far under the middle of the pupil as the rim above lies over it.
    edge_on = dr.select((cosine > 0) & (2 * front <= dr.dot(si.n, to_rim)), mi.Float(1), 0)
    at = _OnElements(radiance(si, to_lens), image, cosine, front, edge_on, blur, place, si.p, si.n)
    dr.eval(at)
    return at


def in_sight(
    scene: mi.Scene, camera: Camera, specular: Specular | None, place: mi.Point3f, normal: mi.Normal3f
) -> mi.Bool:
    """True for points that one of twelve points of the pupil is visible from."""
    x, y = (mi.Float(column) for column in twelve(False).pupil.T)

    def test(k: mi.UInt32, seen: mi.Bool) -> tuple[mi.Bool]:
        pupil = mi.Point2f(dr.gather(mi.Float, x, k), dr.gather(mi.Float, y, k))
        lens_point = camera.arrival(place, pupil)[1]
        return (seen | (transmission(scene, specular, place, normal, lens_point, ~seen) > 0),)

    return repeat(dr.opaque(mi.UInt32, len(twelve(False))), test, mi.Bool(False))[0]


def _rim_above(si: mi.SurfaceInteraction3f, camera: Camera) -> mi.Point3f:
    """The point of the pupil farthest above the tangent plane, the only side that a grazing surface shines on."""
    normal = camera.to_world.inverse() @ mi.Vector3f(si.n)
    across = dr.norm(mi.Vector2f(normal.x, normal.y))
    return camera.arrival(si.p, dr.select(across > 0, mi.Point2f(normal.x, normal.y) / across, 0))[1]


def _reach(elements: Elements, camera: Camera) -> Column:
    """Distance on the film of the corners of each element from its middle [pixels]; inf where one has no image."""
    index = dr.arange(mi.UInt32, elements.count)
    centre, _, scale = camera.blur_disc(elements.place(index, mi.Point2f(0.5))[0].p)
    reach = dr.zeros(mi.Float, elements.count)
    for corner in elements.corners:
        there, _, side = camera.blur_disc(elements.place(index, mi.Point2f(*corner))[0].p)
        reach = dr.maximum(reach, dr.select(side * scale > 0, dr.norm(there - centre), dr.inf))
    return np.nan_to_num(reach.numpy().astype(np.float64), nan=np.inf, posinf=np.inf)
