"""Eq. 9 in its surface form: P = ∫ L |cosθ_s| dS dΩ over the surface and over the pupil as a surface point sees it.

The surface is cut into pieces, the pupil into M × M cells. The power that a piece sends through a cell follows from one
line of sight (`eq9`) and is laid on the image of the piece through the cell's middle: a polygon on the film,
distributed exactly over the pixels. Neighbouring pieces share the cells' middles, so that their images tile the film
without gap or overlap, and all power arrives, once. A blur disc that shrinks to nothing at z = u, which makes a sum
over surface points stiff, only shifts images here. For a shape smaller than its blur disc the cells, imaged through the
piece's middle, tile the disc instead.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window
from ...jit.pixel_grid import Grid
from ...jit.spectra import scalar
from ...runtime.deadline import Deadline
from ..lines.eq9 import eq9, etendue_from_surface, most_radiance
from ..lines.occlusion import hides_nothing
from ..lines.specular import Specular, transmission
from ..progress import SILENT, Progress
from ..quadrature import TOGETHER_BY_SURFACE, Quadrature
from ..shortcuts import Finding, on_surfaces
from ..solution import Solution
from . import pupil_cells
from .footprint import Canvas
from .glow import CORNERS, Batch, Glow

# Lines of sight a pixel of the image at the first level, and factors from level to level: at the second level both
# pieces and cells are refined, as the change of one alone would not show the error of the other.
FIRST_LINES, FIRST_GROWTH, GROWTH = 16, 16, 4
MOST_LINES = 1 << 16  # a pixel of an image
# Largest number on some pixels only, if the pupil form's lattices can refine them: for surfaces up to `HANDED_ON_PEAK`
# times brighter than the brightest pixel.
HANDED_ON, HANDED_ON_PEAK = 1 << 12, 10.0
BLURRED = 0.5  # of the blur radius: side below which a piece of a small shape is imaged as a point
FALL = 0.5  # error over that of the level before, where it falls with the root of the lines
DARK_LINES = 4096  # lines of sight a pixel from which on a pixel without light counts as dark
SAFETY = 3.0  # error over the largest last change of a pixel and of its neighbours
CARRIED = 0.4  # least error over that of the level before, as two levels may agree by chance
# No pixel is brighter than the brightest piece: so much above it and so small a share of it are whole numbers of 60
# bits, and thousands of roundings on a pixel stay below 1e-9 of any but the faintest.
HEADROOM, RESOLUTION, COVERAGE_QUANTUM = 2.0**4, 2.0**-56, 2.0**-50

Plane = NDArray[np.float64]


def solve(
    scene: mi.Scene,
    camera: Camera,
    window: Window,
    quadrature: Quadrature,
    where: NDArray[np.bool_] | None = None,
    least_peak: float = 0.0,
    progress: Progress = SILENT,
    specular: Specular | None = None,
) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window, to the accuracy of `quadrature`.

    Only pixels of the `window` are computed, the others are dark. With `where`, of its shape, the solution is complete
    on the pixels marked there and 0 elsewhere. `least_peak`: lower bound of the brightest pixel's mean radiance on film
    [W/mm²/sr]. `progress` is called after every level.

    `max_nodes`, but no more than `MOST_LINES`, bounds the lines of sight a pixel of an image takes on average; two
    levels are run in any case.
    Light goes on through `specular` shapes where it stays straight. Coverage counts the lines of sight that meet a
    glowing surface, not those that meet a dark one. Raises SceneError where an emitter has no surface.
    """
    return _Refinement(scene, camera, window, quadrature, specular).run(where, least_peak, progress)


