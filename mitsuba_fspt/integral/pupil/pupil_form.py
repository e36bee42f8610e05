"""Eq. 9 in its pupil form: P = étendue · mean over pixel and pupil of cos⁴θ · L(first surface point on the line).

Four rules in turn. Every pixel takes four nodes over pupil and pixel, or one node where the pupil is nearly a point
and the blur disc stays in the pixel. Pixels on which the image is curved take twelve. Pixels on which the radiance
jumps between lines of sight (a silhouette, an occluder, an edge of J_n) take transects: curves across the edge through
pixel × pupil. The jumps along each transect are found by bisection and the pieces between them are integrated
separately, so that only the variation along the edge is left to sample. Pixels on which transects do not converge take
lattices of lines of sight, whose scatter gives the error. Each line of sight is `eq9.View.integrand`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...camera.window import Window
from ...jit.batches import batches
from ...jit.from_numpy import from_numpy
from ...jit.pixel_grid import Grid
from ..lines.eq9 import View
from ..lines.specular import Specular
from ..lines.visible_window import visible_window
from ..progress import SILENT, Progress
from ..quadrature import Quadrature
from ..solution import Solution
from . import node_rules
from .draft import Draft, open_share
from .lattices import refine_by_lattices
from .node_sums import apply_rule
from .nodes import BOTH, LIGHT_KNOWN, first_nodes, twelve_nodes
from .transects import integrate_by_transects

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ...jit.pixel_grid import Mask, PixelArray
    from .dark_bodies import DarkBodies
    from .narrow import NarrowLight

# Lines of sight of a pixel that twelve nodes leave above the tolerance, as of a straight silhouette; the same where the
# faces are projected in any case, for narrow light.
FIRST_LINES, BESIDE_NARROW = 70, 600
# Rounding of sums of faces' light along a row of pixels, over the brightest pixel. A value of lines of sight from which
# they differ by less is kept: beside a far brighter surface it is more exact.
ROUNDING = 1e-12
# Error of an image of faces, of which its difference to transects is so large a share that these count as contradicted.
# On a torus that hides itself, f/8, any difference above the error of transects gave 3.3 times the lines of sight.
CONTRADICTED = 0.5

FEW = 1 << 18  # pixels of the coarse lattice for a lower bound of the brightest pixel
MARGIN = 0.9  # share of their brightest value that counts, for the error of twelve nodes


def solve(
    view: View,
    window: Window,
    quadrature: Quadrature,
    narrow: NarrowLight,
    given: Solution | None = None,
    least_peak: float = 0.0,
    progress: Progress = SILENT,
    by_faces: ByFaces | None = None,
    on_faces: NDArray[np.bool_] | None = None,
    dark: DarkBodies | None = None,
) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window, to the accuracy of `quadrature`.

    Only pixels of the `window` are computed, the others are dark. `narrow`: light of the surfaces on them; that of
    narrow spots, and narrow shade of `dark` bodies and light between them, count as errors unless the lines of sight
    of a pixel suffice to meet them. Pixels that the partial solution `given` has are not refined. `least_peak`: lower
    bound of the brightest pixel's mean radiance on film
    [W/mm²/sr]. `progress` is called after every level. `by_faces`, `on_faces` as of `refine`.
    """
    draft = Draft(view, window, quadrature, given, least_peak, progress)
    draft.set_narrow(narrow)
    if dark:
        draft.set_dark(dark)
    refine(draft, narrow.in_focus, by_faces, on_faces)
    return draft.solution()


def refine(
    draft: Draft,
    light: NDArray[np.float64],
    by_faces: ByFaces | None = None,
    on_faces: NDArray[np.bool_] | None = None,
) -> None:
    """All steps of the refinement on the pixels of a draft; `light`: of surfaces as if in focus, see `NarrowLight`.

    `by_faces` gives the pixels that twelve nodes, or some transects, leave above the tolerance from the faces of all
    surfaces if lines of sight are expected to take more time. Pixels that are marked in `on_faces` (h, w), whose light
    lines of sight may miss, take their value from the faces in any case.
    """
    quadrature, progress = draft.quadrature, draft.progress
    rough = first_nodes(draft, light)
    levels = node_rules.transect_levels(quadrature.rtol, draft.area, quadrature.most_nodes - BOTH)
    progress(1 / (2 + len(levels)))
    if quadrature.most_nodes >= BOTH and not progress.deadline.passed():
        rough = twelve_nodes(draft, rough, transects_follow=bool(levels))
    progress(2 / (2 + len(levels)))
    faces = None
    if by_faces:
        faces = _Faces(draft, by_faces, np.zeros(draft.window.shape, bool) if on_faces is None else on_faces)
        beside = on_faces is not None and on_faces.any()
        left = faces(rough | draft.varied(), (BESIDE_NARROW if beside else FIRST_LINES) if levels else 0.0)
        rough = left if faces.taken else rough
    if not levels:
        draft.spread_error(rough)
    elif dr.any(rough):
        integrate_by_transects(draft, rough, levels, faces=faces)
    draft.restore_given_errors()
    if faces and levels:
        faces.further()
    draft.count_missed()
    if levels:
        refine_by_lattices(draft)
    progress(1.0)


