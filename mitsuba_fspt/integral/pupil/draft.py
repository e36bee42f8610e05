"""Image of the pupil form (Eq. M.5) during refinement, and the error of pixels on which lines may miss an edge."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...camera.window import Window
from ...jit.pixel_grid import COVERAGE_ROUNDING, Grid, parted
from ...runtime.plugin_types import is_surface
from ..lines.eq9 import View, most_radiance
from ..progress import SILENT, Progress
from ..quadrature import Quadrature
from ..solution import Solution
from . import node_rules
from .narrow import NARROW, SHARP

if TYPE_CHECKING:
    from ...jit.pixel_grid import Mask, PixelArray
    from .dark_bodies import DarkBodies
    from .narrow import NarrowLight

FULL = 1e-6  # rounding of the coverage, a sum of float32 weights
# Largest error of a rule at a straight silhouette, sharp or blurred, as a share of the light: where the silhouette lies
# between the nodes, and where it lies in the gap between the nodes and the rim of the pupil.
PARTED = {1: (0.5, 0.5), 4: (0.35, 0.35), 12: (0.3, 0.21)}
MISSED = {1: (0.5, 0.5), 4: (0.21, 0.2), 12: (0.15, 0.07)}
MISSED_BY_TRANSECTS = 0.0125  # likewise of the first transects, in the gap between these and the rim of the pupil
IN_FOCUS = 0.3  # blur radius [pixels] below which an edge counts as sharp in these tables


class Draft:
    """Images on the `grid` of the window: `value`, mean radiance on film [W/mm²/sr], its `error` and `coverage`.

    nodes : number of nodes of the last rule that was applied
    lost : share of the radiance on film that is not followed through or off specular surfaces
    roughness : difference between four nodes and twelve on a pixel or a neighbour, without silhouettes [W/mm²/sr]
    nearest : depth of the nearest surface [mm], inf without one
    blur, most_blur : largest blur radius of surfaces on a pixel and its neighbours; of all pixels [pixels]
    least_blur : smallest blur radius between the nearest and the farthest surface, inf without one [pixels]
    sharp : True where least_blur is below `IN_FOCUS` on the pixel or a neighbour
    edge_on : light of surfaces edge-on as of `NarrowLight`, 0 unless it is set [W/mm²/sr]
    missed, narrow_radiance : light of narrow spots, and at last through narrow openings, that lines of sight may miss,
        and the largest radiance of these, 0 unless they are set [W/mm²/sr]
    variation : change of each pixel by variation of J_n that lines of sight may miss, 0 unless it is set [W/mm²/sr]
    dark : dark bodies on the window, None unless they are set
    by_narrow : True where that light, variation or shade alone makes the error larger than the tolerance
    outline : True within a pixel of lines of sight that meet a glowing surface and of others that do not
    shown : False on the rim of the window; one entry if there is none
    clipped, outside : the border of the image-plane stop crosses the pixel; the pixel lies beyond the stop
    computed, given, given_error : False on pixels that another solution gives; its values and errors [W/mm²/sr]
    least_peak : lower bound of the brightest pixel of the whole image, of which this one is a part [W/mm²/sr]
    progress : called after each step with the share of the steps that is done
    grid : the pixels that are computed; by default all of the window
    """

    def __init__(
        self,
        view: View,
        window: Window,
        quadrature: Quadrature,
        given: Solution | None,
        least_peak: float = 0.0,
        progress: Progress = SILENT,
        grid: Grid | None = None,
    ) -> None:
        self.view, self.camera, self.window, self.quadrature = view, view.camera, window, quadrature
        self.estimator = quadrature.estimator
        self.least_peak, self.progress = least_peak, progress
        self.area = quadrature.pixel == "area"
        self.grid = grid = grid or Grid(window.shape)
        self.value, self.error, self.coverage, self.blur = (grid.full(mi.Float64, 0) for _ in range(4))
        self.least_blur = grid.full(mi.Float64, dr.inf)
        self.sharp = grid.full(mi.Bool, False)
        self.nearest = grid.full(mi.Float64, dr.inf)
        self.roughness, self.lost, self.edge_on = (grid.full(mi.Float64, 0) for _ in range(3))
        self.missed, self.variation = (grid.full(mi.Float64, 0) for _ in range(2))
        self.narrow_radiance, self.by_narrow = 0.0, mi.Bool(False)
        self.dark: DarkBodies | None = None
        self.shown = grid.flat(window.shown()) if window.count < math.prod(window.shape) else mi.Bool(True)
        self.clipped, self.outside = (grid.full(mi.Bool, False) for _ in range(2))
        if math.isfinite(view.camera.lens.seen_field):
            inside, cut = window.field_stop(view.camera)
            self.clipped, self.outside = grid.flat(cut & self.area), grid.flat(~(inside | cut))
        self.outline, self.most_blur = grid.full(mi.Bool, False), 0.0
        self.computed = grid.full(mi.Bool, True)
        self.given, self.given_error = (grid.full(mi.Float64, 0) for _ in range(2))
        if given is not None:
            self.computed = grid.flat(~window.cut(given.where))
            self.given, self.given_error = (
                grid.flat(window.cut(image) / view.camera.etendue) for image in (given.power, given.error)
            )
        self._peak: tuple[PixelArray, PixelArray] | None = None  # of the value before it
        self.nodes = self.rays = 0
        self.levels: list[str] = []
        self.findings = view.findings()

    @property
    def peak(self) -> PixelArray:
        """Largest value in the crop window, else on its rim, and at least `least_peak` [W/mm²/sr]; one entry."""
        if self._peak is None or self._peak[0] is not self.value:
            most = dr.max(self.value)
            if len(self.shown) > 1:
                shown = dr.max(dr.select(self.shown, self.value, 0))
                most = dr.select(shown > 0, shown, most)
            self._peak = self.value, self.at_least_peak(most)
        return self._peak[1]

    def at_least_peak(self, value: PixelArray) -> PixelArray:
        """`value`, or `least_peak` if that is larger."""
        return dr.maximum(value, dr.opaque(mi.Float64, self.least_peak)) if self.least_peak else value

    @property
    def tolerance(self) -> PixelArray:
        """Tolerance: rtol times the brightest pixel [W/mm²/sr]; one entry."""
        return dr.opaque(mi.Float64, self.quadrature.rtol) * self.peak

    def centres(self, number: mi.UInt32) -> mi.Point2f:
        """Film positions [pixels] of the centres of the pixels with this `number` on the grid."""
        return self.window.centres(self.grid.place(number))

    def images(self) -> tuple[PixelArray, PixelArray, PixelArray]:
        """Power [W], error [W] and coverage on the pixels of the grid."""
        least = dr.opaque(mi.Float64, self.quadrature.least_error) * self.peak
        error = dr.select(self.coverage == 0, self.error, dr.maximum(self.error, least))
        if self.view.specular:
            # The few lines of sight of a pixel may miss a surface that those of a neighbour meet.
            lost = self.grid.spread_max(self.lost, self.reach(self.nodes)[1])
            error += lost * dr.opaque(mi.Float64, most_radiance(self.view.scene))
        if self.progress.deadline.cut and all(map(is_surface, self.view.scene.emitters())):
            # The radiance is between 0 and the largest of the scene; estimates from few lines of sight exceed that.
            most = dr.opaque(mi.Float64, most_radiance(self.view.scene))
            error = dr.minimum(error, dr.maximum(self.value, most - self.value))
        coverage = dr.select(self.coverage > 1 - FULL, 1, dr.maximum(self.coverage, 0))
        etendue = dr.opaque(mi.Float64, self.camera.etendue)
        power, error = etendue * self.value, etendue * dr.select(self.outside, 0, error)
        images = (power, error, coverage * open_share(self.camera, self.window, self.grid))
        dr.eval(images)
        return images

    def solution(self) -> Solution:
        """The present image, on the crop window."""
        arrays = (self.window.expand(self.grid.array(image)) for image in self.images())
        return Solution(*arrays, self.rays, tuple(self.levels), findings=tuple(self.findings))

    def restore_given_errors(self) -> None:
        """Set the errors of given values; before, errors of the rules on these pixels count for their neighbours."""
        self.error = dr.select(self.computed, self.error, self.given_error)

    def set_narrow(self, narrow: NarrowLight) -> None:
        """Set the light of surfaces, and its variation, that lines of sight may miss."""
        self.missed, self.narrow_radiance = self.grid.flat(narrow.at_most), narrow.radiance
        self.set_surfaces(narrow)

    def set_surfaces(self, narrow: NarrowLight) -> None:
        """Set the light of surfaces edge-on, and the variation of J_n, alone."""
        self.edge_on, self.variation = (self.grid.flat(image) for image in (narrow.edge_on, narrow.variation))

    def set_dark(self, dark: DarkBodies) -> None:
        """Set what dark bodies hide, and what passes between them, that lines of sight may miss."""
        self.dark = dark
        most = (float(change.max(initial=0.0)) for _, change in dark.openings)
        self.narrow_radiance = max(self.narrow_radiance, *most, 0.0)

    def in_doubt(self) -> Mask:
        """Pixels on which dark bodies may take or let through more light than nodes show."""
        return self._above(dr.maximum(*self._by_dark_bodies()))

    def varied(self) -> Mask:
        """Pixels on which J_n may vary more than nodes show."""
        return self._above(self.unseen_variation())

    def unseen_variation(self) -> PixelArray:
        """`variation`; the middle of a pixel sees none where it is in focus."""
        return self.variation if self.area else dr.select(self.blur < SHARP, 0, self.variation)

    def _above(self, light: PixelArray) -> Mask:
        """True where light counts that nodes do not show."""
        return light > dr.opaque(mi.Float64, NARROW) * self.tolerance

    def _by_dark_bodies(self) -> tuple[PixelArray, PixelArray]:
        """Largest light that dark bodies take from each pixel, and let through to it [W/mm²/sr]."""
        zero = self.grid.full(mi.Float64, 0)
        if self.dark is None or not (self.dark.openings or self.dark.shade.any()):
            return zero, zero
        light = np.zeros(self.grid.shape)
        self.grid.lay(self.value, light)
        return self.grid.flat(self.dark.taken(light)), self.grid.flat(self.dark.let_through(light))

    def count_missed(self) -> None:
        """Count narrow light, variation and shade as errors of the pixels that no other solution gives."""
        taken, let_through = self._by_dark_bodies()
        self.missed = dr.maximum(self.missed, let_through)
        missed = dr.maximum(dr.maximum(self.missed, self.unseen_variation()), taken)
        error = dr.select(self.computed, dr.maximum(self.error, missed), self.error)
        self.by_narrow = (self.error <= self.tolerance) & (error > self.tolerance)
        self.error = error

    def count(self, what: str, pixels: mi.UInt32, rays: int) -> None:
        """Record the name of a rule, the numbers of the pixels it was applied to, and their lines of sight."""
        touched = dr.width(pixels)
        self.rays += rays
        self.levels.append(f"{what}: {touched} pixels")
        if log := self.progress.log:
            others = self.view.specular is not None and self.view.specular.part == "others"
            log.add(f"other courses, {what}" if others else what, touched, rays)
            if touched and self.camera.pixel_pitch == log.pixel_pitch:
                lines, plane = self.grid.full(mi.Float64, 0), np.zeros(self.window.shape)
                dr.scatter(lines, mi.Float64(rays / touched), pixels)
                self.grid.lay(lines, plane)
                log.add_lines(self.window.crop_offset, self.window.expand(plane))

    # ------------------------------------------------------------------ edges between lines of sight

    def set_blur(self, front: PixelArray, farthest: PixelArray) -> None:
        """Set blur radii from the depths of the nearest and the farthest surface [mm].

        `front`: depth of the nearest surface, mirrors and panes included. The blur grows on both sides of the virtual
        detector plane.
        """
        seen = dr.isfinite(self.nearest)
        front, back = (self.camera.blur_radius(depth) for depth in (front, farthest))
        through = (front > 0) & (back < 0)  # the virtual detector plane lies between
        front, back = dr.abs(front), dr.abs(back)
        self.least_blur = dr.select(seen, dr.select(through, 0, dr.minimum(front, back)), dr.inf)
        most = dr.opaque(mi.Float64, max(self.grid.shape))
        blur = dr.select(seen, dr.minimum(dr.maximum(front, back), most), 0)
        sharp = seen & (dr.minimum(front, back) < IN_FOCUS)
        dr.eval(blur, sharp, self.least_blur)
        self.most_blur = float(dr.max(blur)[0])
        self.blur, near = self.grid.spread_all((blur, sharp))
        self.sharp = self.grid.dilate(near, math.ceil(IN_FOCUS))

    def reach(self, rule: int | str) -> tuple[mi.Int, int]:
        """Distance [pixels] from a pixel with an edge at which a rule may miss it: of each pixel, and the largest."""
        reach = 1 + mi.Int(dr.ceil(dr.opaque(mi.Float64, node_rules.GAP[rule]) * self.blur))
        return reach, 1 + math.ceil(node_rules.GAP[rule] * self.most_blur)

    def set_coverage(self, coverage: PixelArray) -> None:
        """Set the coverage of each pixel, and the outline that follows from it."""
        self.coverage, self.outline = coverage, self.grid.outline(coverage)

    def grown_by_reach(self, mask: Mask) -> Mask:
        """The marked pixels, and those around on which four nodes may miss the same edge."""
        return self.grid.grow(mask, *self.reach(4))

    def grown(self, rough: Mask) -> Mask:
        """`rough` and the pixels around on which the same step of J_n may lie; silhouettes are in `edge_error`."""
        source = rough & (self.error > self.tolerance) & ~self.outline
        return rough | self.grid.grow(source, *self.reach(self.nodes))

    def spread_error(self, rough: Mask) -> None:
        """Extend errors of `rough` pixels to those around on which the same edge may lie; no finer rule follows."""
        around = self.grid.spread_max(dr.select(rough, self.error, 0), self.reach(self.nodes)[1])
        self.error = dr.select(self.grown(rough), dr.maximum(self.error, around), self.error)

    def edge_error(self) -> PixelArray:
        """Error of the nodes at silhouettes and at the image-plane stop (tables `PARTED` and `MISSED`)."""
        reach, most = self.reach(self.nodes)
        cut, unseen = (
            dr.select(self.sharp, *(dr.opaque(mi.Float64, n) for n in share[self.nodes])) for share in (PARTED, MISSED)
        )
        share = dr.select(self.grid.grow(self.outline, reach - 1, most - 1), unseen, 0)
        share = dr.select(parted(self.coverage) | self.clipped, cut, share)
        return share * self._whole(most)

    def missed_edge_error(self, split: Mask) -> PixelArray:
        """Error of the first transects that cross no jump, near pixels on which they do (`split`)."""
        reach, most = self.reach("transects")
        whole = dr.opaque(mi.Float64, MISSED_BY_TRANSECTS) * self._whole(most)
        return dr.select(self.grid.grow(split, reach, most), whole, 0)

    def wanted(self) -> Mask:
        """Pixels of the crop window, and those of the rim whose edges may reach into it."""
        if len(self.shown) == 1:
            return self.shown
        return self.grid.dilate(self.shown, self.reach("transects")[1])

    def near_edge(self, image: PixelArray) -> PixelArray:
        """Largest value within the distance at which transects may miss an edge."""
        return self.grid.spread_max(image, self.reach("transects")[1])

    def _whole(self, reach: int) -> PixelArray:
        """Largest value within `reach`, each scaled to full coverage."""
        whole = dr.select(self.coverage > COVERAGE_ROUNDING, self.value / self.coverage, 0)
        return self.grid.spread_max(whole, reach)


def open_share(camera: Camera, window: Window, grid: Grid) -> PixelArray:
    """Share of the pupil that a second border of the lens leaves open to the centre of each pixel."""
    return mi.Float64(camera.open_pupil(window.centres(grid.place(grid.number)), mi.Point2f(0))[1])
