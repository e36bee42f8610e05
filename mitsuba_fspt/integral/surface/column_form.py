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
from ...jit.loops import repeat
from ..lines.eq9 import eq9, etendue_from_pixel, etendue_from_surface
from ..lines.occlusion import hidden
from . import pupil_cells
from .column_canvas import ColumnCanvas, Plane, Windows
from .face_light import CORNERS, DROP, ColumnRule, FaceLight, Plan
from .footprint import SPECK
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
INWARD = 0.05  # of a face: distance from its sides at which rays start that search for the edge of a shadow
HALVINGS = 4  # of a side of a piece, for the edge of a shadow
PARABOLA = 4 / 3  # area between a parabola and its chord, over that of the triangle of the same height
MOST_WORK, LEAST_WORK = 1 << 22, 1 << 20  # entries of windows that are accumulated at a time; with half, 10 % slower
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
    corners = mi.UInt32(faces.corners.ravel().astype(np.uint32))
    for some, cells, cuts, points, taken in plan.of(index).passes():
        items = np.stack([index[some], cells, cuts, points, taken @ (1 << np.arange(taken.shape[1]))])
        for run in batch_slices((items[1] * items[2]) ** 2):
            part = items[:, run]
            lines = FaceLines.numbered(part[:4])
            face, mask = lines.face, dr.gather(mi.UInt32, mi.UInt32(part[4].astype(np.uint32)), lines.row)
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
        row = mi.UInt32(row.astype(np.uint32))
        face, m, cut, at = (dr.gather(mi.UInt32, mi.UInt32(of.astype(np.uint32)), row) for of in items)
        # Array entries beyond the last line gather 0, and whole numbers divided by 0 end the process.
        return cls(face, dr.maximum(m, 1), dr.maximum(cut, 1), at > 0, mi.UInt32(number.astype(np.uint32)), row)

    def columns(self, scene: mi.Scene, camera: Camera, faces: FaceLight, on: str) -> Laid:
        """The light of J_n = 1 of each column of the face, on the crop window."""
        image = self._image(scene, camera, faces, camera.film.crop_offset)
        return image.laid([image.values] if on == "face" else image.of_corners())

    def light(
        self,
        scene: mi.Scene,
        camera: Camera,
        faces: FaceLight,
        exitance: Sequence[mi.Float],
        corner: tuple[float, float],
    ) -> Laid:
        """The light of J_n with the values `exitance` at the three corners of each face, and the coverage, on a film
        whose first pixel has this `corner` (x, y)."""
        image = self._image(scene, camera, faces, corner)
        levels = [mi.Float64(dr.gather(mi.Float, own, self.face)) for own in exitance]
        light = [
            sum((w[c] * level for w, level in zip(image.of_corners(), levels, strict=True)), mi.Float64(0))
            for c in range(3)
        ]
        return image.laid([light, [image.cover] * 3])

    def _image(self, scene: mi.Scene, camera: Camera, faces: FaceLight, corner: tuple[float, float]) -> _Image:
        """The image of the lines' pieces through the nodes, or of the nodes' cells through the pieces."""
        m, elements, face = self.m, faces.elements, self.face
        part, i, j = self.number // (m * m), self.number % m, self.number // m % m
        node = pupil_cells.middle(i, j, m)
        middle, area = elements.place(face, mi.Point2f(*elements.middle), self.cut, part)
        _, lens_point, arrival, _, open_share = camera.open_arrival(middle.p, node)
        cos_s = dr.dot(middle.n, dr.normalize(lens_point - middle.p))
        active = (cos_s > 0) & (arrival > 0)
        lit_part = None
        if faces.shadows:
            ends = [elements.place(face, mi.Point2f(*at), self.cut, part)[0].p for at in CORNERS]
            mixed = active & dr.gather(mi.Bool, mi.Bool(faces.mixed), face)
            lit_part = _LitPart.of(scene, camera, node, ends, middle.p, mixed)
            within, aim = pupil_cells.strata(i, j, m, face * pupil_cells.STRIDE + part)
            spot, _ = elements.place(face, within, self.cut, part)
            asked = active & ~lit_part.some
            active &= ~hidden(scene, spot.p, camera.open_arrival(spot.p, aim)[1], asked)
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
        film = camera.film_map.from_ideal
        tiles = [centre + radius * camera.opening(middle.p, c)[0] for c in cell]
        tile = [mi.Point2d(film(mi.Point2f(corner)) - origin) for corner in tiles]
        own = dr.select(self.points, pupil_cells.area(cell), dr.pi / mi.Float(m * m))
        virtual_pixel = dr.opaque(mi.Float, camera.virtual_pitch**2)
        etendue = mi.Float64(etendue_from_surface(cos_s, area, open_mean * arrival, own, virtual_pixel))
        side = dr.opaque(mi.Float64, max(camera.film.shape) + 2 * MOST_RIM)
        ring, count, light_area, flat, constant = _polygon(images, tile, self.points, side)
        turn = _cross(images[1] - images[0], images[2] - images[0])
        large = (open_mean > 1 - WHOLE) & ~self.points & ~flat & (dr.abs(turn) > FILM_BASED)
        etendue = dr.select(large, 0.5 * dr.abs(turn) * mean * mi.Float64(own) / dr.pi, etendue)
        if lit_part:
            ring, count, etendue = lit_part.of_image(camera, origin, node, ring, count, etendue)
        # The falloff over the film, which is not linear over a large piece, is put back pixel by pixel.
        even = [falloff(camera, mi.Point2f(image) + origin) for image in images]
        cover = etendue / (light_area * mean)
        values = [cover / f * value for f, value in zip(even, values, strict=True)]
        return _Image(images, values, shares, depths, turn, flat, constant, cover, ring, count, active)