class ByFaces(Protocol):
    """The image of pixels that are marked in (h, w), from the faces of all surfaces.

    peak : lower bound of the brightest pixel's mean radiance on film [W/mm²/sr]
    """

    def cost(self, marked: NDArray[np.bool_], peak: float, most: float = math.inf) -> float:
        """Lines of sight in whose time it is computed; a number above `most` may be too small."""
        ...

    def run(self, marked: NDArray[np.bool_], peak: float, progress: Progress) -> Solution:
        """The image, complete on the marked pixels."""
        ...

    def further(self, marked: NDArray[np.bool_], peak: float, progress: Progress) -> Solution:
        """The same of some of these pixels, refined further if lattices would take more time."""
        ...


@dataclass
class _Faces:
    """Gives rough pixels of a draft their value `by_faces`, once; they count as given from then on.

    So do pixels on and around them on which no line of sight has met a glowing surface, but faces send light: a corner
    of the surface may lie between all lines.

    narrow : pixels (h, w) that get it in any case; set to False if the deadline leaves no time for them
    found : the pixels, their values, errors and coverage
    """

    draft: Draft
    by_faces: ByFaces
    narrow: NDArray[np.bool_]
    taken: bool = False
    found: tuple[Mask, PixelArray, PixelArray, PixelArray] | None = None

    def __call__(self, rough: Mask, lines: float) -> Mask:
        """The rough pixels without those that get their value from faces, if that takes less time than as many `lines`
        of sight for each of them."""
        draft, grid = self.draft, self.draft.grid
        visible = grid.array(draft.shown & draft.computed & ~(draft.clipped | draft.outside))
        allowed = visible & draft.window.fully_open(draft.camera) & ~grid.array(draft.in_doubt())
        wanted, forced = grid.array(rough) & allowed, self.narrow & allowed
        if not self.taken and draft.progress.deadline.passed():
            self.narrow[:] = False
            return rough
        if self.taken or not (wanted | forced).any():
            return rough
        # Of a pixel with an edge twelve nodes may be far too bright.
        certain = dr.max(dr.select(draft.shown & ~grid.flat(forced), draft.value - draft.error, 0))
        peak = max(float(draft.at_least_peak(certain)[0]), 0.0)
        least = self.by_faces.cost(forced, peak) if forced.any() else 0.0
        most = least + lines * np.count_nonzero(wanted & ~forced)
        if self.by_faces.cost(wanted | forced, peak, most) > most:
            wanted = forced
        if not (wanted | forced).any():
            return rough
        self.taken = True
        around = draft.grown_by_reach(grid.flat(wanted & ~forced)) & (draft.coverage == 0)
        wanted |= grid.array(around) & allowed
        found = self.by_faces.run(wanted | forced, peak, Progress(deadline=draft.progress.deadline))
        self._count(found)
        left, done = self._give(found, grid.flat(wanted | forced), grid.flat(forced), peak)
        return (rough | left) & ~done

    def _give(self, found: Solution, wanted: Mask, forced: Mask, peak: float) -> tuple[Mask, Mask]:
        """Set the values, errors and coverage that are better; returns pixels with errors above the tolerance before,
        and those that are not refined further."""
        draft = self.draft
        power, error, coverage = self._images(found)
        draft.error = dr.select(wanted, dr.maximum(draft.error, draft.unseen_variation()), draft.error)
        brightest = dr.maximum(dr.max(dr.select(wanted, power, 0)), dr.opaque(mi.Float64, peak))
        tolerance = dr.opaque(mi.Float64, draft.quadrature.rtol) * brightest
        self._count_unmet(wanted, power)
        left = wanted & (draft.error > tolerance)
        taken = wanted & ((error < draft.error) | forced)
        done = taken & ((error <= tolerance) | forced)
        same = dr.abs(power - draft.value) <= dr.opaque(mi.Float64, ROUNDING) * brightest
        power = dr.select(same, draft.value, power)
        self.found = wanted, power, error, coverage
        self._set(taken)
        draft.given, draft.given_error = (
            dr.select(done, new, old) for new, old in ((power, draft.given), (error, draft.given_error))
        )
        draft.computed &= ~done
        dr.eval(draft.value, draft.error, draft.given, draft.given_error, draft.computed)
        return left, done

    def _count_unmet(self, where: Mask, power: PixelArray) -> None:
        """Count light that faces send as an error of the pixels on which no line of sight meets a glowing surface."""
        draft, most = self.draft, dr.opaque(mi.Float64, LIGHT_KNOWN) * power
        draft.error = dr.select(where & (draft.coverage == 0), dr.maximum(draft.error, most), draft.error)

    def further(self) -> None:
        """Before lattices: the values of faces again where those of transects have larger errors, refined further.

        Where transects have the smaller error, but the faces would have to be nearly as wrong as they state for both to
        be right, the difference is the error: few transects may agree by chance.
        """
        draft, grid = self.draft, self.draft.grid
        if self.found is None:
            return
        known, power, error, _ = self.found
        self._count_unmet(known & draft.computed, power)
        change = dr.abs(power - draft.value)
        doubtful = change > dr.opaque(mi.Float64, CONTRADICTED) * error
        differ = dr.select(doubtful, dr.minimum(change, error), 0)
        self._set(known & draft.computed & (error < draft.error))
        draft.error = dr.select(known & draft.computed, dr.maximum(draft.error, differ), draft.error)
        left = grid.array(known & draft.shown & (draft.error > draft.tolerance))
        if not left.any() or draft.progress.deadline.passed():
            return
        peak = max(float(draft.at_least_peak(draft.peak)[0]), 0.0)
        found = self.by_faces.further(left, peak, Progress(deadline=draft.progress.deadline))
        self._count(found)
        power, error, coverage = self._images(found)
        self.found = grid.flat(left), power, error, coverage
        self._set(grid.flat(left) & (error < draft.error))

    def _count(self, found: Solution) -> None:
        """Record the work on an image of faces."""
        self.draft.rays += found.rays
        self.draft.levels += found.levels
        if self.draft.progress.log:
            self.draft.progress.log.add("images of faces", int(np.count_nonzero(found.where)), found.rays)

    def _images(self, found: Solution) -> list[PixelArray]:
        """Mean radiance on film [W/mm²/sr], its error, and coverage on the grid."""
        etendue = self.draft.camera.etendue
        images = (found.power / etendue, found.error / etendue, found.coverage)
        return [self.draft.grid.flat(self.draft.window.cut(image)) for image in images]

    def _set(self, where: Mask) -> None:
        """Set the values, errors and coverage of some of the pixels."""
        draft = self.draft
        if self.found is None:
            raise TypeError("no image of faces")
        _, power, error, coverage = self.found
        draft.value, draft.error = dr.select(where, power, draft.value), dr.select(where, error, draft.error)
        draft.set_coverage(dr.select(where, coverage, draft.coverage))


