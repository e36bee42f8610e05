"""Columns of the transport matrix: Eq. 9 in its surface form (M.9) for unit J_n of one vertex or face at a time.

Every face sends its light through M × M nodes of the pupil. Through one node the image of a flat triangle is a
triangle, and the étendue that a pixel takes of it is cos⁴θ (Eq. M.5) times the part of the pixel inside: the light of
each of its columns, linear over the triangle, is distributed exactly over the pixels (`ColumnCanvas`), whatever the
sizes of face and pixel. Only the pupil is sampled. Of a face much smaller than its blur disc not the face but the pupil
is laid: the images of the pupil's cells through the middle of a piece, which tile the blur disc.

All columns are computed twice, with the cells and pieces of `ColumnRule` and with half of them; the difference of the
two shows what is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..emission.elements import Elements, elements_of, of_part
from ..jit.batches import BATCH, batch_slices, numbered
from ..jit.mesh_buffers import triangles
from . import pupil_cells
from .column_canvas import ColumnCanvas, Plane, Windows
from .eq9 import eq9, etendue_from_pixel, etendue_from_surface
from .occlusion import hidden

CORNERS = ((0, 0), (1, 0), (0, 1))  # of a face, in the square that `Elements.place` maps to it
AROUND = ((0, 0), (1, 0), (1, 1), (0, 1))  # of a cell of the pupil
MARGIN, RIM = 0.05, 0.02  # by which bounds exceed the light: in pixels, for float32, and of the blur radius, for cells
RIM_POINTS = 8  # of the pupil, by which a second border is found to cut it
SPECK, LEAST_AREA = 2.0**-4, 2.0**-20  # half a side of the square [pixels] that stands for a smaller image [pixels²]
LEAST_HEIGHT = 2.0**-5  # pixels: over a flatter image the density is taken as constant
FILM_BASED = 1.0  # pixels: sides from which the étendue is that of the image, exact however large it is
GAUSS = (0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3))  # nodes on the side of a pixel
LONGEST = 1e6  # pixels: side counted for a face that reaches through the lens plane and has no image
MOST_WORK = 1 << 25  # entries of windows that are accumulated at a time

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ColumnRule:
    """Numbers of cells and pieces, each with the error it bounds.

    edge : error at an edge of J_n between two faces, over its step: cells M along the pupil are
        √(edge_factor · r^1.2/edge) for a blur radius r [pixels]
    edge_factor : by what middles of cells leave of a half plane averaged over pixels, the most of all directions and
        offsets; fitted for r = 0.3 … 4, M = 2 … 16
    fewest, most : least and largest M
    partial : least M where a face turns away from part of the pupil, or a second border cuts the pupil
    mixed : least M where one surface may hide another
    cells : M where the cells are laid; their étendue is constant in each
    point : largest piece [pixels] that may be taken as a point then; it misplaces light by its square
    piece : largest piece [pixels], over which étendue and exit law are linear
    perspective : J_n that perspective, corrected on average, misplaces within a piece, over its change along the face:
        pieces along a side of a face of relative depth δ are √(δ/(8 · perspective))
    shadow : largest piece [pixels] where one surface may hide another: lines of sight through a piece are sampled
    drop : entries below this share of a column's brightest are left out
    """

    edge: float
    edge_factor: float = 0.13
    fewest: int = 4
    most: int = 64
    partial: int = 12
    mixed: int = 16
    cells: int = 6
    point: float = 0.5
    piece: float = 8.0
    perspective: float = 2e-3
    shadow: float = 0.7
    drop: float = 1e-5

    @classmethod
    def of(cls, rtol: float, on: str) -> ColumnRule:
        """The rule for a tolerance relative to the brightest pixel: columns are right to some ten times that.

        Between neighbouring vertices J_n is continuous, between faces it steps.
        """
        edge = {"vertex": 3.0, "face": 1.5}[on] * rtol
        finer = math.sqrt(min(rtol / 1e-3, 1))
        cells = 2 * math.ceil(3 / math.sqrt(finer))
        partial = 2 * math.ceil(6 / math.sqrt(finer))
        return cls(
            edge,
            cells=cells,
            partial=partial,
            mixed=2 * math.ceil(8 / math.sqrt(finer)),
            point=0.5 * finer,
            shadow=0.7 * finer,
            perspective=2 * rtol,
            drop=1e-2 * rtol,
        )


@dataclass(frozen=True)
class Plan:
    """How each of some faces is divided: M of the pupil, pieces along a side, and whether its cells are laid."""

    cells: Index
    cuts: Index
    points: Mask

    @property
    def lines(self) -> Index:
        """Lines of sight of each face."""
        return (self.cells * self.cuts) ** 2

    def halved(self) -> Plan:
        """Half as many cells and pieces, where there are enough."""
        return Plan(np.maximum(2 * (self.cells // 4), 2), np.maximum((self.cuts + 1) // 2, 1), self.points)


@dataclass(frozen=True)
class FaceLight:
    """The faces of one mesh as a lens sees them.

    corners (F, 3): numbers of their vertices. low, high (F, 2): bounds of their light [pixels of the crop window],
    empty for a face that sends none. sides, blur (F,): longest edge and blur radius of the image [pixels]. slant (F,):
    depth of the face over its distance. partial (F,): only part of the pupil takes light of the face. mixed (F,): one
    surface hides part of another here.
    """

    emitter: mi.Emitter
    elements: Elements
    corners: Index
    low: Array
    high: Array
    sides: Array
    blur: Array
    slant: Array
    partial: Mask
    mixed: Mask
    shadows: bool

    @classmethod
    def seen(cls, emitter: mi.Emitter, lens: mi.Sensor, origin: tuple[int, int], shape: tuple[int, int]) -> FaceLight:
        """What `lens` sees of an emitting mesh on the crop window of `shape` (h, w) at `origin` (x, y)."""
        mesh = emitter.get_shape()
        positions, faces = triangles(mesh)
        vertices = positions.numpy().reshape(-1, 3).astype(np.float64)
        corners = faces.numpy().reshape(-1, 3).astype(np.int64)
        centre, radius = lens.film_discs(vertices)
        centre -= origin
        reach = radius * (1 + RIM) + MARGIN
        low, high = (centre - reach)[corners].min(axis=1), (centre + reach)[corners].max(axis=1)
        blur = radius[:, 0][corners].max(axis=1)
        edges = centre[corners] - centre[np.roll(corners, 1, axis=1)]
        sides = np.hypot(edges[..., 0], edges[..., 1]).max(axis=1)
        elements = elements_of(mesh, minimum=1)
        most, least, rim = _facing(elements, lens)
        size = np.array(shape[::-1])
        beside = ((high <= 0) | (low >= size)).any(axis=1)
        area = np.isfinite(most)  # a face without area has no normal
        dark = beside | (most <= 0) | (rim == 0) | ~area
        low[dark], high[dark] = np.inf, -np.inf
        partial = ~dark & ((least < 0) | (rim < 1))
        none = np.zeros(len(corners), bool)
        depth = _scales(mesh, lens)[corners]
        slant = np.ptp(depth, axis=1) / np.maximum(np.abs(depth).min(axis=1), 1e-3 * np.abs(depth).max(axis=1))
        bounded = np.isfinite(blur)
        sides, blur = np.where(bounded, sides, np.inf), np.where(bounded, blur, math.hypot(*shape))
        return cls(emitter, elements, corners, low, high, sides, blur, slant, partial, none, shadows=False)

    @property
    def bright(self) -> Mask:
        """Faces that may send light."""
        return self.low[:, 0] <= self.high[:, 0]

    def behind(self, scene: mi.Scene, lens: mi.Sensor) -> FaceLight:
        """The same in a scene where one surface may hide another: faces that none of their lines shows are dark."""
        bright = np.flatnonzero(self.bright)
        if not bright.size:
            return self
        share = np.zeros(len(self.corners))
        share[bright] = _open_share(scene, lens, self.elements, bright)
        count = int(self.corners.max(initial=-1)) + 1
        least, most = np.ones(count), np.zeros(count)
        for k in range(3):
            np.minimum.at(least, self.corners[bright, k], share[bright])
            np.maximum.at(most, self.corners[bright, k], share[bright])
        around = least[self.corners].min(axis=1), most[self.corners].max(axis=1)
        mixed = self.bright & (around[0] < 1) & (around[1] > 0)
        hidden_all = self.bright & (around[1] == 0)
        low, high = self.low.copy(), self.high.copy()
        low[hidden_all], high[hidden_all] = np.inf, -np.inf
        return replace(self, low=low, high=high, mixed=mixed, shadows=True)

    def plan(self, rule: ColumnRule) -> Plan:
        """How the faces are divided: the cheaper of nodes with images of pieces and pieces with images of cells."""
        sides = np.minimum(self.sides, LONGEST)
        fewest = np.where(self.partial, rule.partial, np.where(self.mixed, rule.mixed, rule.fewest))
        nodes = np.sqrt(rule.edge_factor * self.blur**1.2 / rule.edge)
        nodes = np.maximum(nodes, 2 * self.blur / np.maximum(sides, 1e-3))  # their images overlap
        nodes = (2 * np.ceil(nodes / 2)).clip(fewest, None)
        pieces = np.ceil(sides / np.where(self.mixed, rule.shadow, rule.piece))
        # Within a pixel perspective misplaces nothing.
        pieces = np.maximum(pieces, np.minimum(np.sqrt(self.slant / (8 * rule.perspective)), sides))
        pieces = np.maximum(np.ceil(pieces), 1)
        cells = np.where(self.partial, rule.partial, rule.cells)
        by_nodes = (nodes * pieces) ** 2 * (1 + sides / pieces)
        by_cells = (cells * pieces) ** 2 * (1 + 2 * self.blur / cells)
        as_points = (sides <= rule.point * pieces) & (by_cells < by_nodes)
        cells = np.where(as_points, cells, np.minimum(nodes, rule.most)).astype(np.int64)
        pieces = np.minimum(pieces.astype(np.int64), math.isqrt(BATCH) // cells)
        return Plan(cells, pieces, as_points)


def _scales(mesh: mi.Shape, lens: mi.Sensor) -> Array:
    """Of every vertex the side of a virtual pixel at its depth [mm], which is linear in the depth."""
    positions = triangles(mesh)[0]
    return lens.blur_disc(dr.unravel(mi.Point3f, positions))[2].numpy().astype(np.float64)


def _facing(elements: Elements, lens: mi.Sensor) -> tuple[Array, Array, Array]:
    """n·(a − r) of faces at the most and at the least [mm], and the share of the pupil's rim that is open to them.

    Over the corners r of a face and the points a of the pupil; NaN where a face has no normal.
    """
    index = dr.arange(mi.UInt32, elements.count)
    axis = dr.normalize(lens.world_transform() @ mi.Vector3f(0, 0, 1))
    most, least = np.full(elements.count, -np.inf), np.full(elements.count, np.inf)
    for corner in CORNERS:
        si, _ = elements.place(index, mi.Point2f(*corner))
        _, middle, _, _ = lens.arrival(si.p, mi.Point2f(0))
        _, rim, _, _ = lens.arrival(si.p, mi.Point2f(1, 0))
        towards = dr.dot(si.n, middle - si.p)
        spread = dr.norm(rim - middle) * dr.safe_sqrt(1 - dr.square(dr.dot(si.n, axis)))
        most = np.maximum(most, (towards + spread).numpy())
        least = np.minimum(least, (towards - spread).numpy())
    open_rim = mi.Float(0)
    si, _ = elements.place(index, mi.Point2f(*elements.middle))
    turns = dr.two_pi * np.arange(RIM_POINTS) / RIM_POINTS
    for turn in turns:
        _, _, weight, _ = lens.arrival(si.p, mi.Point2f(*(dr.opaque(mi.Float, f(turn)) for f in (math.cos, math.sin))))
        open_rim += dr.select(weight > 0, 1 / RIM_POINTS, 0)
    if len(lens.optics.discs) > 1:  # the middle of the pupil may be open where its rim is not
        _, _, weight, _ = lens.arrival(si.p, mi.Point2f(0))
        open_rim = dr.select(weight > 0, dr.maximum(open_rim, 0.5 / RIM_POINTS), open_rim)
    return most, least, np.broadcast_to(open_rim.numpy(), elements.count)


def _open_share(scene: mi.Scene, lens: mi.Sensor, elements: Elements, faces: Index, cells: int = 4) -> Array:
    """Share of the lines of sight of each of some faces that nothing blocks, of `cells`² lines."""
    index = mi.UInt32(np.repeat(faces, cells**2).astype(np.uint32))
    number = mi.UInt32(np.tile(np.arange(cells**2), len(faces)).astype(np.uint32))
    m = mi.UInt32(cells)
    within, aim = pupil_cells.strata(number % m, number // m, m, index * pupil_cells.STRIDE)
    spot, _ = elements.place(index, within)
    _, lens_point, arrival, _ = lens.arrival(spot.p, mi.warp.square_to_uniform_disk_concentric(aim))
    reaches = (arrival > 0) & (dr.dot(spot.n, lens_point - spot.p) > 0)
    blocked = reaches & hidden(scene, spot.p, lens_point, reaches)
    counted = [np.asarray(flag.numpy()).reshape(-1, cells**2).sum(axis=1) for flag in (reaches, blocked)]
    return 1 - counted[1] / np.maximum(counted[0], 1)


@dataclass(frozen=True)
class Columns:
    """Light of the columns of one mesh on the film: `counts` (n,) entries of each, and of every entry the pixel, row by
    row from the first of the crop window, the light, and by how much half the cells and pieces change it.

    Light is over that of a pixel whose pupil is filled by 1 W/mm²/sr, for J_n = 1 W/mm²: 1/π at the most for Lambert's
    law; times the pixel's étendue it is an entry of T [mm²]. `exact` (n,): columns of which no face is hidden in part,
    whose sums are those of form factors.
    """

    counts: Index
    pixels: Index
    light: Array
    change: Array
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
    lens: mi.Sensor,
    faces: FaceLight,
    windows: Windows,
    on: str,
    rule: ColumnRule,
    progress: Callable[[float], None] | None = None,
) -> Columns:
    """Columns of one mesh, accumulated on some windows at a time; `progress` is called with the share done."""
    film = lens.film()
    shape = (int(film.crop_size()[1]), int(film.crop_size()[0]))
    plan = faces.plan(rule)
    parts = []
    groups = list(_groups(windows))
    for number, group in enumerate(groups):
        if progress:
            progress(number / len(groups))
        some = windows.of(group)
        inside = group if on == "face" else group[faces.corners].any(axis=1)
        index = np.flatnonzero(faces.bright & inside)
        fine, coarse = (_laid(scene, lens, faces, index, p, some, on, shape) for p in (plan, plan.halved()))
        parts.append(_kept(some, fine, coarse, rule, lens, shape))
    order = np.argsort(np.concatenate([part[0] for part in parts]), kind="stable") if len(parts) > 1 else slice(None)
    column, pixels, light, change = (np.concatenate(some)[order] for some in zip(*parts, strict=True))
    exact = ~faces.mixed
    if on == "vertex":
        exact = np.ones(len(windows.left), bool)
        exact[faces.corners[faces.mixed].ravel()] = False
    return Columns(np.bincount(column, minlength=len(windows.left)), pixels, light, change, exact)


def _groups(windows: Windows) -> Iterator[Mask]:
    """Columns in groups of at most `MOST_WORK` entries, neighbours on the film together; at least one group."""
    areas = windows.areas
    if areas.sum() <= MOST_WORK:
        yield np.ones(len(areas), bool)
        return
    middle = np.stack([windows.top + windows.height // 2, windows.left + windows.width // 2])
    band = max(int(np.median(windows.height[windows.height > 0])) * 4, 1)
    order = np.lexsort((middle[1], middle[0] // band))
    number = np.cumsum(areas[order]) // MOST_WORK
    for k in np.unique(number):
        group = np.zeros(len(areas), bool)
        group[order[number == k]] = True
        yield group


def _kept(
    windows: Windows, fine: Array, coarse: Array, rule: ColumnRule, lens: mi.Sensor, shape: tuple[int, int]
) -> tuple:
    """Column, pixel, light and change of the entries that count, in the order of the columns."""
    column = windows.columns()
    some = np.flatnonzero((fine > 0) & windows.inside())
    starts = np.cumsum(windows.areas) - windows.areas
    brightest = np.zeros(len(windows.left))
    filled = windows.areas > 0
    if filled.any():
        brightest[filled] = np.maximum.reduceat(fine, starts[filled])
    some = some[fine[some] > rule.drop * brightest[column[some]]]
    if not some.size:
        return column[some], some, fine[some], coarse[some]
    y, x = windows.rows_of_film()[some], windows.columns_of_film()[some]
    offset = lens.film().crop_offset()
    left, top = mi.Float(x + float(offset[0])), mi.Float(y + float(offset[1]))
    even = np.mean([falloff(lens, mi.Point2f(left + a, top + b)).numpy() for a in GAUSS for b in GAUSS], axis=0)
    return column[some], y * shape[1] + x, even * fine[some], even * (fine - coarse)[some]


def _laid(
    scene: mi.Scene,
    lens: mi.Sensor,
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
    for run in batch_slices(plan.lines[index]):
        part = index[run]
        row, number = numbered(plan.lines[part])
        of = [part, plan.cells[part], plan.cuts[part], plan.points[part]]
        row = mi.UInt32(row.astype(np.uint32))
        face, m, cut, points = (dr.gather(mi.UInt32, mi.UInt32(values.astype(np.uint32)), row) for values in of)
        # Array entries beyond the last line gather 0, and whole numbers divided by 0 end the process.
        lines = _Lines(face, dr.maximum(m, 1), dr.maximum(cut, 1), points > 0, mi.UInt32(number.astype(np.uint32)))
        planes, ring, count, active = lines.image(scene, lens, faces, on)
        columns = [face] if on == "face" else [dr.gather(mi.UInt32, corners, 3 * face + k) for k in range(3)]
        canvas.lay(columns, planes, ring, count, active)
        canvas.evaluate()
    return canvas.light()


@dataclass(frozen=True)
class _Lines:
    """Lines of sight of one launch: face, M, pieces along a side, whether cells are laid, number within the face."""

    face: mi.UInt32
    m: mi.UInt32
    cut: mi.UInt32
    points: mi.Bool
    number: mi.UInt32

    def image(
        self, scene: mi.Scene, lens: mi.Sensor, faces: FaceLight, on: str
    ) -> tuple[list[Plane], list[mi.Point2d], mi.UInt32, mi.Bool]:
        """Density of the light of each column, the polygon on the crop window that it fills with the number of
        its edges, and where there is any."""
        m, elements, face = self.m, faces.elements, self.face
        part, i, j = self.number // (m * m), self.number % m, self.number // m % m
        node = pupil_cells.middle(i, j, m)
        middle, area = elements.place(face, mi.Point2f(*elements.middle), self.cut, part)
        _, lens_point, arrival, _ = lens.arrival(middle.p, node)
        cos_s = dr.dot(middle.n, dr.normalize(lens_point - middle.p))
        active = (cos_s > 0) & (arrival > 0)
        if faces.shadows:
            within, aim = pupil_cells.strata(i, j, m, face * pupil_cells.STRIDE + part)
            spot, _ = elements.place(face, within, self.cut, part)
            _, to, _, _ = lens.arrival(spot.p, mi.warp.square_to_uniform_disk_concentric(aim))
            active &= ~hidden(scene, spot.p, to, active)
        origin = mi.Vector2f(*(dr.opaque(mi.Float, int(n)) for n in lens.film().crop_offset()))
        images, values, shares, depths, mean = [], [], [], [], mi.Float64(0)
        for at in CORNERS:
            corner, _ = elements.place(face, mi.Point2f(*at), self.cut, part)
            position, to, _, cos_theta = lens.arrival(corner.p, node)
            profile = faces.emitter.law.profile(middle, dr.normalize(to - corner.p), active)
            cos4 = mi.Float64(etendue_from_pixel(cos_theta, True))
            images.append(mi.Point2d(position - origin))
            values.append(eq9(mi.Float64(profile), cos4))
            mean += cos4 / 3
            b = of_part(part, self.cut, mi.warp.square_to_uniform_triangle(mi.Point2f(*at)))
            shares.append([mi.Float64(1 - b.x - b.y), mi.Float64(b.x), mi.Float64(b.y)])
            depths.append(mi.Float64(lens.blur_disc(corner.p)[2]))
            active &= dr.isfinite(position.x) & dr.isfinite(position.y)
        centre, radius, side = lens.blur_disc(middle.p)
        active &= side > 0
        cell = [pupil_cells.corner(i + x, j + y, m) for x, y in AROUND]
        tile = [mi.Point2d(centre - origin + radius * c) for c in cell]
        own = dr.select(self.points, pupil_cells.area(cell), dr.pi / mi.Float(m * m))
        virtual_pixel = dr.opaque(mi.Float, lens.virtual_pitch**2)
        etendue = mi.Float64(etendue_from_surface(cos_s, area, arrival, own, virtual_pixel))
        ring, count, light_area, flat = _polygon(images, tile, self.points)
        turn = _cross(images[1] - images[0], images[2] - images[0])
        large = ~self.points & ~flat & (dr.abs(turn) > FILM_BASED)
        etendue = dr.select(large, 0.5 * dr.abs(turn) * mean * mi.Float64(own) / dr.pi, etendue)
        # The falloff over the film, which is not linear over a large piece, is put back pixel by pixel.
        even = [falloff(lens, mi.Point2f(image) + origin) for image in images]
        values = [etendue / (light_area * mean * f) * value for f, value in zip(even, values, strict=True)]
        weights = [values] if on == "face" else _weights(values, shares, depths)
        return [_plane(images, w, turn, self.points | flat) for w in weights], ring, count, active


def falloff(lens: mi.Sensor, position: mi.Point2f) -> mi.Float64:
    """cos⁴θ of the line of sight from the middle of the pupil to a film position [pixels]."""
    x = mi.Point2d(lens.virtual_point(position)) * (1 - lens.optics.discs[0].shift)
    squared = dr.square(dr.opaque(mi.Float64, lens.optics.focus_distance))
    return dr.square(squared / (squared + dr.squared_norm(x)))


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
    images: list[mi.Point2d], tile: list[mi.Point2d], points: mi.Bool
) -> tuple[list[mi.Point2d], mi.UInt32, mi.Float64, mi.Bool]:
    """Polygon that the light fills: the image of a piece or of a cell, or a small square where that has no size.

    Beside it the number of its edges, its area [pixels²], and True where the density over it is taken as constant.
    """
    ring = [dr.select(points, t, c) for t, c in zip(tile, (*images, images[0]), strict=True)]
    area = 0.5 * dr.abs(_cross(ring[2] - ring[0], ring[3] - ring[1]))
    longest = mi.Float64(0)
    for k in range(4):
        longest = dr.maximum(longest, dr.squared_norm(ring[k] - ring[k - 1]))
    flat = 2 * area < LEAST_HEIGHT * dr.sqrt(longest)
    none = ~(area > LEAST_AREA)
    count = dr.select(points | none, mi.UInt32(4), 3)
    middle = 0.25 * (ring[0] + ring[1] + ring[2] + ring[3])
    speck = [middle + SPECK * mi.Vector2d(x, y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ring = [dr.select(none, s, own) for s, own in zip(speck, ring, strict=True)]
    return ring, count, dr.select(none, 4 * SPECK**2, area), flat | none


def _plane(images: list[mi.Point2d], values: list[mi.Float64], turn: mi.Float64, constant: mi.Bool) -> Plane:
    """The linear density with these values at three corners, `turn` twice their signed area; or their mean."""
    a, b = images[1] - images[0], images[2] - images[0]
    u, v = values[1] - values[0], values[2] - values[0]
    x, y = (u * b.y - v * a.y) / turn, (v * a.x - u * b.x) / turn
    at = values[0] - x * images[0].x - y * images[0].y
    mean = (values[0] + values[1] + values[2]) / 3
    return Plane(dr.select(constant, mean, at), dr.select(constant, 0, x), dr.select(constant, 0, y))


def _cross(a: mi.Vector2d, b: mi.Vector2d) -> mi.Float64:
    return a.x * b.y - a.y * b.x