@dataclass(frozen=True)
class _LitPart:
    """The part of triangles that is lit, where the edge of a shadow cuts off one of their corners.

    some : True where it does. first, second, third : the corners, that one first. lit : True where it is the lit one.
    along : shares of the sides from it to the two others where the edge crosses them
    beyond : share of the way from the corner to the chord between these by which the edge lies beyond its middle
    """

    some: mi.Bool
    first: mi.Point3f
    second: mi.Point3f
    third: mi.Point3f
    lit: mi.Bool
    along: mi.Point2f
    beyond: mi.Float

    @classmethod
    def of(
        cls,
        scene: mi.Scene,
        camera: Camera,
        node: mi.Point2f,
        ends: list[mi.Point3f],
        middle: mi.Point3f,
        active: mi.Bool,
    ) -> _LitPart:
        """Of triangles with the corners `ends` as seen through a node of the pupil; found by bisection."""

        def open_from(point: mi.Point3f, asked: mi.Bool) -> mi.Bool:
            start = point + INWARD * (middle - point)
            return asked & ~hidden(scene, start, camera.open_arrival(start, node)[1], asked)

        seen = [open_from(end, active) for end in ends]
        some = active & ((seen[0] != seen[1]) | (seen[0] != seen[2]))
        odd = [seen[1] == seen[2], seen[0] == seen[2]]  # else the third

        def turned(k: int) -> mi.Point3f:
            return dr.select(odd[0], ends[k], dr.select(odd[1], ends[(k + 1) % 3], ends[(k + 2) % 3]))

        first, second, third = (turned(k) for k in range(3))
        lit = dr.select(odd[0], seen[0], dr.select(odd[1], seen[1], seen[2]))

        def halve(k: mi.UInt32, place: mi.Point3f, width: mi.Float) -> tuple[mi.Point3f, mi.Float]:
            on_side, across = k < sides, k % 2 == 1
            share = dr.select(on_side, dr.select(across, place.y, place.x), place.z)
            way = dr.select(across, third, second) - first
            middle_way = 0.5 * (place.x * (second - first) + place.y * (third - first))
            point = first + share * dr.select(on_side, way, middle_way)
            share += dr.select(open_from(point, some) == lit, 1.0, -1.0) * width
            place = mi.Point3f(
                dr.select(on_side & ~across, share, place.x),
                dr.select(on_side & across, share, place.y),
                dr.select(on_side, _farthest(place) / 2, share),
            )
            last = k + 1 == sides
            halved = dr.select(on_side & ~across, width, 0.5 * width)
            return place, dr.select(last, _farthest(place) / 4, halved)

        sides = dr.opaque(mi.UInt32, 2 * HALVINGS)
        place, _ = repeat(dr.select(some, sides + HALVINGS, 0), halve, mi.Point3f(0.5), mi.Float(0.25))
        along, beyond = _shadow_edge(place)
        return cls(some, first, second, third, lit, along, beyond)

    def of_image(
        self,
        camera: Camera,
        origin: mi.Vector2f,
        node: mi.Point2f,
        ring: list[mi.Point2d],
        count: mi.UInt32,
        etendue: mi.Float64,
    ) -> tuple[list[mi.Point2d], mi.UInt32, mi.Float64]:
        """Polygon, number of edges and étendue of images through a node of the pupil, without the dark parts.

        The edge counts as a parabola: the polygon ends at its chord, with the light of the area beyond in the étendue.
        Of an image that is no triangle, see `_polygon`, not the polygon but the étendue becomes smaller.
        """
        whole = count == 4
        chord = mi.Float64(self.along.x * self.along.y)
        corner = dr.clip(chord * (1 + PARABOLA * mi.Float64(self.beyond)), 0, 1)
        share = dr.select(self.lit, corner, 1 - corner)
        share /= dr.select(whole, 1, dr.maximum(dr.select(self.lit, chord, 1 - chord), 1e-6))
        etendue = dr.select(self.some, etendue * share, etendue)
        sides = (self.along.x, self.second), (self.along.y, self.third)
        a, b = (self.first + share * (end - self.first) for share, end in sides)
        corners = [
            dr.select(self.lit, self.first, a),
            dr.select(self.lit, a, self.second),
            dr.select(self.lit, b, self.third),
            dr.select(self.lit, self.first, b),
        ]
        cut = self.some & ~whole
        images = [mi.Point2d(camera.open_arrival(corner, node)[0] - origin) for corner in corners]
        ring = [dr.select(cut, new, old) for new, old in zip(images, ring, strict=True)]
        return ring, dr.select(cut, dr.select(self.lit, mi.UInt32(3), 4), count), etendue