def peak_of_few(view: View, window: Window, quadrature: Quadrature) -> float:
    """Lower bound of the brightest pixel's mean radiance on film [W/mm²/sr], from pixels on a coarse lattice."""
    height, width = window.shape
    step = math.ceil(math.sqrt(height * width / FEW))
    y, x = (np.arange(step // 2, side, step, dtype=np.uint32) for side in window.shape)
    centres = window.centres(from_numpy(mi.UInt32, y[:, None] * np.uint32(width) + x))
    seen = apply_rule(view, centres, node_rules.twelve(quadrature.pixel == "area"), ("value",))
    return MARGIN * float(dr.max(seen.value)[0])


def coverage(scene: mi.Scene, camera: Camera) -> NDArray[np.float64]:
    """Share of each pixel's lines of sight that meet a glowing surface, by twelve of them; shape (h, w)."""
    window = visible_window(scene, camera)
    if 0 in window.shape:
        return np.zeros(window.full)
    return coverage_of(View.of(scene, camera, window, specular=Specular.of(scene, camera)), window)


def coverage_of(view: View, window: Window) -> NDArray[np.float64]:
    """As `coverage`, of the pixels of a window that is not empty; 0 on the others of the crop window, shape (h, w)."""
    grid = Grid(window.shape)
    image = grid.full(mi.Float64, 0)
    for part in batches(grid.number):
        coverage = apply_rule(view, window.centres(part), node_rules.twelve(True), ("coverage",)).coverage
        dr.scatter(image, mi.Float64(coverage), part)
    return window.expand(grid.array(image * open_share(view.camera, window, grid)))
