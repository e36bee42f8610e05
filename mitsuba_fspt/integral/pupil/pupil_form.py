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
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...camera.window import Window
from ...jit.batches import batches
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
from .nodes import BOTH, first_nodes, twelve_nodes
from .transects import integrate_by_transects

if TYPE_CHECKING:
    from numpy.typing import NDArray


FEW = 1 << 18  # pixels of the coarse lattice for a lower bound of the brightest pixel
MARGIN = 0.9  # share of their brightest value that counts, for the error of twelve nodes


def solve(
    view: View,
    window: Window,
    quadrature: Quadrature,
    light: NDArray[np.float64],
    given: Solution | None = None,
    least_peak: float = 0.0,
    progress: Progress = SILENT,
) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window, to the accuracy of `quadrature`.

    Only pixels of the `window` are computed, the others are dark. `light`: of surfaces as if in focus, see
    `NarrowLight`. Pixels that the partial solution `given` has are not refined. `least_peak`: lower bound of the
    brightest pixel's mean radiance on film [W/mm²/sr]. `progress` is called after every level.
    """
    draft = Draft(view, window, quadrature, given, least_peak, progress)
    refine(draft, light)
    return draft.solution()


def refine(draft: Draft, light: NDArray[np.float64]) -> None:
    """All steps of the refinement on the pixels of a draft; `light` as of `solve`."""
    quadrature, progress = draft.quadrature, draft.progress
    rough = first_nodes(draft, light)
    levels = node_rules.transect_levels(quadrature.rtol, draft.area, quadrature.max_nodes - BOTH)
    progress(1 / (2 + len(levels)))
    if quadrature.max_nodes >= BOTH and not progress.deadline.passed():
        rough = twelve_nodes(draft, rough, transects_follow=bool(levels))
    progress(2 / (2 + len(levels)))
    if not levels:
        draft.spread_error(rough)
    elif dr.any(rough):
        integrate_by_transects(draft, rough, levels)
    draft.restore_given_errors()
    if levels:
        refine_by_lattices(draft)
    progress(1.0)


def peak_of_few(view: View, window: Window, quadrature: Quadrature) -> float:
    """Lower bound of the brightest pixel's mean radiance on film [W/mm²/sr], from pixels on a coarse lattice."""
    height, width = window.shape
    step = math.ceil(math.sqrt(height * width / FEW))
    y, x = (np.arange(step // 2, side, step, dtype=np.uint32) for side in window.shape)
    centres = window.centres(mi.UInt32((y[:, None] * np.uint32(width) + x).ravel()))
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