def _farthest(place: mi.Point3f) -> mi.Float:
    """Where the median of the chord between two sides ends in the triangle, in chords; no farther than twice as far."""
    return dr.minimum(2, 2 / dr.maximum(place.x + place.y, 0.5))


def _shadow_edge(place: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
    """Where the edge of a shadow crosses two sides of a triangle, and how far it lies beyond the chord between.

    place : where it crosses these sides and the median between, of a triangle smaller by `INWARD`: shares of the sides
        from their common corner, and of the way to the chord there

    With barycentric coordinates λ of the other two corners the chord is λ₂/a + λ₃/b = 1; on each of the smaller sides
    one of them is `INWARD`/3. A share of the way beyond the chord is λ₂/a + λ₃/b - 1.
    """
    least = INWARD / 3
    x, y = ((1 - INWARD) * share + least for share in (place.x, place.y))
    lines = x * y - least * least
    a, b = dr.minimum(lines / (y - least), 1), dr.minimum(lines / (x - least), 1)
    there = [0.5 * (1 - INWARD) * place.z * share + least for share in (place.x, place.y)]
    return mi.Point2f(a, b), there[0] / a + there[1] / b - 1


@dataclass(frozen=True)
class _Image:
    """Images of pieces of faces: the three corners, the density of the light of J_n = 1 there, over the falloff of the
    film, the share of each corner of the face there, the depth up to a factor; twice the signed area; whether the
    density varies along the longest edge alone, and whether it is constant; the density of the coverage; and the
    polygon that the light fills, see `Laid`."""

    corners: list[mi.Point2d]
    values: list[mi.Float64]
    shares: list[list[mi.Float64]]
    depths: list[mi.Float64]
    turn: mi.Float64
    flat: mi.Bool
    constant: mi.Bool
    cover: mi.Float64
    ring: list[mi.Point2d]
    count: mi.UInt32
    active: mi.Bool

    def of_corners(self) -> list[list[mi.Float64]]:
        """Density at the corners of the light of J_n = 1 at each corner of the face."""
        return _weights(self.values, self.shares, self.depths)

    def laid(self, densities: list[list[mi.Float64]]) -> Laid:
        """The image with these densities at its corners."""
        planes = [_plane(self.corners, values, self.turn, self.flat, self.constant) for values in densities]
        return planes, self.ring, self.count, self.active


def falloff(camera: Camera, position: mi.Point2f) -> mi.Float64:
    """cos⁴θ of the line of sight from the middle of the pupil to a film position [pixels], times its share of area."""
    x = mi.Point2d(camera.film_map.to_plane(position)) * (1 - camera.lens.discs[0].shift)
    squared = dr.square(dr.opaque(mi.Float64, camera.lens.focus_distance))
    return dr.square(squared / (squared + dr.squared_norm(x))) * mi.Float64(camera.film_map.area_share(position))


def falloff_on_pixels(camera: Camera, x: Index, y: Index, corner: tuple[float, float]) -> Array:
    """Mean of `falloff` over pixels (n,), in columns x and rows y from the `corner` (x, y) on the film."""
    left, top = mi.Float(x + float(corner[0])), mi.Float(y + float(corner[1]))
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
