"""Lattices over pixel × pupil, for pixels on which transects do not settle: corners, many edges, rough textures.

A rank-1 lattice in four dimensions is moved by a random shift. The means over several shifts are independent estimates
without bias, and their scatter is the error, whatever the integrand. Points are taken in such an order that the first
2^m of them are a lattice for every m, so that each step adds points to those of the last one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..jit.batches import batches
from ..jit.loops import repeat
from .draft import Draft
from .eq9 import most_radiance

if TYPE_CHECKING:
    from ..jit.pixel_grid import PixelArray

# x and y of pixel and pupil. Of a million random vectors, among those none of whose two-dimensional projections has a
# dual vector below 0.45 of the longest one possible, the one with the least error P₂ (Sloan and Joe 1994) at 2¹⁰ … 2¹⁸
# points. With a vector that is poor at one of these sizes, more points would gain nothing there.
VECTOR = (1, 949661, 683229, 634757)
FIRST, GROWTH, MOST = 1 << 10, 4, 1 << 18  # points of the first lattice; by what factor the next has more; of the last
SHIFTS = 16
# By which the error falls at best with the number of points where the integrand jumps at a smooth edge: 1/2 + 1/(2 d)
# where it depends on d coordinates, 2 in focus. Lattices end where the points that are left would not do at that rate.
ORDER = 0.75


def settle_by_lattices(draft: Draft) -> None:
    """Value and error of the pixels above the tolerance, from ever more points until they are below it.

    What is known from elsewhere is of light that may be far brighter than what lines of sight met around.
    """
    most = min(1 << (draft.quadrature.max_nodes // SHIFTS).bit_length() >> 1, MOST)  # a power of two
    above = draft.shown & ~draft.outside & (draft.error > draft.tolerance)
    if most < FIRST or not dr.any(above):
        return
    tolerance = draft.tolerance
    brightest = dr.select(
        draft.open, draft.near_edge(draft.value), dr.opaque(mi.Float64, most_radiance(draft.view.scene))
    )
    means, points = Means.none(draft.grid.pixels(above)), 0
    while points < most:
        more = min(GROWTH * points or FIRST, most)
        means, points = means.refined(draft, points, more), more
        unmet = dr.opaque(mi.Float64, draft.estimator.unmet / (points * SHIFTS)) * dr.gather(
            mi.Float64, brightest, means.pixels
        )
        scatter = draft.estimator.certain * means.standard_error
        error = dr.maximum(scatter, unmet)
        better = error < dr.gather(mi.Float64, draft.error, means.pixels)
        images = mi.Float64(draft.value), mi.Float64(draft.coverage), mi.Float64(draft.error)
        for image, column in zip(images, (means.value, means.share, error), strict=True):
            dr.scatter(image, column, means.pixels, better)
        dr.eval(images)
        draft.value, draft.coverage, draft.error = images
        share = points / most
        reached = dr.maximum(dr.opaque(mi.Float64, share**ORDER) * scatter, dr.opaque(mi.Float64, share) * unmet)
        left = (error > tolerance) & (reached <= tolerance)
        if not dr.any(left):
            break
        means = means.of(left)


@dataclass(frozen=True)
class Means:
    """Of each of the `pixels` (n,), shift by shift (16 n,): mean `radiance` on film [W/mm²/sr] and `coverage`."""

    pixels: mi.UInt32
    radiance: PixelArray
    coverage: PixelArray

    @classmethod
    def none(cls, pixels: mi.UInt32) -> Means:
        """Of no points yet."""
        zero = dr.zeros(mi.Float64, dr.width(pixels) * SHIFTS)
        return cls(pixels, zero, zero)

    @property
    def value(self) -> PixelArray:
        """Mean radiance on film of each pixel [W/mm²/sr]."""
        return dr.block_sum(self.radiance, SHIFTS) / SHIFTS

    @property
    def share(self) -> PixelArray:
        """Coverage of each pixel."""
        return dr.block_sum(self.coverage, SHIFTS) / SHIFTS

    @property
    def standard_error(self) -> PixelArray:
        """Of `value` [W/mm²/sr], by the scatter of the shifts."""
        deviation = self.radiance - dr.repeat(self.value, SHIFTS)
        return dr.sqrt(dr.block_sum(dr.square(deviation), SHIFTS) / (SHIFTS * (SHIFTS - 1)))

    def of(self, which: mi.Bool) -> Means:
        """Those of some of the pixels."""
        number = dr.compress(which)
        shifts = dr.repeat(number * SHIFTS, SHIFTS) + dr.tile(dr.arange(mi.UInt32, SHIFTS), dr.width(number))
        columns = (dr.gather(mi.Float64, column, shifts) for column in (self.radiance, self.coverage))
        return Means(dr.gather(mi.UInt32, self.pixels, number), *columns)

    def refined(self, draft: Draft, points: int, more: int) -> Means:
        """Means over so many points `more`, powers of two, of which these are over the first `points`."""
        sums = [dr.zeros(mi.Float64, dr.width(self.pixels) * SHIFTS) for _ in range(2)]
        runs = (more - points) // FIRST
        lanes = dr.arange(mi.UInt32, dr.width(self.pixels) * SHIFTS * runs)
        for part in batches(lanes, FIRST):
            shift, run = part // runs, part % runs
            for total, column in zip(sums, _run(draft, self.pixels, shift, points + run * FIRST), strict=True):
                dr.scatter_add(total, column, shift)
            dr.eval(sums)
        draft.count(f"{SHIFTS} lattices of {more}", dr.width(self.pixels), (more - points) * dr.width(sums[0]))
        old, new = (dr.opaque(mi.Float64, share) for share in (points / more, 1 / more))
        radiance, coverage = (
            old * before + new * total for before, total in zip((self.radiance, self.coverage), sums, strict=True)
        )
        dr.eval(radiance, coverage)
        return replace(self, radiance=radiance, coverage=coverage)


def _run(draft: Draft, pixels: mi.UInt32, shift: mi.UInt32, first: mi.UInt32) -> tuple[PixelArray, PixelArray]:
    """Sums of integrand and coverage over `FIRST` points from the `first` on, of so many a `shift` of all pixels'."""
    pixel = dr.gather(mi.UInt32, pixels, shift // SHIFTS)
    centre, area = draft.centres(pixel), dr.opaque(mi.Float, float(draft.area))
    shifts = [mi.sample_tea_32(pixel, SHIFTS * k + shift % SHIFTS)[0] for k in range(len(VECTOR))]

    def look(k: mi.UInt32, value: mi.Float64, coverage: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        # In units of 2⁻³², where whole numbers wrap around as a lattice does.
        point = dr.brev(first + k)
        x, y, u, v = (
            _folded(start + point * dr.opaque(mi.UInt32, step)) for start, step in zip(shifts, VECTOR, strict=True)
        )
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u, v))
        sight = draft.view.integrand(centre + area * mi.Point2f(x - 0.5, y - 0.5), pupil)
        return value + mi.Float64(sight.integrand), coverage + dr.select(sight.covered, mi.Float64(1), 0)

    return repeat(dr.opaque(mi.UInt32, FIRST), look, mi.Float64(0), mi.Float64(0))


def _folded(place: mi.UInt32) -> mi.Float:
    """Place in [0, 1] along the tent, up and down again: an integrand becomes periodic in it."""
    x = mi.Float(place) * 2.0**-31
    return dr.minimum(dr.abs(1 - dr.abs(1 - x)), 1)