class _Refinement:
    """Image during refinement: mean radiance on film [W/mm²/sr], its error and coverage, shape (h, w)."""

    def __init__(
        self, scene: mi.Scene, camera: Camera, window: Window, quadrature: Quadrature, specular: Specular | None
    ) -> None:
        self.scene, self.camera, self.window, self.quadrature = scene, camera, window, quadrature
        self.specular = specular
        dark = quadrature.takes("dark")
        self.glows = [Glow.seen(emitter, camera, window, quadrature.rtol, dark) for emitter in scene.emitters()]
        self.value, self.error, self.coverage = (np.zeros(self.window.shape) for _ in range(3))
        self.peak = float(np.finfo(np.float32).tiny)
        self.rays = self.last_rays = 0
        self.levels: list[str] = []

    def run(self, where: NDArray[np.bool_] | None, least_peak: float, progress: Progress) -> Solution:
        # For a few pixels shadow rays are quicker than the test that makes them unnecessary.
        self.hidden = where is not None or not self._hides_nothing()
        shown = self.window.shown()
        partial = where is not None
        mark = where = shown if where is None else where
        lines = FIRST_LINES
        if mark.any():
            self.value, self.coverage = (np.where(where, image, 0) for image in self._level(lines, mark))
            self.glows = [glow.finer(self._tolerance(least_peak)) for glow in self.glows]
        most = self._most_lines(partial, least_peak)
        levels = 2 + math.floor(math.log(most / (FIRST_LINES * FIRST_GROWTH), GROWTH))
        recent, grid = None, Grid(self.window.shape)
        while mark.any() and (lines := lines * (FIRST_GROWTH if lines == FIRST_LINES else GROWTH)) <= most:
            dark = lines <= DARK_LINES and (mark & (self.coverage == 0)).any()
            if partial and len(self.levels) > 1 and not dark and not self._pays(mark, least_peak):
                break
            progress(len(self.levels) / levels)
            found = None if progress.deadline.passed() else self._level(lines, mark, progress.deadline)
            if found is None:
                break
            value, coverage = found
            change = np.where(mark, np.abs(value - self.value), 0)
            recent, last = SAFETY * grid.array(grid.spread_max(grid.flat(change))), recent
            estimate = recent if last is None else np.maximum(recent, CARRIED * last)
            # Only elements with light on a marked pixel were refined: elsewhere the new image is not complete.
            self.error[mark], self.value[mark], self.coverage[mark] = estimate[mark], value[mark], coverage[mark]
            mark = self.error > self._tolerance(least_peak)
            mark = shown & (mark | where & (self.coverage == 0) & (lines < DARK_LINES))
        if recent is None and mark.any():  # no time for a second level: the change from nothing
            self.error = SAFETY * grid.array(grid.spread_max(grid.flat(self.value)))
        least = max([self.quadrature.least_error, *(glow.unseen for glow in self.glows)])
        error = np.maximum(self.error, least * self.window.brightest(self.value))
        error[self.coverage == 0] = self.error[self.coverage == 0]
        power, error = (self.window.expand(image) * self.camera.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.coverage, 0, 1))
        complete = self.window.expand(where.astype(np.float64)) > 0
        if progress.log:
            progress.log.add("surface form", int(np.count_nonzero(where)), self.rays)
        progress(1.0)
        return Solution(power, error, coverage, self.rays, tuple(self.levels), complete, self._findings())

    def _most_lines(self, partial: bool, least_peak: float) -> int:
        """Lines of sight a pixel of the image at the last level; `partial`: the pupil form follows."""
        bright = HANDED_ON_PEAK * self._tolerance(least_peak) / self.quadrature.rtol
        most = HANDED_ON if partial and most_radiance(self.scene) <= bright else MOST_LINES
        return max(min(self.quadrature.most_nodes, most), FIRST_LINES * FIRST_GROWTH)

    def _pays(self, mark: NDArray[np.bool_], least_peak: float) -> bool:
        """Whether the next level takes no more lines than the marked pixels may take, or ends half of them if their
        errors fall by `FALL`; with `max_nodes` always."""
        most = max(self.quadrature.most_nodes * np.count_nonzero(mark), TOGETHER_BY_SURFACE)
        if self.quadrature.max_nodes is not None or GROWTH * self.last_rays <= most:
            return True
        return bool(np.median(self.error[mark]) * FALL <= self._tolerance(least_peak))

    def _tolerance(self, least_peak: float) -> float:
        """Tolerance [W/mm²/sr]."""
        return self.quadrature.rtol * max(self.window.brightest(self.value), least_peak)

    def _hides_nothing(self) -> bool:
        return self.quadrature.takes("occlusion") and hides_nothing(self.scene)

    def _findings(self) -> tuple[Finding, ...]:
        dark, count = (sum(getattr(glow, name) for glow in self.glows) for name in ("dark", "count"))
        return on_surfaces(self.hidden, dark, count, "elements", False)

    def _level(self, lines: int, mark: NDArray[np.bool_], deadline: Deadline | None = None) -> list[Plane] | None:
        """Value and coverage from all elements with light on a marked pixel, at so many lines of sight a pixel.

        None where the deadline passes before all of them are summed.
        """
        while True:
            quanta = (self.peak * RESOLUTION, COVERAGE_QUANTUM)
            canvas = Canvas(self.window.shape, quanta, self.quadrature.pixel == "centre")
            peak, rays = 0.0, 0
            for glow in self.glows:
                for batch in glow.batches(lines, mark):
                    if deadline and deadline.passed():
                        return None
                    peak = max(peak, self._lay(canvas, batch))
                    rays += int(batch.lines.sum())
            self.rays += rays
            self.last_rays = rays
            if peak <= HEADROOM * self.peak:
                break
            self.peak = peak  # beyond the range of the quanta: once more with larger ones
        self.levels.append(f"{lines} lines a pixel: {np.count_nonzero(mark)} pixels, {rays} lines")
        return canvas.images()

    def _lay(self, canvas: Canvas, batch: Batch) -> float:
        """Lay the light of a batch of lines of sight on the canvas; returns the largest radiance met [W/mm²/sr]."""
        elements, camera = batch.glow.elements, self.camera
        (index, cut, number), m = batch.lanes(), dr.opaque(mi.UInt32, batch.cells)
        part, i, j = number // (m * m), number % m, number // m % m
        within, aim = pupil_cells.strata(i, j, m, index * pupil_cells.STRIDE + part)

        # Smooth factors are taken at a piece's middle (midpoint rule): normals that differ from line to line would make
        # a round shape noisy. J_n and occlusion, which may jump within a piece, are sampled all over it.
        middle, area = elements.place(index, mi.Point2f(*elements.middle), cut, part)
        spot, _ = elements.place(index, within, cut, part)
        _, lens_point, arrival, cos_theta, open_share = camera.open_arrival(middle.p, aim)
        to_lens = dr.normalize(lens_point - middle.p)
        cos_s = dr.dot(middle.n, to_lens)
        arrival *= open_share
        active = (cos_s > 0) & (arrival > 0)
        through = mi.Float(1)
        if self.hidden:
            through = transmission(self.scene, self.specular, spot.p, spot.n, lens_point, active)
            active &= through > 0
        spot.sh_frame.n = spot.n  # not the normal that a mesh is shaded with
        spot.initialize_sh_frame()
        spot.wi = spot.to_local(_turned_along(to_lens, middle.n, spot.n))
        radiance = dr.select(active, through * scalar(batch.glow.emitter.eval(spot, active)), 0)
        virtual_pixel = dr.opaque(mi.Float, camera.virtual_pitch**2)
        cell = [pupil_cells.corner(i + x, j + y, m) for x, y in CORNERS]
        etendue = dr.select(
            active, etendue_from_surface(cos_s, area, arrival, pupil_cells.area(cell), virtual_pixel), 0
        )

        places = {at: elements.place(index, mi.Point2f(*at), cut, part)[0].p for at in CORNERS}
        discs = {at: camera.blur_disc(place) for at, place in places.items()}
        origin = mi.Vector2f(*(dr.opaque(mi.Float, n) for n in self.window.corner))
        node = pupil_cells.middle(i, j, m)
        film = camera.film_map.from_ideal
        images = [
            film(mi.Point2f(centre + radius * camera.opening(place, node)[0])) - origin
            for place, (centre, radius, _) in zip(places.values(), discs.values(), strict=True)
        ]
        # The image of a piece through the cell's middle; or, where that is smaller than a cell's image or the blur disc
        # covers the whole shape, of the cell through the piece's middle. Either way neighbours on the surface or on the
        # pupil are neighbours on the film.
        share = 1 / len(elements.corners)
        centre = sum((discs[at][0] for at in elements.corners), mi.Point2f(0)) * share
        radius = sum((discs[at][1] for at in elements.corners), mi.Float(0)) * share
        least = dr.opaque(mi.Float, BLURRED**2 if batch.glow.small else 0)
        blurred = _size(images) < dr.square(radius) * dr.maximum(dr.two_pi / dr.square(mi.Float(m)), least)
        tiles = [film(mi.Point2f(centre + radius * camera.opening(middle.p, own)[0])) - origin for own in cell]
        polygon = [dr.select(blurred, own, other) for own, other in zip(tiles, images, strict=True)]
        for _, _, scale in discs.values():  # no image where a piece reaches through the lens plane
            active &= scale * discs[CORNERS[0]][2] > 0
        lights = (eq9(mi.Float64(radiance), mi.Float64(etendue)), mi.Float64(etendue / dr.square(dr.square(cos_theta))))
        canvas.lay(lights, polygon, active)
        canvas.sums.evaluate(radiance)
        return float(dr.max(radiance)[0])


def _turned_along(direction: mi.Vector3f, normal: mi.Normal3f, other: mi.Normal3f) -> mi.Vector3f:
    """A direction turned the shortest way that takes one normal to the `other`: as slanted to that as it was."""
    a, b = mi.Vector3f(normal), mi.Vector3f(other)
    return direction - dr.dot(a + b, direction) / (1 + dr.dot(a, b)) * (a + b) + 2 * dr.dot(a, direction) * b


def _size(polygon: list[mi.Point2f]) -> mi.Float:
    """The longer diagonal, squared."""
    a, b, c, d = polygon
    return dr.maximum(dr.squared_norm(c - a), dr.squared_norm(d - b))
