"""Lattices over pixel × pupil, for pixels on which transects do not settle: corners, many edges, rough textures.

A rank-1 lattice of n points in four dimensions is moved by a random shift. The means over several shifts are
independent estimates without bias, and their scatter is the error, whatever the integrand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..jit.batches import batches
from ..jit.loops import repeat
from .draft import Draft

if TYPE_CHECKING:
    from ..jit.pixel_grid import Mask, PixelArray

# Generating vector lattice-32001-1024-1048576.3600 of R. Cools, F. Kuo, D. Nuyens (SIAM J. Sci. Comput. 28, 2006), for
# any power of two of points from 2¹⁰ to 2²⁰; x and y of pixel and pupil.
VECTOR = (1, 182667, 469891, 498753)
POINTS = (1 << 10, 1 << 13)  # of the first lattice and of the second one
SHIFTS = 16
UNMET = 6.9  # over the number of all points: a part of pixel × pupil that they all pass by in one case of 1000
CERTAIN = 4.1  # standard errors of the mean of 16 shifts that 999 of 1000 pixels stay within (Student's t)


def settle_by_lattices(draft: Draft) -> None:
    """Value and error of the pixels that are above the tolerance, where lattices leave less error."""
    for points in POINTS:
        unmet = dr.opaque(mi.Float64, UNMET / (points * SHIFTS)) * draft.near_edge(draft.value)
        where = draft.open & draft.shown & ~draft.outside & (draft.error > dr.maximum(draft.tolerance, unmet))
        if draft.quadrature.max_nodes < points * SHIFTS or not dr.any(where):
            continue
        found = apply_lattice(draft, where, points)
        error = dr.maximum(found.error, unmet)
        # The transects' value is often far better than its estimate: it stays where it is confirmed to the tolerance,
        # and where lattices do not reach the tolerance either.
        apart = dr.abs(found.value - draft.value)
        keep = (apart + error <= draft.tolerance) | (error > draft.tolerance)
        error = dr.select(keep, apart + error, error)
        better = where & (error < draft.error)
        draft.value = dr.select(better & ~keep, found.value, draft.value)
        draft.coverage = dr.select(better & ~keep, found.coverage, draft.coverage)
        draft.error = dr.select(better, error, draft.error)
        dr.eval(draft.value, draft.error, draft.coverage)


@dataclass(frozen=True)
class Found:
    """Of each marked pixel mean radiance on film [W/mm²/sr], its error, and coverage; 0 elsewhere."""

    value: PixelArray
    error: PixelArray
    coverage: PixelArray


def apply_lattice(draft: Draft, where: Mask, points: int) -> Found:
    """Means over `SHIFTS` lattices of so many points at the marked pixels."""
    index = draft.grid.pixels(where)
    images = [draft.grid.full(mi.Float64, 0) for _ in range(3)]
    for part in batches(index, SHIFTS):
        value, coverage = _means(draft, part, points)
        mean = dr.block_sum(value, SHIFTS) / SHIFTS
        deviation = value - dr.repeat(mean, SHIFTS)
        error = CERTAIN * dr.sqrt(dr.block_sum(deviation * deviation, SHIFTS) / (SHIFTS * (SHIFTS - 1)))
        for image, column in zip(images, (mean, error, dr.block_sum(coverage, SHIFTS) / SHIFTS), strict=True):
            dr.scatter(image, column, part)
        dr.eval(images)
    count = dr.width(index)
    draft.count(f"{SHIFTS} lattices of {points}", count, count * SHIFTS * points)
    return Found(*images)


def _means(draft: Draft, pixels: mi.UInt32, points: int) -> tuple[PixelArray, PixelArray]:
    """Mean integrand and coverage of each shift of each pixel, the shifts of a pixel one after the other."""
    lane = dr.arange(mi.UInt32, dr.width(pixels) * SHIFTS)
    pixel = dr.gather(mi.UInt32, pixels, lane // SHIFTS)
    centre, area = draft.centres(pixel), dr.opaque(mi.Float, float(draft.area))
    shifts = [mi.sample_tea_32(pixel, SHIFTS * k + lane % SHIFTS)[0] for k in range(len(VECTOR))]
    count, step = dr.opaque(mi.UInt32, points), dr.opaque(mi.UInt32, (1 << 32) // points)

    def look(k: mi.UInt32, value: mi.Float64, coverage: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        # In units of 2⁻³², where whole numbers wrap around as a lattice does.
        x, y, u, v = (
            _folded(shift + k * dr.opaque(mi.UInt32, generator) * step)
            for shift, generator in zip(shifts, VECTOR, strict=True)
        )
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u, v))
        sight = draft.view.integrand(centre + area * mi.Point2f(x - 0.5, y - 0.5), pupil)
        return value + mi.Float64(sight.integrand), coverage + dr.select(sight.covered, mi.Float64(1), 0)

    value, coverage = repeat(count, look, mi.Float64(0), mi.Float64(0))
    share = dr.opaque(mi.Float64, 1 / points)
    value, coverage = value * share, coverage * share
    dr.eval(value, coverage)
    return value, coverage


def _folded(place: mi.UInt32) -> mi.Float:
    """Place in [0, 1] along the tent, up and down again: an integrand becomes periodic in it."""
    x = mi.Float(place) * 2.0**-31
    return dr.minimum(dr.abs(1 - dr.abs(1 - x)), 1)
