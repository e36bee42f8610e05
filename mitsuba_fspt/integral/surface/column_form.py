"""Columns of the transport matrix: Eq. 9 in its surface form (M.9) for unit J_n of one vertex or face at a time.

Every face sends its light through M × M nodes of the pupil. Through one node the image of a flat triangle is a
triangle, and the étendue that a pixel takes of it is cos⁴θ (Eq. M.5) times the part of the pixel inside: the light of
each of its columns, linear over the triangle, is distributed exactly over the pixels (`ColumnCanvas`), whatever the
sizes of face and pixel. Only the pupil is sampled. Of a face much smaller than its blur disc not the face but the pupil
is laid: the images of the pupil's cells through the middle of a piece, which tile the blur disc.

All columns are computed twice, with the cells and pieces of `ColumnRule` and with half of them. The error is of second
order in both, so that a third of the difference is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import MOST_RIM
from ...emission.elements import of_part
from ...jit.batches import batch_slices, numbered
from ...jit.from_numpy import from_numpy
from ..lines.eq9 import eq9, etendue_from_pixel, etendue_from_surface
from ..lines.occlusion import hidden
from . import pupil_cells
from .column_canvas import ColumnCanvas, Plane, Windows
from .face_light import CORNERS, DROP, ColumnRule, FaceLight, Plan
from .footprint import SPECK
from .lit_part import LitPart
from .pixel_sums import most_pixels

AROUND = ((0, 0), (1, 0), (1, 1), (0, 1))  # of a cell of the pupil
LEAST_AREA = 2.0**-20  # pixels²: a smaller image is replaced by the square of half a side `SPECK`
# Over the farthest coordinate of an image and the film's longer side: over a flatter image the density varies along its
# longest edge alone, as its slope, of a density below 1/4π, times these is to be a sixth of the largest number of
# quanta of `ColumnCanvas`.
LEAST_HEIGHT = 2.0**-18
FILM_BASED = 1.0  # pixels: sides from which the étendue is that of the image, exact however large it is
GAUSS = (0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3))  # nodes on the side of a pixel
WHOLE = 1e-6  # by which float32 changes the share of the pupil that is open
MOST_WORK, LEAST_WORK = 1 << 22, 1 << 20  # entries of windows that are accumulated at a time; with half, 10 % slower
# Image of a piece, over the square of its blur radius, below which the blur disc evens out what is misplaced in it.
WIDE = 1.0
LARGE = 1.0  # pixels²: image of a piece above which one of its random points that is hidden adds to the error
LEFT = 1 / 3  # error over the change by twice the cells and pieces, of second order
MOST_CHANGE = 6e4  # relative, below the largest number of float16

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
# Density of light, the polygon that it fills with the number of its edges, and where there is any.
Laid = tuple[list[Plane], list[mi.Point2d], mi.UInt32, mi.Bool]


@dataclass(frozen=True)
class Columns:
    """Light of the columns of one mesh on the film: of every entry the column, the pixel, row by row from the first of
    the crop window, the light, and by how much many more cells and pieces would change it, over it; in any order.

    Light is over that of a pixel whose pupil is filled by 1 W/mm²/sr, for J_n = 1 W/mm²: 1/π at the most for Lambert's
    law; times the pixel's étendue it is an entry of T [mm²]. `exact` (n,): columns of which no face is hidden in part,
    whose sums are those of form factors.
    """

    columns: NDArray[np.int32]
    pixels: NDArray[np.int32]
    light: NDArray[np.float32]
    change: NDArray[np.float16]
    exact: Mask


def column_windows(faces: FaceLight, count: int, on: str, shape: tuple[int, int]) -> Windows:
    """Windows of the `count` columns of a mesh: of its faces, or of its vertices with all faces around each."""
    if on == "face":
        return Windows.around(faces.low, faces.high, shape)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    bright = faces.bright
    for k in range(3):
        np.minimum.at(low, faces.corners[bright, k], faces.low[bright])
        np.maximum.at(high, faces.corners[bright, k], faces.high[bright])
    return Windows.around(low, high, shape)


def columns_of(
    scene: mi.Scene,
    camera: Camera,
    faces: FaceLight,
    windows: Windows,
    on: str,
    rtol: float,
    progress: Callable[[float], None] | None = None,
) -> Columns:
    """Columns of one mesh by `ColumnRule`, some windows at a time; `progress` is called with the share done."""
    shape = camera.film.shape
    plan = faces.plan(ColumnRule.of(rtol), on)
    parts = []
    groups = list(_groups(windows))
    for number, group in enumerate(groups):
        if progress:
            progress(number / len(groups))
        some = windows.of(group)
        inside = group if on == "face" else group[faces.corners].any(axis=1)
        index = np.flatnonzero(faces.bright & inside)
        fine, coarse = (_laid(scene, camera, faces, index, p, some, on, shape) for p in (plan, plan.halved()))
        parts.append(_kept(some, fine, coarse, DROP * rtol, camera, shape))
    exact = ~faces.mixed
    if on == "vertex":
        exact = np.ones(len(windows.left), bool)
        exact[faces.corners[faces.mixed].ravel()] = False
    return Columns(*(parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))), exact)


def _groups(windows: Windows) -> Iterator[Mask]:
    """Columns in groups of at most `MOST_WORK` entries, neighbours on the film together; at least one group.

    Fewer entries, but no less than `LEAST_WORK`, where the threads have no copies of so many.
    """
    areas, most = windows.areas, max(min(MOST_WORK, most_pixels()), LEAST_WORK)
    if areas.sum() <= most:
        yield np.ones(len(areas), bool)
        return
    middle = np.stack([windows.top + windows.height // 2, windows.left + windows.width // 2])
    band = max(int(np.median(windows.height[windows.height > 0])) * 4, 1)
    order = np.lexsort((middle[1], middle[0] // band))
    for some in batch_slices(areas[order], most):
        group = np.zeros(len(areas), bool)
        group[order[some]] = True
        yield group


def _kept(
    windows: Windows, fine: Array, coarse: Array, least: float, camera: Camera, shape: tuple[int, int]
) -> tuple[NDArray[Any], ...]:
    """Column, pixel, light and relative change of the entries above the `least` share of a column's brightest."""
    column = windows.columns()
    some = np.flatnonzero((fine > 0) & windows.inside())
    starts = np.cumsum(windows.areas) - windows.areas
    brightest = np.zeros(len(windows.left))
    filled = windows.areas > 0
    if filled.any():
        brightest[filled] = np.maximum.reduceat(fine, starts[filled])
    some = some[fine[some] > least * brightest[column[some]]]
    column, fine, coarse = column[some].astype(np.int32), fine[some], coarse[some]
    y, x = windows.rows_of_film()[some], windows.columns_of_film()[some]
    even = falloff_on_pixels(camera, x, y, camera.film.crop_offset)
    change = np.clip(LEFT * (fine - coarse) / fine, -MOST_CHANGE, MOST_CHANGE)
    return column, (y * shape[1] + x).astype(np.int32), (even * fine).astype(np.float32), change.astype(np.float16)


