"""Division of a mesh's faces for columns of the transport matrix (Eq. M.20): cells of the pupil, pieces of a face.

A column (the hat function of a vertex, or a face) takes the same cells of the pupil on all of its faces. Through each
cell its light is then continuous, so that the sampled light is as smooth as the column, whatever its neighbours take.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...emission.elements import Elements, elements_of
from ...emission.emitting_surface import EmittingSurface
from ...jit.batches import BATCH, batch_slices, numbered
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import triangles
from ..estimator import Thresholds, bound
from ..lines.occlusion import hidden
from . import pupil_cells

CORNERS = ((0, 0), (1, 0), (0, 1))  # of a face, in the square that `Elements.place` maps to it
MARGIN, RIM = 0.05, 0.02  # by which bounds exceed the light: in pixels, for float32, and of the blur radius, for cells
LONGER = 4.0  # length of a slender piece in a shadow over that of a compact one, at the most
FEWEST_SHADED = 2  # pieces along a side where one surface may hide another: with half of them the light differs
# What middles of M × M cells leave of a half plane averaged over pixels, times r/M² of its step for a blur disc of r
# pixels: the most of all directions and offsets for r = 0.5 … 32, M = 4 … 32 and M > 1.25 r, below which it is 0.18.
# Likewise of a slope that begins at a straight line, times r/M² of the slope per pixel, for r = 1 … 64.
EDGE_LEFT, KINK_LEFT = 0.12, 0.13
# Points in place of pieces of s pixels leave s³/r^1.5 of the standard deviation of a J_n that is random from face to
# face, root mean square over the pixels: the most on equilateral triangles, r = 0.1 … 3, s = 0.05 … 0.4.
SPECKLE_LEFT = 0.04
# What perspective, corrected on average, misplaces at the most within a triangle of the relative depth δ, over δ times
# the change of J_n along it. A blur disc evens it out: over triangles of s pixels, whatever the directions of J_n and
# of the depth on each, r pixels leave (s/(4 r))^1.5 of it at the most, for r = s/4 … 4 s.
PERSPECTIVE_LEFT, EVENED = 0.16, 4.0
# Where points of the open part of the pupil move by δ along a triangle, over the radius of that part, its images
# through nodes are bent and their density is not even: so much of its light, times δ², is misplaced.
BENT_LEFT, MOST_SHIFT = 1.6, 8.0
OPEN_POINTS = ((0, 0), (0.7, 0), (-0.7, 0), (0, 0.7), (0, -0.7))  # of the unit disc, whose images are compared
PROBES = 4, 256  # least and largest square root of the number of lines of sight that search for occluders of a face
FEWEST, MOST = 4, 64  # least and largest M of columns
DROP = 0.01  # of rtol and of a column's brightest entry: entries below are left out
LONGEST = 1e6  # pixels: side counted for a face that reaches through the lens plane and has no image
# M of columns of several faces: neighbours mostly take the same.
LEVELS = (4, 6, 8, 10, 12, 16, 20, 24, 28, 32, 36, 40, 44, 50, 56, 64)

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ColumnRule(Thresholds):
    """Numbers of cells and pieces, each with the error it bounds; `audit.py --matrix --ablate` measures their effects.

    step : error at an edge or side at which the light of faces steps, over its step: cells M along the pupil are
        √(EDGE_LEFT · r/step) for a blur radius r [pixels]
    kink : error at a face's side where J_n is continuous, over its change along the face: of columns that are
        continuous and nowhere cut off M is √(KINK_LEFT · r/(h · kink)), with h [pixels] the height of a face's image
    partial : least M where only a part of the pupil takes light of a face: it turns away from the rest, or one surface
        may hide another
    cells : M where the cells are laid and pieces are points; their étendue is constant in each
    speckle : error of these points where J_n varies at random from face to face, over its standard deviation: for
        pieces of s pixels SPECKLE_LEFT · s³/r^1.5, root mean square over the pixels
    piece : largest piece over the distance in focus, over which étendue and exit law are linear but for some of its
        square
    perspective : J_n that perspective, corrected on average, misplaces within a piece, over its change along the face:
        pieces along a side of a face of relative depth δ are √(PERSPECTIVE_LEFT · δ/perspective), fewer where the blur
        disc evens it out
    shadow : largest piece s [pixels] where one surface may hide another: each is cut once, along the edge of the
        shadow, and a second edge or a corner of it misplaces light within the piece. Slender ones, of less than half
        their length in height, are longer, up to `LONGER` s, and have no larger area than others
    """

    step: float = bound(1e-3, 1e30)
    kink: float = bound(3e-3, 1e30)
    partial: int = bound(16, FEWEST)
    cells: int = bound(6, FEWEST)
    speckle: float = bound(2.5e-4, 1e30)
    piece: float = bound(0.03, 1e30)
    perspective: float = bound(5e-4, 1e30)
    shadow: float = bound(0.7, 1e30)

    @classmethod
    def of(cls, rtol: float) -> ColumnRule:
        """The rule for a tolerance relative to the brightest pixel: columns are right to some ten times that."""
        finer = math.sqrt(min(rtol / 1e-3, 1))
        return cls(
            step=rtol,
            kink=3 * rtol,
            partial=2 * math.ceil(8 / math.sqrt(finer)),
            cells=2 * math.ceil(3 / math.sqrt(finer)),
            speckle=0.25 * rtol,
            perspective=0.5 * rtol,
            shadow=0.7 * finer,
        )


@dataclass(frozen=True)
class Plan:
    """How each of some faces is divided for each of its columns, (F, 1) on faces, (F, 3) on vertices: M of the pupil,
    pieces along a side, and whether the pupil's cells are laid."""

    cells: Index
    cuts: Index
    points: Mask

    def halved(self) -> Plan:
        """Half as many cells and pieces, where there are enough."""
        return Plan(np.maximum(2 * (self.cells // 4), 2), np.maximum((self.cuts + 1) // 2, 1), self.points)

    def doubled(self, pieces: Mask) -> Plan:
        """Twice as many cells, and pieces of faces that are marked in `pieces` (F,)."""
        return replace(self, cells=2 * self.cells, cuts=np.where(pieces[:, None], 2 * self.cuts, self.cuts))

    def at_least(self, other: Plan) -> Plan:
        """This plan, with as many cells as an `other` one."""
        return replace(self, cells=np.maximum(self.cells, other.cells))

    def of(self, faces: Index) -> Plan:
        """The same of some of the faces."""
        return Plan(self.cells[faces], self.cuts[faces], self.points[faces])

    def passes(self) -> Iterator[tuple[Index, Index, Index, Mask, Mask]]:
        """Faces, their M and pieces, whether cells are laid, and the columns (n, 1 or 3) that take light so: in turn
        those like the first column of a face, like the second where that differs, and like the third."""
        kind = 2 * self.cells + self.points
        for k in range(kind.shape[1]):
            alike = kind == kind[:, k : k + 1]
            faces = np.flatnonzero(~alike[:, :k].any(axis=1))
            if faces.size:
                yield faces, self.cells[faces, k], self.cuts[faces, k], self.points[faces, k], alike[faces]


@dataclass(frozen=True)
class FaceLight:
    """The faces of one mesh as a lens sees them.

    corners (F, 3): numbers of their vertices. low, high (F, 2): bounds of their light [pixels of the crop window],
    empty for a face that sends none. sides, heights, blur (F,): longest edge, height over it and blur radius of the
    image [pixels]. slant (F,): depth of the face over its distance. shift (F,): distance by which points of the part
    of the pupil that a second border leaves open move along the face, over the radius of that part. partial (F,): the
    face turns away from part of the pupil. cut (V,): vertices at which the light of the surface ends for part of the
    pupil, at silhouettes and borders. mixed (F,): one surface hides part of another here. distance: in focus
    [virtual pixels].
    """

    surface: EmittingSurface
    elements: Elements
    corners: Index
    low: Array
    high: Array
    sides: Array
    heights: Array
    blur: Array
    slant: Array
    shift: Array
    partial: Mask
    cut: Mask
    mixed: Mask
    distance: float
    shadows: bool

    @classmethod
    def seen(
        cls, surface: EmittingSurface, camera: Camera, origin: tuple[int, int], shape: tuple[int, int]
    ) -> FaceLight:
        """Faces of an emitting mesh as `camera` sees them, on the crop window of `shape` (h, w) at `origin` (x, y)."""
        mesh = surface.shape
        positions, faces = triangles(mesh)
        vertices = positions.numpy().reshape(-1, 3).astype(np.float64)
        corners = faces.numpy().reshape(-1, 3).astype(np.int64)
        centre, radius = camera.film_discs(vertices)
        centre -= origin
        reach = radius * (1 + RIM) + MARGIN
        low, high = (centre - reach)[corners].min(axis=1), (centre + reach)[corners].max(axis=1)
        blur = radius[:, 0][corners].max(axis=1)
        edges = centre[np.roll(corners, -1, axis=1)] - centre[corners]
        lengths = np.hypot(edges[..., 0], edges[..., 1])
        sides = lengths.max(axis=1)
        turn = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
        heights = np.divide(turn, sides, out=np.zeros(len(sides)), where=(sides > 0) & np.isfinite(turn))
        elements = elements_of(mesh, minimum=1)
        most, least = _facing(elements, camera)
        shift, closed = _opening(elements, camera)
        size = np.array(shape[::-1])
        beside = ((high <= 0) | (low >= size)).any(axis=1)
        area = np.isfinite(most)  # a face without area has no normal
        dark = beside | (most <= 0) | closed | ~area
        low[dark], high[dark] = np.inf, -np.inf
        partial = ~dark & (least < 0)
        cut = _border(corners, len(vertices))
        cut[corners[~(least >= 0)].ravel()] = True
        none = np.zeros(len(corners), bool)
        depth = _scales(mesh, camera)[corners]
        slant = np.ptp(depth, axis=1) / np.maximum(np.abs(depth).min(axis=1), 1e-3 * np.abs(depth).max(axis=1))
        bounded = np.isfinite(blur)
        sides, blur = np.where(bounded, sides, np.inf), np.where(bounded, blur, math.hypot(*shape))
        return cls(
            surface,
            elements,
            corners,
            low=low,
            high=high,
            sides=sides,
            heights=heights,
            blur=blur,
            slant=slant,
            shift=shift,
            partial=partial,
            cut=cut,
            mixed=none,
            distance=camera.lens.focus_distance / camera.virtual_pitch,
            shadows=False,
        )

    @property
    def bright(self) -> Mask:
        """Faces that may send light."""
        return self.low[:, 0] <= self.high[:, 0]

    @property
    def small(self) -> Mask:
        """Faces smaller than their blur disc."""
        return np.minimum(self.sides, LONGEST) < 2 * self.blur + 1

    def behind(self, scene: mi.Scene, camera: Camera) -> FaceLight:
        """The same in a scene where one surface may hide another: faces of which all lines are blocked are dark."""
        bright = np.flatnonzero(self.bright)
        if not bright.size:
            return self
        share = np.zeros(len(self.corners))
        share[bright] = _open_share(scene, camera, self.elements, bright, self._probes[bright])
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
        cut = self.cut.copy()
        cut[self.corners[mixed | hidden_all].ravel()] = True
        return replace(self, low=low, high=high, cut=cut, mixed=mixed, shadows=True)

    @property
    def _probes(self) -> Index:
        """Square root of the number of lines of sight of each face that show whether anything hides a part of it: one
        for each pixel of its image, but `PROBES` at least and at the most."""
        sides, heights = (np.minimum(of, LONGEST) for of in (self.sides, self.heights))
        return np.ceil(np.sqrt(sides * heights / 2)).clip(*PROBES).astype(np.int64)

    def plan(self, rule: ColumnRule, on: str) -> Plan:
        """How the faces are divided: the cheaper of nodes with images of pieces and pieces with images of cells."""
        sides = np.minimum(self.sides, LONGEST)
        nodes = self._nodes(rule, sides, on)
        pieces = self._pieces(rule)
        cells = np.where(self.partial, rule.partial, rule.cells)
        largest = np.cbrt(rule.speckle / SPECKLE_LEFT) * np.sqrt(self.blur)
        smaller = np.maximum(np.ceil(sides / np.maximum(largest, 1 / LONGEST)), pieces)
        by_nodes = (nodes * pieces) ** 2 * (1 + sides / pieces)
        by_cells = (cells * smaller) ** 2 * (1 + 2 * self.blur / cells)
        points = by_cells < by_nodes
        nodes = np.minimum(nodes, MOST)
        if on == "face":
            of_columns = np.where(points, cells, nodes)[:, None]
            points = points[:, None]
        else:
            points = ~self._most(~points & self.bright)[self.corners]
            of_columns = np.where(points, self._most(cells)[self.corners], self._most(nodes)[self.corners])
        of_columns = np.maximum(of_columns, 2).astype(np.int64)
        cuts = np.where(points, smaller[:, None], pieces[:, None]).astype(np.int64)
        return Plan(of_columns, np.minimum(cuts, math.isqrt(BATCH) // of_columns), points)

    def image_plan(self, rule: ColumnRule, brightness: Array, contrast: Array, most: int) -> Plan:
        """How the faces are divided for an image, given the `brightness` (F,) of each and its change along the face,
        both over the brightness of the image, and the largest M.

        M is that of the error at an edge, which grows with the brightness; so each face is as accurate as if it glowed
        alone, and neighbours may differ in M.
        """
        nodes = np.sqrt(EDGE_LEFT * self.blur * brightness / rule.step)
        cells = (2 * np.ceil(nodes / 2)).clip(self._fewest(rule), most).astype(np.int64)
        cuts = np.minimum(self._pieces(rule, contrast).astype(np.int64), math.isqrt(BATCH) // cells)
        return Plan(cells[:, None], cuts[:, None], np.zeros((len(cells), 1), bool))

    def _pieces(self, rule: ColumnRule, contrast: Array | None = None) -> Array:
        """Pieces along a side that are laid through nodes, each of which may be cut along one edge of a shadow.

        contrast : largest change of the light along a face, for an image; None for columns
        """
        sides = np.minimum(self.sides, LONGEST)
        slender = np.sqrt(np.divide(2 * self.heights, sides, out=np.ones_like(sides), where=sides > 0))
        shaded = np.maximum(slender.clip(1 / LONGER, 1) * sides / rule.shadow, FEWEST_SHADED)
        shaded = np.where(self.mixed & ~self.small, shaded, 0)
        pieces = np.ceil(np.maximum(shaded, sides / (rule.piece * self.distance)))
        pieces = np.maximum(pieces, np.minimum(self._flat_pieces(rule, 1.0 if contrast is None else contrast), sides))
        if self.shift.any():
            pieces = np.maximum(pieces, self.shift * math.sqrt(BENT_LEFT / rule.perspective))
        return np.maximum(np.ceil(pieces), 1)

    def _flat_pieces(self, rule: ColumnRule, contrast: Array | float) -> Array:
        """Pieces along a side for `perspective`, of a J_n with this change along the face."""
        misplaced = PERSPECTIVE_LEFT * self.slant * contrast / rule.perspective
        left = (np.minimum(self.sides, LONGEST) / (EVENED * np.maximum(self.blur, 1 / LONGEST))) ** 1.5
        return np.minimum(np.sqrt(misplaced), (misplaced * left) ** (2 / 7))

    def _fewest(self, rule: ColumnRule) -> Index:
        """Least M of each face."""
        return np.where(self.partial | self.mixed, rule.partial, FEWEST)

    def _nodes(self, rule: ColumnRule, sides: Array, on: str) -> Array:
        """M of the nodes that the accuracy of each face requires."""
        fewest = self._fewest(rule)
        nodes = np.sqrt(EDGE_LEFT * self.blur / rule.step)
        if on == "vertex":
            kinks = np.sqrt(KINK_LEFT * self.blur / (rule.kink * np.maximum(self.heights, 1e-3)))
            nodes = np.where(self.cut[self.corners].any(axis=1), nodes, np.minimum(nodes, kinks))
        nodes = np.maximum(nodes, 2 * self.blur / np.maximum(sides, 1e-3))  # their images overlap
        if on == "face":
            return (2 * np.ceil(nodes / 2)).clip(fewest, None)
        level = np.searchsorted(LEVELS, nodes.clip(fewest, LEVELS[-1]))
        return np.where(nodes > LEVELS[-1], nodes, np.array(LEVELS)[level])

    def _most(self, values: Array | Index | Mask) -> Array | Index | Mask:
        """Largest of the `values` (F,) of the bright faces around each vertex, (V,)."""
        found = np.zeros(len(self.cut), values.dtype)
        for k in range(3):
            np.maximum.at(found, self.corners[self.bright, k], values[self.bright])
        return found


def _border(corners: Index, count: int) -> Mask:
    """True (V,) for vertices of edges that belong to one face alone."""
    edges = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    keys, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    found = np.zeros(count, bool)
    for ends in np.divmod(keys[uses == 1], count):
        found[ends] = True
    return found


def _scales(mesh: mi.Shape, camera: Camera) -> Array:
    """Of every vertex the side of a virtual pixel at its depth [mm], which is linear in the depth."""
    positions = triangles(mesh)[0]
    return camera.blur_disc(dr.unravel(mi.Point3f, positions))[2].numpy().astype(np.float64)


def _facing(elements: Elements, camera: Camera) -> tuple[Array, Array]:
    """n·(a − r) of faces at the most and at the least [mm], over their corners r and the points a of the whole pupil.

    NaN where a face has no normal.
    """
    index = dr.arange(mi.UInt32, elements.count)
    axis = dr.normalize(camera.axis)
    most, least = np.full(elements.count, -np.inf), np.full(elements.count, np.inf)
    for corner in CORNERS:
        si, _ = elements.place(index, mi.Point2f(*corner))
        _, middle, _, _ = camera.arrival(si.p, mi.Point2f(0))
        _, rim, _, _ = camera.arrival(si.p, mi.Point2f(1, 0))
        towards = dr.dot(si.n, middle - si.p)
        spread = dr.norm(rim - middle) * dr.safe_sqrt(1 - dr.square(dr.dot(si.n, axis)))
        most = np.maximum(most, (towards + spread).numpy())
        least = np.minimum(least, (towards - spread).numpy())
    return most, least


def _opening(elements: Elements, camera: Camera) -> tuple[Array, Mask]:
    """By how much points of the open part of the pupil move along each face, over the radius of the part, and True for
    faces behind the lens plane or of which a second border hides all."""
    index = dr.arange(mi.UInt32, elements.count)
    corners = [elements.place(index, mi.Point2f(*at))[0].p for at in CORNERS]
    weights = [camera.open_arrival(corner, mi.Point2f(0))[2] for corner in corners]
    behind = dr.maximum(dr.maximum(weights[0], weights[1]), weights[2]).numpy() <= 0
    behind = np.broadcast_to(behind, elements.count)
    if not camera.pupil.bordered:
        return np.zeros(elements.count), behind
    moved, most = mi.Float(0), mi.Float(0)
    for node in OPEN_POINTS:
        places, shares = zip(*(camera.opening(corner, mi.Point2f(*node)) for corner in corners), strict=True)
        for k in range(3):
            moved = dr.maximum(moved, dr.norm(places[k] - places[k - 1]))
            most = dr.maximum(most, shares[k])
    closed = camera.closed_to(corners, elements.place(index, mi.Point2f(*elements.middle))[0].p)
    shift = dr.minimum(moved * dr.rsqrt(dr.maximum(most, 1e-6)), MOST_SHIFT)
    return shift.numpy().astype(np.float64), behind | np.broadcast_to(closed.numpy(), elements.count)


def _open_share(scene: mi.Scene, camera: Camera, elements: Elements, faces: Index, probes: Index) -> Array:
    """Share of the lines of sight of each of some `faces` (n,) that nothing blocks, of `probes`² (n,) lines."""
    reaching, stopped = np.zeros((2, len(faces)))
    for some in batch_slices(probes**2):
        row, number = numbered(probes[some] ** 2)
        index, m, k = (from_numpy(mi.UInt32, of) for of in (faces[some][row], probes[some][row], number))
        m = dr.maximum(m, 1)  # beyond the last line it is 0, and whole numbers divided by 0 end the process
        within, aim = pupil_cells.strata(k % m, k // m, m, index * pupil_cells.STRIDE)
        spot, _ = elements.place(index, within)
        _, lens_point, arrival, _, share = camera.open_arrival(spot.p, aim)
        reaches = (share * arrival > 0) & (dr.dot(spot.n, lens_point - spot.p) > 0)
        blocked = reaches & hidden(scene, spot.p, spot.n, lens_point, reaches)
        for sums, flag in ((reaching[some], reaches), (stopped[some], blocked)):
            sums += np.bincount(row, flag.numpy(), len(sums))
    return 1 - stopped / np.maximum(reaching, 1)
