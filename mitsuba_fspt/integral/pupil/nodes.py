"""Nodes of Eq. M.5 over pupil and pixel: one or four on all pixels, twelve where the image is curved or four fail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ...emission.of_emitter import surface_of
from ...jit.batches import batches
from ...jit.pixel_grid import COVERAGE_ROUNDING, parted
from ..shortcuts import Finding
from . import node_rules
from .draft import Draft
from .node_sums import ALL, NOTHING_SEEN, Sums, apply_rule

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ...jit.pixel_grid import Mask, PixelArray

BY_SPECULAR_SURFACES = ("lost", "front")  # sums that only specular surfaces change
REFINED = ("value", "coverage", "nearest", "lost")  # sums of twelve nodes that are used
BOTH = 4 + 12  # lines of sight a pixel of both rules; with fewer allowed only four are taken
# One line of sight a pixel suffices where cos⁴θ varies by less than this share of rtol over the pupil and the blur disc
# lies in the pixel: the image's curvature, from which the error follows, is that over a pixel.
FALLOFF, IN_PIXEL = 0.1, 0.5
LIGHT_KNOWN = 2.0  # factor to which the light that surfaces send to a pixel is known
# Error of a node rule over the change of the value from the rule before. Where J_n is rough, both rules have errors of
# like size, and by chance their change is smaller on a few of a thousand pixels (scripts/every_pixel.py).
AGREEMENT = 2.0
TURN_REACH = 2  # pixels around over which the correction `four_turn` is averaged, to leave out the roughness of J_n


def first_nodes(draft: Draft, light: NDArray[np.float64]) -> Mask:
    """One or four nodes over pupil and pixel everywhere; returns the pixels to be refined.

    `light`: mean radiance on film that surfaces send to each pixel if they are in focus, to a factor of two.
    """
    grid = draft.grid
    rule = node_rules.one() if _one_suffices(draft) else node_rules.four(draft.area)
    seen = apply_nodes(draft, rule)
    draft.value = dr.select(draft.computed, seen.value, draft.given)
    if len(rule) == 1 and (not dr.any(seen.value > 0) or dr.any(_missed(draft, grid.flat(light)))):
        rule = node_rules.four(draft.area)
        seen = apply_nodes(draft, rule)
    mx, my, draft.nearest = seen.x, seen.y, seen.nearest
    draft.nodes = len(rule)
    draft.set_coverage(seen.coverage)
    draft.set_blur(seen.front, seen.farthest)
    draft.lost = seen.lost
    draft.value = value = dr.select(draft.computed, seen.value, draft.given)
    # An estimate of fourth order, as the rule's own error is, from the first moments M over the pupil: of an integrand
    # m exp(g·a/m) they are g/4.
    square = 16 * (mx * mx + my * my)
    bend = dr.abs(seen.contrast) + dr.select(value > 0, square * square / (4 * value * value * value), 0)
    neighbours = draft.area or len(rule) == 1  # count for the curvature of the image
    if neighbours:
        xx, yy = grid.second_differences(value)
        dr.eval(xx, yy)
        xxxx, yyyy = grid.second_differences(xx)[0], grid.second_differences(yy)[1]
        bend += (dr.abs(xxxx) + dr.abs(yyyy)) / 12
        if len(rule) == 1:
            more = node_rules.one_spread(xx + yy, draft.blur, draft.area)
        else:
            turn = node_rules.four_turn(grid.gradient(mx)[1] - grid.gradient(my)[0], xx + yy)
            more = -grid.mean_where(turn, ~draft.outline, TURN_REACH)
        draft.value = dr.maximum(value + dr.select(draft.coverage > 1 - COVERAGE_ROUNDING, more, 0), 0)
    bend = grid.spread_max(bend)
    draft.error = dr.maximum(bend, draft.edge_error())
    tolerance = draft.tolerance
    rough = draft.error > tolerance
    dr.eval(draft.error, rough)
    if (neighbours and min(grid.shape) < 3) or not draft.quadrature.takes("smooth"):
        rough = grid.full(mi.Bool, True)
    return (rough | grid.border() | _dark(draft)) & draft.computed  # the border lacks neighbours for an estimate


def twelve_nodes(draft: Draft, rough: Mask, transects_follow: bool) -> Mask:
    """Twelve nodes over pupil and pixel on the rough pixels and around them; returns the pixels to be refined further.

    The estimate for four nodes may be too small by chance. So one pixel of sixteen, a probe, takes twelve in any case,
    and the difference there is an error of the pixels around.
    """
    rough = draft.grown(rough) & draft.computed
    dr.eval(rough)
    smooth = int(dr.count(~rough & (draft.coverage > 0))[0])
    why = f"on {smooth} of {len(draft.grid)} pixels the image of the surface is smooth, without an edge"
    draft.findings.append(Finding("smooth", smooth > 0, why))
    # An edge that passes between four nodes passes between twelve as well: transects follow at once.
    begun = parted(draft.coverage) & (draft.error > draft.tolerance) & dr.opaque(mi.Bool, transects_follow)
    probes = draft.grid.probes() & (draft.coverage > 0) & ~rough & draft.computed
    draft.nodes = 12
    difference = _refine(draft, (rough & ~begun) | probes)
    probed = draft.grid.spread_over_probes(dr.select(probes, difference, 0))
    draft.error = dr.select(rough, draft.error, dr.maximum(draft.error, probed))
    beyond = ~rough & (draft.coverage > 0) & (draft.error > draft.tolerance) & draft.computed
    dr.eval(draft.error, beyond)
    if dr.any(beyond):
        _refine(draft, beyond & ~probes)
    rough = rough | beyond
    return rough & (draft.grown(rough & (draft.error > draft.tolerance)) | _dark(draft))


def _dark(draft: Draft) -> Mask:
    """True, one entry, if no line of sight of any pixel has met light, though glowing surfaces are in the window."""
    return mi.Bool(False) if draft.least_peak else ~dr.any(draft.value > 0)


def _missed(draft: Draft, light: PixelArray) -> Mask:
    """Pixels to which surfaces send far more light than lines of sight of the pixel and its neighbours meet.

    A body up to √2 pixels wide may lie between single lines of sight.
    """
    least = dr.maximum(LIGHT_KNOWN * draft.grid.spread_max(draft.value), draft.tolerance)
    return draft.computed & ~draft.outside & (light > least)


def _one_suffices(draft: Draft) -> bool:
    """True if one line of sight a pixel suffices: the radiance varies no more over the pupil than over a pixel."""
    lens, blur = draft.camera.lens, draft.window.blur
    curvature = 2 * (lens.pupil_radius / lens.focus_distance) ** 2
    rtol = draft.quadrature.rtol
    suffices = curvature <= FALLOFF * rtol and blur <= IN_PIXEL and len(lens.discs) == 1
    bends = bool(draft.view.specular and draft.view.specular.bending)
    lambert = all((own := surface_of(emitter)) and own.is_isotropic() for emitter in draft.view.scene.emitters())
    taken = suffices and lambert and not bends and draft.quadrature.takes("one line")
    why = f"cos⁴θ differs by {curvature:.1e} over the pupil, blur discs reach {blur:.2g} pixels"
    why += "" if lambert else ", the radiance depends on direction"
    why += ", mirrors or glass bend lines of sight" if bends else ""
    draft.findings.append(Finding("one line", taken, why))
    return taken


def _refine(draft: Draft, where: Mask) -> PixelArray:
    """Twelve nodes on the marked pixels; returns their error by the change of the value there, 0 elsewhere."""
    seen = apply_nodes(draft, node_rules.twelve(draft.area), where, REFINED)
    difference = dr.select(where, dr.opaque(mi.Float64, AGREEMENT) * dr.abs(seen.value - draft.value), 0)
    draft.value = dr.select(where, seen.value, draft.value)
    draft.set_coverage(dr.select(where, seen.coverage, draft.coverage))
    draft.nearest = dr.minimum(draft.nearest, seen.nearest)
    draft.lost = dr.select(where, dr.maximum(draft.lost, seen.lost), draft.lost)
    rough = dr.select(parted(seen.coverage), 0, difference)
    rough, left = draft.grid.spread_all((rough, difference))
    draft.roughness = dr.maximum(draft.roughness, rough)
    draft.error = dr.select(where, dr.maximum(left, draft.edge_error()), draft.error)
    dr.eval(draft.value, draft.error, draft.roughness, draft.nearest, draft.lost, difference)
    return difference


def apply_nodes(draft: Draft, rule: node_rules.Rule, where: Mask | None = None, names: Sequence[str] = ALL) -> Sums:
    """Sums of a rule on all or on the marked pixels, `NOTHING_SEEN` elsewhere.

    Images for the given `names`; the others are a single number each.
    """
    specular = draft.view.specular
    stored = [name for name in names if specular or name not in BY_SPECULAR_SURFACES]
    if where is None:
        index = draft.grid.pixels()
        images = {name: dr.empty(mi.Float64, len(draft.grid)) for name in stored}
    else:
        index = draft.grid.pixels(where)
        images = {name: draft.grid.full(mi.Float64, NOTHING_SEEN[name]) for name in stored}
    for part in batches(index):
        seen = apply_rule(draft.view, draft.centres(part), rule, names)
        for name, image in images.items():
            dr.scatter(image, mi.Float64(getattr(seen, name)), part)
        dr.eval(images)
    found = Sums(**{name: images.get(name, mi.Float64(nothing)) for name, nothing in NOTHING_SEEN.items()})
    if not specular:
        found.front = found.nearest
    draft.count(f"{len(rule)} nodes", index, dr.width(index) * len(rule))
    return found