def _laid(
    scene: mi.Scene,
    camera: Camera,
    faces: FaceLight,
    index: Index,
    plan: Plan,
    windows: Windows,
    on: str,
    shape: tuple[int, int],
) -> Array:
    """Light of some faces on the windows, see `ColumnCanvas.light`."""
    canvas = ColumnCanvas(shape, windows)
    corners = from_numpy(mi.UInt32, faces.corners)
    for some, cells, cuts, points, taken in plan.of(index).passes():
        items = np.stack([index[some], cells, cuts, points, taken @ (1 << np.arange(taken.shape[1]))])
        for run in batch_slices((items[1] * items[2]) ** 2):
            part = items[:, run]
            lines = FaceLines.numbered(part[:4])
            face, mask = lines.face, dr.gather(mi.UInt32, from_numpy(mi.UInt32, part[4]), lines.row)
            planes, ring, count, active = lines.columns(scene, camera, faces, on)
            columns = [face] if on == "face" else [dr.gather(mi.UInt32, corners, 3 * face + k) for k in range(3)]
            columns = [dr.select(mask & (1 << k) != 0, column, canvas.none) for k, column in enumerate(columns)]
            canvas.lay(columns, planes, ring, count, active)
            canvas.evaluate()
    return canvas.light()


@dataclass(frozen=True)
class FaceLines:
    """Lines of sight of one launch: face, M, pieces along a side, whether cells are laid, number within the face, row
    of the item."""

    face: mi.UInt32
    m: mi.UInt32
    cut: mi.UInt32
    points: mi.Bool
    number: mi.UInt32
    row: mi.UInt32

    @classmethod
    def numbered(cls, items: Index) -> FaceLines:
        """All lines of n `items` (4, n): face, M, pieces along a side, whether cells are laid."""
        row, number = numbered((items[1] * items[2]) ** 2)
        row = from_numpy(mi.UInt32, row)
        face, m, cut, at = (dr.gather(mi.UInt32, from_numpy(mi.UInt32, of), row) for of in items)
        # Array entries beyond the last line gather 0, and whole numbers divided by 0 end the process.
        return cls(face, dr.maximum(m, 1), dr.maximum(cut, 1), at > 0, from_numpy(mi.UInt32, number), row)

    def columns(self, scene: mi.Scene, camera: Camera, faces: FaceLight, on: str) -> Laid:
        """The light of J_n = 1 of each column of the face, on the crop window."""
        image = self._image(scene, camera, faces, camera.film.crop_offset, by_points=False)
        return image.laid([image.values] if on == "face" else image.of_corners())[0]

    def light(
        self,
        scene: mi.Scene,
        camera: Camera,
        faces: FaceLight,
        exitance: Sequence[mi.Float],
        corner: tuple[float, float],
    ) -> tuple[Laid, Misfits | None]:
        """The light of J_n with the values `exitance` at the three corners of each face, and the coverage, on a film
        whose first pixel has this `corner` (x, y); and what random points make of both."""
        image = self._image(scene, camera, faces, corner, by_points=True)
        levels = [mi.Float64(dr.gather(mi.Float, own, self.face)) for own in exitance]
        light = [
            sum((w[c] * level for w, level in zip(image.of_corners(), levels, strict=True)), mi.Float64(0))
            for c in range(3)
        ]
        return image.laid([light, [image.cover] * 3])

    def _image(
        self, scene: mi.Scene, camera: Camera, faces: FaceLight, corner: tuple[float, float], by_points: bool
    ) -> _Image:
        """The image of the lines' pieces through the nodes, or of the nodes' cells through the pieces.

        by_points : light that the random points of wide pieces add or take away goes with the image
        """
        m, elements, face = self.m, faces.elements, self.face
        part, i, j = self.number // (m * m), self.number % m, self.number // m % m
        node = pupil_cells.middle(i, j, m)
        middle, area = elements.place(face, mi.Point2f(*elements.middle), self.cut, part)
        _, lens_point, arrival, _, open_share = camera.open_arrival(middle.p, node)
        cos_s = dr.dot(middle.n, dr.normalize(lens_point - middle.p))
        active = (cos_s > 0) & (arrival > 0)
        shadow = self._shadow(scene, camera, faces, node, middle, active) if faces.shadows else None
        origin = mi.Vector2f(*(dr.opaque(mi.Float, n) for n in corner))
        images, values, shares, depths, mean = [], [], [], [], mi.Float64(0)
        open_mean = 0.75 * open_share
        for at in CORNERS:
            end, _ = elements.place(face, mi.Point2f(*at), self.cut, part)
            position, to, _, cos_theta, share = camera.open_arrival(end.p, node)
            profile = faces.surface.law.profile(middle, dr.normalize(to - end.p), active)
            cos4 = mi.Float64(etendue_from_pixel(cos_theta, True, camera.film_map.area_share(position)))
            images.append(mi.Point2d(position - origin))
            values.append(eq9(mi.Float64(profile), cos4))
            mean += cos4 / 3
            open_mean += share / 12  # exact where the share is a quadratic function of the place
            b = of_part(part, self.cut, mi.warp.square_to_uniform_triangle(mi.Point2f(*at)))
            shares.append([mi.Float64(1 - b.x - b.y), mi.Float64(b.x), mi.Float64(b.y)])
            depths.append(mi.Float64(camera.blur_disc(end.p)[2]))
            active &= dr.isfinite(position.x) & dr.isfinite(position.y)
        centre, radius, side = camera.blur_disc(middle.p)
        active &= side > 0
        cell = [pupil_cells.corner(i + x, j + y, m) for x, y in AROUND]
        tiles = [centre + radius * camera.opening(middle.p, c)[0] for c in cell]
        tile = [mi.Point2d(camera.film_map.from_ideal(mi.Point2f(corner)) - origin) for corner in tiles]
        own = dr.select(self.points, pupil_cells.area(cell), dr.pi / mi.Float(m * m))
        virtual_pixel = dr.opaque(mi.Float, camera.virtual_pitch**2)
        etendue = mi.Float64(etendue_from_surface(cos_s, area, open_mean * arrival, own, virtual_pixel))
        side = dr.opaque(mi.Float64, max(camera.film.shape) + 2 * MOST_RIM)
        ring, count, light_area, flat, constant = _polygon(images, tile, self.points, side)
        turn = _cross(images[1] - images[0], images[2] - images[0])
        large = (open_mean > 1 - WHOLE) & ~self.points & ~flat & (dr.abs(turn) > FILM_BASED)
        etendue = dr.select(large, 0.5 * dr.abs(turn) * mean * mi.Float64(own) / dr.pi, etendue)
        scale, spot = mi.Float64(1), None
        if shadow:
            wide = (light_area > WIDE * dr.square(mi.Float64(radius))) & by_points
            spot = shadow.spot(camera, origin, light_area, wide, active) if by_points else None
            active &= shadow.laid(wide)
            ring, count, scale = shadow.part.of_image(camera, origin, node, ring, count)
        # The falloff over the film, which is not linear over a large piece, is put back pixel by pixel.
        even = [falloff(camera, mi.Point2f(image) + origin) for image in images]
        cover = etendue / (light_area * mean)
        values = [cover / f * value for f, value in zip(even, values, strict=True)]
        return _Image(images, values, shares, depths, turn, flat, constant, cover, scale, ring, count, active, spot)

    def _shadow(
        self,
        scene: mi.Scene,
        camera: Camera,
        faces: FaceLight,
        node: mi.Point2f,
        middle: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> _Shadow:
        """What other surfaces hide of the lines' pieces, as seen through the nodes; `middle`: of the pieces."""
        part, elements, face = self.number // (self.m * self.m), faces.elements, self.face
        ends = [elements.place(face, mi.Point2f(*at), self.cut, part)[0].p for at in CORNERS]
        mixed = active & dr.gather(mi.Bool, from_numpy(mi.Bool, faces.mixed), face)
        lit_part = LitPart.of(scene, camera, node, ends, middle, mixed)
        i, j = self.number % self.m, self.number // self.m % self.m
        within, aim = pupil_cells.strata(i, j, self.m, face * pupil_cells.STRIDE + part)
        point = elements.place(face, within, self.cut, part)[0].p
        b = mi.warp.square_to_uniform_triangle(within)  # on slender pieces they do not follow from the point
        aim = dr.select(lit_part.some, node, aim)
        lit = ~hidden(scene, point, middle.n, camera.open_arrival(point, aim)[1], active)
        return _Shadow(lit_part, point, [1 - b.x - b.y, b.x, b.y], aim, lit)


@dataclass(frozen=True)
class _Image:
    """Images of pieces of faces: the three corners, the density of the light of J_n = 1 there, over the falloff of the
    film, the share of each corner of the face there, the depth up to a factor; twice the signed area; whether the
    density varies along the longest edge alone, and whether it is constant; the density of the coverage; the factor of
    these densities; the polygon that the light fills, see `Laid`; and light of random points."""

    corners: list[mi.Point2d]
    values: list[mi.Float64]
    shares: list[list[mi.Float64]]
    depths: list[mi.Float64]
    turn: mi.Float64
    flat: mi.Bool
    constant: mi.Bool
    cover: mi.Float64
    scale: mi.Float64
    ring: list[mi.Point2d]
    count: mi.UInt32
    active: mi.Bool
    spot: _Spot | None

    def of_corners(self) -> list[list[mi.Float64]]:
        """Density at the corners of the light of J_n = 1 at each corner of the face."""
        return _weights(self.values, self.shares, self.depths)

    def laid(self, densities: list[list[mi.Float64]]) -> tuple[Laid, Misfits | None]:
        """The image with these densities at its corners, and the light of random points that is missing in it."""
        scaled = ([self.scale * value for value in values] for values in densities)
        planes = [_plane(self.corners, values, self.turn, self.flat, self.constant) for values in scaled]
        return (planes, self.ring, self.count, self.active), self.spot.light(densities) if self.spot else None


@dataclass(frozen=True)
class _Shadow:
    """What other surfaces hide of pieces: the `part` of each that is lit, and whether a random `point` of it, with its
    barycentric coordinates `shares`, is lit from the point `aim` of the pupil."""

    part: LitPart
    point: mi.Point3f
    shares: list[mi.Float]
    aim: mi.Point2f
    lit: mi.Bool

    def laid(self, wide: mi.Bool) -> mi.Bool:
        """True where the image of a piece is laid, at least in part.

        Where no edge crosses it, `wide` images are laid as their corners are lit, so that only the light of the random
        point is added or taken away. Others are evened out by the blur, and laid as their point is lit.
        """
        return self.part.some | dr.select(wide, self.part.open, self.lit)

    def spot(self, camera: Camera, origin: mi.Vector2f, area: mi.Float64, wide: mi.Bool, active: mi.Bool) -> _Spot:
        """The random points at which that is wrong, for images of this `area` [pixels²]."""
        within = dr.select(self.part.some, self.part.contains(self.point), self.laid(wide))
        place = mi.Point2d(camera.open_arrival(self.point, self.aim)[0] - origin)
        wrong = active & (self.lit != within)
        return _Spot(self.shares, dr.select(self.lit, area, -area), place, wrong, self.part.some)


@dataclass(frozen=True)
class _Spot:
    """Random points of pieces at which their images are wrong: barycentric coordinates, `area` of the image [pixels²],
    negative where it is too bright, place on the film, where there is any, and whether an edge of a shadow crosses."""

    shares: list[mi.Float]
    area: mi.Float64
    place: mi.Point2d
    active: mi.Bool
    at_edge: mi.Bool

    def light(self, densities: list[list[mi.Float64]]) -> Misfits:
        """Their light, for densities of light at the corners of the pieces."""
        levels = [
            sum((mi.Float64(s) * d for s, d in zip(self.shares, density, strict=True)), mi.Float64(0))
            for density in densities
        ]
        return Misfits(self.place, [self.area * level for level in levels], self.active, self.at_edge, self.area)


@dataclass(frozen=True)
class Misfits:
    """Light of random points, some of them `active`, that images of pieces leave out, over that of a pixel filled by
    1 W/mm²/sr, negative where they let too much pass, for each column; their places on the film [pixels]; True where
    the edge of a shadow crosses the piece; and the area of its image [pixels²], negative as the light.

    Beside such edges few points are wrong, but by a whole piece each, where the edge is nearly exact; the others are
    the only sign of what hides a part of a piece.
    """

    place: mi.Point2d
    light: list[mi.Float64]
    active: mi.Bool
    at_edge: mi.Bool
    area: mi.Float64

    def on_film(self, shape: tuple[int, int]) -> tuple[Index, Index, Array, Mask, Mask]:
        """Row and column on a film of `shape` (h, w), light of each column (c, n), True at edges, and True for a piece
        whose image is larger than `LARGE`, (n,) each."""
        some = dr.compress(self.active)
        columns = (self.place.y, self.place.x, self.area, *self.light)
        y, x, area, *light = (dr.gather(mi.Float64, column, some).numpy() for column in columns)
        row, column = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
        on = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        at_edge = dr.gather(mi.Bool, self.at_edge, some).numpy()
        return row[on], column[on], np.stack(light)[:, on], at_edge[on], np.abs(area[on]) > LARGE


def falloff(camera: Camera, position: mi.Point2f) -> mi.Float64:
    """cos⁴θ of the line of sight from the middle of the pupil to a film position [pixels], times its share of area."""
    x = mi.Point2d(camera.film_map.to_plane(position)) * (1 - camera.lens.discs[0].shift)
    squared = dr.square(dr.opaque(mi.Float64, camera.lens.focus_distance))
    return dr.square(squared / (squared + dr.squared_norm(x))) * mi.Float64(camera.film_map.area_share(position))


def falloff_on_pixels(camera: Camera, x: Index, y: Index, corner: tuple[float, float]) -> Array:
    """Mean of `falloff` over pixels (n,), in columns x and rows y from the `corner` (x, y) on the film."""
    left, top = from_numpy(mi.Float, x + corner[0]), from_numpy(mi.Float, y + corner[1])
    even = np.zeros(len(x))
    for a in GAUSS if x.size else ():
        for b in GAUSS:
            even += falloff(camera, mi.Point2f(left + a, top + b)).numpy() / len(GAUSS) ** 2
    return even


def _weights(
    values: list[mi.Float64], shares: list[list[mi.Float64]], depths: list[mi.Float64]
) -> list[list[mi.Float64]]:
    """Density of the light of each of three columns at the corners of an image.

    values : density of all light at the corners; shares : φ of each column there; depths : up to a factor

    On the film φ is not linear but, with λ the barycentric coordinates of the image and δ the relative depth,
    λ_k (1 - δ_k + Σ λ_m δ_m) to first order: on average over the image (Σ δ - 3 δ_k)/12 more than λ_k.
    """
    mean_depth = (depths[0] + depths[1] + depths[2]) / 3
    more = [(1 - depth / mean_depth) / 4 for depth in depths]  # where Σ δ = 0
    mean = (values[0] + values[1] + values[2]) / 3
    weights = []
    for k in range(3):
        shift = sum((more[c] * shares[c][k] for c in range(3)), mi.Float64(0)) * mean
        weights.append([values[c] * shares[c][k] + shift for c in range(3)])
    return weights


def _polygon(
    images: list[mi.Point2d], tile: list[mi.Point2d], points: mi.Bool, side: mi.Float64
) -> tuple[list[mi.Point2d], mi.UInt32, mi.Float64, mi.Bool, mi.Bool]:
    """Polygon that the light fills: the image of a piece or of a cell, or a small square where that has no size.

    Beside it the number of its edges, its area [pixels²], True where it is too flat for a density that is linear in two
    coordinates on a film of this `side` [pixels], and True where the density is constant: of cells and of squares.
    """
    ring = [dr.select(points, t, c) for t, c in zip(tile, (*images, images[0]), strict=True)]
    area = 0.5 * dr.abs(_cross(ring[2] - ring[0], ring[3] - ring[1]))
    longest, reach = mi.Float64(0), mi.Float64(side)
    for k in range(4):
        longest = dr.maximum(longest, dr.squared_norm(ring[k] - ring[k - 1]))
        reach = dr.maximum(reach, dr.maximum(dr.abs(ring[k].x), dr.abs(ring[k].y)))
    flat = 2 * area < LEAST_HEIGHT * reach * dr.sqrt(longest)
    none = ~(area > LEAST_AREA)
    count = dr.select(points | none, mi.UInt32(4), 3)
    middle = 0.25 * (ring[0] + ring[1] + ring[2] + ring[3])
    speck = [middle + SPECK * mi.Vector2d(x, y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ring = [dr.select(none, s, own) for s, own in zip(speck, ring, strict=True)]
    return ring, count, dr.select(none, 4 * SPECK**2, area), flat | none, points | none


def _plane(
    images: list[mi.Point2d], values: list[mi.Float64], turn: mi.Float64, flat: mi.Bool, constant: mi.Bool
) -> Plane:
    """The linear density with these values at three corners, `turn` twice their signed area.

    Where they are `flat`, that along their longest edge of the same light and first moment; or their mean.
    """
    a, b = images[1] - images[0], images[2] - images[0]
    u, v = values[1] - values[0], values[2] - values[0]
    middle, mean = (1 / 3) * (images[0] + images[1] + images[2]), (1 / 3) * (values[0] + values[1] + values[2])
    edge = dr.select(dr.squared_norm(a) > dr.squared_norm(b), a, b)
    edge = dr.select(dr.squared_norm(b - a) > dr.squared_norm(edge), b - a, edge)
    places = [dr.dot(image - middle, edge) for image in images]
    moment = sum((place * value for place, value in zip(places, values, strict=True)), mi.Float64(0))
    along = moment / sum(map(dr.square, places), mi.Float64(0)) * edge
    x = dr.select(flat, along.x, (u * b.y - v * a.y) / turn)
    y = dr.select(flat, along.y, (v * a.x - u * b.x) / turn)
    x, y = dr.select(constant, 0, x), dr.select(constant, 0, y)
    return Plane(mean - x * middle.x - y * middle.y, x, y)


def _cross(a: mi.Vector2d, b: mi.Vector2d) -> mi.Float64:
    return a.x * b.y - a.y * b.x
