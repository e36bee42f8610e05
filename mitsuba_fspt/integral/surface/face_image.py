"""Eq. 9 by faces: the image of meshes on which J_n is linear, whatever the sizes of face, blur disc and pixel.

As for columns of the transport matrix, every face sends its light through M × M nodes of the pupil. Through one node
the images of all faces tile the film without a gap, and the light of each, linear over it, is distributed exactly over
the pixels: each node gives the exact image of a pinhole. Only the pupil is sampled. So light that is narrower than a
pixel, faces edge-on and many small faces cost no more than others, and lines of sight are needed only where one surface
may hide another; there the faces are cut along the edge of the shadow. M doubles from level to level; the error follows
from the change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from ...camera.camera import Camera
from ...camera.window import Window
from ...emission.emitting_surface import EmittingSurface
from ...emission.of_emitter import surfaces_of
from ...jit.batches import batch_slices
from ...jit.mesh_buffers import triangles
from ...runtime.deadline import Deadline
from ..lines.eq9 import most_radiance
from ..lines.occlusion import hides_nothing
from ..progress import SILENT, Progress
from ..quadrature import TOGETHER_BY_SURFACE, Quadrature
from ..shortcuts import Finding, on_surfaces
from ..solution import Solution
from .column_canvas import ColumnCanvas, Windows
from .column_form import FaceLines, Misfits, falloff_on_pixels
from .face_light import ColumnRule, FaceLight, Plan
from .glow import touching

# Error over the largest last change within `AROUND` pixels, where no surface hides another and where one may. Images
# with few nodes may agree by chance: the least error of the third level over the tolerance, for which M is chosen
# there, and its factor from level to level.
SAFETY, SHADED, AROUND, EXPECTED, FALL = 0.35, 1.0, 2, 0.5, 0.25
SURE = 4.0  # standard deviations from which on random points show more than chance: once in 16,000 pixels
PERSPECTIVE = 0.25  # of the tolerance: error by perspective, which no change shows where a face stays one piece
FINER = 1.25  # M over that at which an edge as bright as its face is wrong by the tolerance: pixels have several
DISPLACED = 2e-4  # pixels by which float32 displaces the images of faces against lines of sight
MOST_LEVELS, MOST_CELLS = 6, 512  # levels; largest M at the second level
# Largest radiance over that of the brightest pixel that M is chosen for; brighter faces, of which the pixel or the lens
# sees a part, may need more.
BRIGHTEST = 4.0
# Lines of sight in whose time one image of a piece is laid, and one face of the scene is prepared; time of the first
# levels over that of the third.
LINES, PREPARED, FIRST_LEVELS = 1.5, 60, 4 / 3
OTHERS = 1 << 13  # lines of sight that other rules take on a pixel that two levels leave above the tolerance

Plane = NDArray[np.float64]
Index = NDArray[np.int64]


def applies(scene: mi.Scene, quadrature: Quadrature) -> bool:
    """True if all emitters are meshes whose J_n is linear on every face, and pixels count by their area."""
    surfaces = surfaces_of(scene)
    return (
        quadrature.pixel == "area"
        and len(surfaces) == len(scene.emitters())
        and all(s.shape.is_mesh() and s.law.linear and s.exitance_at_corners() is not None for s in surfaces)
    )


def faces_seen(scene: mi.Scene, camera: Camera, window: Window, convex: bool = True) -> list[FaceLight]:
    """Faces of each emitting mesh as the camera sees them on a window, without a second border of the lens.

    convex : a single convex shape is searched for no occluders
    """
    camera = camera.without_borders()
    seen = [FaceLight.seen(surface, camera, window.corner, window.shape) for surface in surfaces_of(scene)]
    return seen if convex and hides_nothing(scene) else [faces.behind(scene, camera) for faces in seen]


class FaceImage:
    """The pixels of a `window` by faces, for scenes to which this `applies`.

    A second border of the lens is ignored: only pixels that are `Window.fully_open` are right. `seen`: gives what
    `faces_seen` returns for this scene, camera and window, where that is kept. `dark_too`: faces on which J_n = 0 are
    laid, too, for the coverage.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        window: Window,
        quadrature: Quadrature,
        least_peak: float = 0.0,
        seen: Callable[[], list[FaceLight]] | None = None,
        dark_too: bool = True,
    ) -> None:
        self.scene, self.window, self.quadrature, self.dark_too = scene, window, quadrature, dark_too
        self.camera = camera.without_borders()
        self._seen = seen or partial(faces_seen, scene, camera, window, quadrature.takes("occlusion"))
        self.surfaces = surfaces_of(scene)
        self.most = max(s.brightest for s in self.surfaces) or 1.0  # J_n in units of which light is laid [W/mm²]
        self.value, self.error, self.coverage = (np.zeros(window.shape) for _ in range(3))
        self.least_peak = least_peak
        self.rays = self.level = 0
        self.levels: list[str] = []
        self.plans: list[Plan] = []

    @cached_property
    def faces(self) -> list[FaceLight]:
        """Faces of each mesh as the camera sees them."""
        return self._seen()

    @cached_property
    def exitance(self) -> list[tuple[mi.Float, ...]]:
        """J_n at the corners of the faces of each mesh, over the largest."""
        return [_over(self.most, surface) for surface in self.surfaces]

    @cached_property
    def radiance(self) -> list[tuple[Plane, Plane]]:
        """Largest radiance of each face, and its change along the face [W/mm²/sr]."""
        found = []
        for surface, corners in zip(self.surfaces, self.exitance, strict=True):
            unit = self.most / (math.pi if surface.is_isotropic() else 1)
            values = unit * np.array([corner.numpy() for corner in corners], np.float64)
            found.append((values.max(axis=0), np.ptp(values, axis=0)))
        return found

    @cached_property
    def falloff(self) -> Plane:
        """Falloff of the film's light, mean over each pixel."""
        y, x = np.divmod(np.arange(math.prod(self.window.shape)), self.window.shape[1])
        return falloff_on_pixels(self.camera, x, y, self.window.corner).reshape(self.window.shape)

    def run(
        self, where: NDArray[np.bool_], least_peak: float, progress: Progress = SILENT, most: int = OTHERS
    ) -> Solution:
        """Power [W], error [W] and coverage of the crop window, complete on the pixels marked in `where` (h, w).

        least_peak : lower bound of the brightest pixel's mean radiance on film [W/mm²/sr]
        most : lines of sight a pixel in whose time a level from the third on may be computed, at most half of
            `max_nodes`
        """
        self.error = np.zeros(self.window.shape)
        rule, around = ColumnRule.of(self.quadrature.rtol), _wider(where)
        self.level, self.plans = 0, [plan.halved().halved() for plan in self._plans(rule, least_peak)]
        if where.any() and (first := self._level(self.plans, around, None)):
            self.value, self.coverage, _ = first
        lines = min(most, self.quadrature.most_nodes / 2)
        self._refine(where, least_peak, lambda count: lines * count, progress)
        if self.level == 0:
            self.error = _largest(self.value)
        return self._solution(where)

    def further(self, where: NDArray[np.bool_], least_peak: float, progress: Progress = SILENT) -> Solution:
        """The same after further levels on some of those pixels that other rules leave above the tolerance, too, if
        these levels take less time than the lattices that would follow."""

        def worth(count: int) -> float:
            lines = self.quadrature.most_nodes * count / 2
            return lines if self.quadrature.max_nodes is not None else max(lines, TOGETHER_BY_SURFACE)

        self._refine(where, least_peak, worth, progress)
        return self._solution(where)

    def _refine(
        self, where: NDArray[np.bool_], least_peak: float, worth: Callable[[int], float], progress: Progress
    ) -> None:
        """Further levels on the pixels `where` until their errors are below the tolerance; `worth`: of a number of
        pixels, lines of sight in whose time the next level has to be computed."""
        shown, mark = self.window.shown(), where
        safety = np.where(self.shaded, SHADED, SAFETY)
        while self.level < MOST_LEVELS - 1 and mark.any() and not progress.deadline.passed():
            level, around = self.level + 1, _wider(mark)
            plans = self._finer(self.plans, ColumnRule.of(self.quadrature.rtol), level, least_peak)
            if level > 1 and LINES * self._cost(plans, around) > worth(np.count_nonzero(mark)):
                break
            if (found := self._level(plans, around, progress.deadline)) is None:
                break
            self.plans, self.level, (value, coverage, edges) = plans, level, found
            change = np.where(around, np.abs(value - self.value), 0)
            recent = np.maximum(safety * _largest(change), _largest(edges))
            least = max(EXPECTED * FALL ** (level - 2), PERSPECTIVE) * self.quadrature.rtol * self._peak(least_peak)
            self.error[mark] = np.maximum(recent, least)[mark]
            self.value[around], self.coverage[around] = value[around], coverage[around]
            mark = shown & where & (self.error > self.quadrature.rtol * self._peak(least_peak))
            progress(level / MOST_LEVELS)
        progress(1.0)

    def _solution(self, where: NDArray[np.bool_]) -> Solution:
        """The present image, complete on the pixels `where`, with the work since the last one."""
        error = np.maximum(self.error, self.quadrature.least_error * self.window.brightest(self.value))
        error += DISPLACED * _steepest(self.value)
        error[self.coverage == 0] = self.error[self.coverage == 0]
        power, error = (self.window.expand(image) * self.camera.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.coverage, 0, 1))
        complete = self.window.expand(where.astype(np.float64)) > 0
        rays, levels, self.rays, self.levels = self.rays, tuple(self.levels), 0, []
        return Solution(power, error, coverage, rays, levels, complete, self._findings())

    def _findings(self) -> tuple[Finding, ...]:
        """Shortcuts of an image by faces alone."""
        hidden, count = any(faces.shadows for faces in self.faces), sum(len(faces.corners) for faces in self.faces)
        dark = sum(int(np.count_nonzero(most <= 0)) for most, _ in self.radiance)
        return on_surfaces(hidden, dark, count, "faces", self.dark_too)

    def _finer(self, plans: list[Plan], rule: ColumnRule, level: int, least_peak: float) -> list[Plan]:
        """The plans of the next level: at the second level with all cells that the accuracy requires, as the brightest
        pixel is known from the first one; half of them before, twice as many after that."""
        doubled = [plan.doubled(own.mixed & ~own.small) for plan, own in zip(plans, self.faces, strict=True)]
        if level > 2:
            return doubled
        wanted = self._plans(rule, least_peak)
        if level == 1:
            wanted = [plan.halved() for plan in wanted]
        return [plan.at_least(least) for plan, least in zip(wanted, doubled, strict=True)]

    def cost(self, mark: NDArray[np.bool_], least_peak: float, most: float = math.inf) -> float:
        """Lines of sight in whose time the first three levels are computed on the marked pixels.

        least_peak : as of `run`
        most : a larger number may be too small
        """
        prepared = PREPARED * sum(dr.width(triangles(surface.shape)[1]) for surface in self.surfaces) / 3
        if prepared > most:
            return prepared
        images = self._cost(self._plans(ColumnRule.of(self.quadrature.rtol), least_peak), mark)
        return FIRST_LEVELS * LINES * images + prepared

    def _peak(self, least_peak: float) -> float:
        """Lower bound of the brightest pixel [W/mm²/sr]."""
        return max(self.window.brightest(self.value), least_peak, self.least_peak)

    def _plans(self, rule: ColumnRule, least_peak: float) -> list[Plan]:
        peak = self._peak(least_peak) or most_radiance(self.scene) or 1.0
        rule = replace(rule, step=rule.step / FINER**2, perspective=PERSPECTIVE * rule.step)
        plans = []
        for faces, (most, change) in zip(self.faces, self.radiance, strict=True):
            plans.append(faces.image_plan(rule, np.minimum(most / peak, BRIGHTEST), change / peak, MOST_CELLS))
        return plans

    @cached_property
    def shaded(self) -> NDArray[np.bool_]:
        """True (h, w) for pixels that light of faces in a shadow's edge may reach."""
        steps = np.zeros(np.add(self.window.shape, 1), np.int64)
        size = np.array(self.window.shape[::-1])
        for faces in self.faces:
            some = faces.mixed & faces.bright
            low, high = faces.low[some], faces.high[some]
            (left, top), (right, bottom) = (
                np.clip(edge, 0, size).astype(np.int64).T for edge in (np.floor(low), np.floor(high) + 1)
            )
            for y, x, sign in ((top, left, 1), (bottom, left, -1), (top, right, -1), (bottom, right, 1)):
                np.add.at(steps, (y, x), sign)
        return np.asarray(steps.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0)

    def _touching(self, mark: NDArray[np.bool_]) -> list[Index]:
        """Faces of each mesh whose light may reach a marked pixel."""
        least = -math.inf if self.dark_too else 0.0
        return [
            np.flatnonzero(faces.bright & (most > least) & touching(faces.low, faces.high, mark))
            for faces, (most, _) in zip(self.faces, self.radiance, strict=True)
        ]

    def _cost(self, plans: list[Plan], mark: NDArray[np.bool_]) -> int:
        """Number of images of pieces, or of cells, that a level lays."""
        some = (plan.of(index) for plan, index in zip(plans, self._touching(mark), strict=True))
        return sum(int(((plan.cells * plan.cuts) ** 2).sum()) for plan in some)

    def _level(
        self, plans: list[Plan], mark: NDArray[np.bool_], deadline: Deadline | None
    ) -> tuple[Plane, Plane, Plane] | None:
        """Value, coverage and error beside edges of shadows on marked pixels, incomplete on others; None where the
        deadline passes before the end."""
        height, width = self.window.shape
        whole = np.zeros(2, np.int64)
        windows = Windows(whole, whole, whole + width, whole + height)
        canvas = ColumnCanvas(self.window.shape, windows)
        columns = [dr.opaque(mi.UInt32, k) for k in range(2)]
        laid, beside = 0, _Beside(self.window.shape)
        for faces, plan, corners, index in zip(self.faces, plans, self.exitance, self._touching(mark), strict=True):
            own = plan.of(index)
            items = np.stack([index, own.cells[:, 0], own.cuts[:, 0], own.points[:, 0]])
            counts = (items[1] * items[2]) ** 2
            laid += int(counts.sum())
            for run in batch_slices(counts):
                if deadline and deadline.passed():
                    return None
                lines = FaceLines.numbered(items[:, run])
                (planes, ring, count, active), off = lines.light(
                    self.scene, self.camera, faces, corners, self.window.corner
                )
                canvas.lay(columns, planes, ring, count, active)
                canvas.evaluate(*vars(off).values() if off else ())
                if off:
                    beside.add(off)
        self.rays += laid
        self.levels.append(f"images of faces: {np.count_nonzero(mark)} pixels, {laid} images")
        value, coverage = canvas.light().reshape(2, height, width + 1)[..., :width] + beside.points
        missing, error = beside.edges()
        unit = self.falloff * self.most
        return np.maximum(value + missing, 0) * unit, np.maximum(coverage, 0), error * unit


class _Beside:
    """Sums on pixels (h, w) of random points that images of pieces leave out: of their light at edges of shadows and of
    its squares; of light and coverage of the other points, (2, h, w), and of the squares of those on large pieces."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.points = np.zeros((2, *shape))
        self.at_edges, self.squares, self.large = (np.zeros(shape) for _ in range(3))

    def add(self, off: Misfits) -> None:
        """Add the light of more points."""
        row, column, (light, coverage), at_edge, large = off.on_film(self.large.shape)
        for plane, amount in (
            (self.points[0], light * ~at_edge),
            (self.points[1], coverage * ~at_edge),
            (self.at_edges, light * at_edge),
            (self.squares, light**2 * at_edge),
            (self.large, light**2 * (large & ~at_edge)),
        ):
            np.add.at(plane, (row, column), amount)

    def edges(self) -> tuple[Plane, Plane]:
        """Light (h, w) that the edges of shadows leave out, and its error, with that on large pieces.

        The light is 0 unless the sum over 3 × 3 pixels is above `SURE` standard deviations: single terms are far less
        exact than one edge. The error is three deviations on the pixel, or one around, as no point may lie on the pixel
        itself. On a piece larger than a pixel every point that is hidden counts, as there should be none.
        """
        around, variance = (uniform_filter(plane, 3, mode="constant") * 9 for plane in (self.at_edges, self.squares))
        variance = np.maximum(variance, 0)  # of differences of rounded sums
        several = around**2 > SURE**2 * variance
        error = np.where(several, np.maximum(3 * np.sqrt(self.squares), np.sqrt(variance)), 0)
        return np.where(several, self.at_edges, 0), np.maximum(error, 3 * np.sqrt(self.large))


def _steepest(image: Plane) -> Plane:
    """Largest difference (h, w) of each pixel and its neighbours to one of them."""
    return np.asarray(maximum_filter(image, 3) - minimum_filter(image, 3))


def _wider(mark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The marked pixels and those around, whose changes count for the error."""
    return np.asarray(maximum_filter(mark, 2 * AROUND + 1))


def _largest(image: Plane) -> Plane:
    """Largest value (h, w) within `AROUND` pixels of each."""
    return np.asarray(maximum_filter(image, 2 * AROUND + 1))


def _over(unit: float, surface: EmittingSurface) -> tuple[mi.Float, ...]:
    """J_n at the corners of every face, in this unit."""
    corners = surface.exitance_at_corners()
    if corners is None:
        raise TypeError(f"J_n of {surface.shape.id()} is not linear on its faces")
    scaled = tuple(corner * dr.opaque(mi.Float, 1 / unit) for corner in corners)
    dr.eval(scaled)
    return scaled
