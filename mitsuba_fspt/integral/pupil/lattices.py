"""Lattices over pixel × pupil, for pixels on which transects do not converge: corners, many edges, rough textures.

A rank-1 lattice in the four dimensions of Eq. M.5 is moved by random shifts. The means of the shifts are independent
unbiased estimates, and their scatter gives the error for any integrand. The points are in such an order that the first
2^m of them form a lattice for every m, so that each step adds points to those of the last one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import stdtrit

from ...jit.batches import batches
from ...jit.from_numpy import from_numpy
from ...jit.loops import repeat
from ..lines.eq9 import most_radiance
from ..quadrature import TOGETHER, Quadrature
from .draft import Draft

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...jit.pixel_grid import Mask, PixelArray
    from ..lines.specular import Specular

# Generating vector for x and y of pixel and pupil: of a million random ones with no two-dimensional projection whose
# dual vector is below 0.45 of the longest one possible, that of the least error P₂ (Sloan and Joe 1994) over 2¹⁰ … 2¹⁸
# points.
VECTOR = (1, 949661, 683229, 634757)
FIRST, GROWTH, MOST = 1 << 10, 2, 1 << 18  # points of the first lattice; by what factor the next has more; of the last
LEAST = TOGETHER // 4  # lines of sight that are kept for narrow light, shade and variation of J_n
FEWEST = 1 << 7  # points of the first lattice there, where so many pixels share these lines that it can have no more
SHIFTS = 16
ORDER = 3 / 4  # power with which the error is expected to fall with the number of points, as at a jump
CHANCE = 1e-3  # with which the stated error is exceeded, by Student's t, and as all points may miss light
# Lines of sight that one counts as in a scene with specular shapes, unless `max_nodes` is given: one more for each of
# them, and so many at the most.
LEGS = 8


def refine_by_lattices(draft: Draft) -> None:
    """Value and error of the pixels above the tolerance by lattices of more and more points, until they are below it.

    The error of a pixel is at least the largest share of pixel × pupil that all points may miss, times the brightest
    value around, or the brightest narrow spot where they may miss one; on pixels that another solution gives, times
    the brightest surface.
    """
    above, before = draft.shown & ~draft.outside & (draft.error > draft.tolerance), draft.rays
    _refine(draft, above & ~draft.by_narrow, TOGETHER, claimed=True)
    taken = _legs(draft.view.specular) * (draft.rays - before)
    _refine(draft, above & draft.by_narrow, max(TOGETHER - taken, LEAST), claimed=False)


def _refine(draft: Draft, above: Mask, together: int, claimed: bool) -> None:
    """Value and error of the marked pixels; `together`, `claimed` as of `_most_points`."""
    before = draft.rays
    deadline, tolerance = draft.progress.deadline, draft.tolerance
    rtol = dr.opaque(mi.Float64, draft.quadrature.rtol)
    legs = _legs(draft.view.specular)

    def most_points(pixels: int, points: int = 0) -> int:
        """Points of the largest lattice that so many pixels may take next, after one of so many points."""
        on_others = draft.rays - before - points * SHIFTS * pixels
        return _most_points(draft.quadrature, legs, pixels, together - legs * on_others, claimed)

    if not dr.any(above) or most_points(1) < FIRST:
        return
    above = _largest_errors(draft, above, most_points, FIRST if claimed else FEWEST)
    narrow, largest = (dr.opaque(mi.Float64, n) for n in (draft.narrow_radiance, most_radiance(draft.view.scene)))
    brightest = dr.maximum(draft.near_edge(draft.value), dr.select(draft.missed > 0, narrow, 0))
    brightest = dr.select(draft.computed, brightest, largest)
    student_t, missed = (dr.opaque(mi.Float64, n) for n in _exceeded_with(CHANCE))
    means, points = Means.none(draft.grid.pixels(above)), 0
    while not deadline.passed():
        more = min(GROWTH * points or FIRST, most_points(dr.width(means.pixels), points))
        if more <= points:
            break
        means, points = means.refined(draft, points, more), more
        if not dr.width(means.pixels):  # the deadline left no time for the first of them
            break
        unmet = missed / (points * SHIFTS) * dr.gather(mi.Float64, brightest, means.pixels)
        error = dr.maximum(student_t * means.standard_error, unmet)
        better = error < dr.gather(mi.Float64, draft.error, means.pixels)
        images = mi.Float64(draft.value), mi.Float64(draft.coverage), mi.Float64(draft.error)
        for image, column in zip(images, (means.value, means.share, error), strict=True):
            dr.scatter(image, column, means.pixels, better)
        dr.eval(images)
        draft.value, draft.coverage, draft.error = images
        # Where another rule's error is smaller, lattices have to get below it.
        last = max(most_points(dr.width(means.pixels), points), points)
        expected = error * dr.opaque(mi.Float64, (points / last) ** ORDER)
        # Lattices may be the first to meet the brightest light; its lower bound, as few points may meet too much.
        tolerance = dr.maximum(tolerance, rtol * dr.max(means.value - error))
        left = (error > tolerance) & (expected <= dr.gather(mi.Float64, draft.error, means.pixels))
        if not dr.any(left):
            break
        means = means.of(left)


def _legs(specular: Specular | None) -> int:
    """Lines of sight that one counts as."""
    return min(1 + len(specular.names), LEGS) if specular else 1


def _exceeded_with(chance: float) -> tuple[float, float]:
    """Error over the standard error of the mean of all shifts that is exceeded with this `chance`, by Student's t; and
    share of pixel × pupil, times the number of points, that all points miss with it."""
    return float(stdtrit(SHIFTS - 1, 1 - chance / 2)), -math.log(chance)


def _largest_errors(draft: Draft, above: Mask, most_points: Callable[[int], int], least: int = FIRST) -> Mask:
    """The marked pixels, or as many of them as may take a lattice of at `least` so many points: those of the largest
    errors.

    Of equal errors, which neighbours may have, no more than that are taken.
    """
    error = dr.select(above, draft.error, 0).numpy()
    count = int(np.count_nonzero(error))
    while most_points(count) < least:
        count //= 2
    taken = np.zeros(len(error), bool)
    taken[np.argpartition(error, -count)[-count:]] = True
    return above & from_numpy(mi.Bool, taken)


def _most_points(quadrature: Quadrature, legs: int, pixels: int, left: int = TOGETHER, claimed: bool = True) -> int:
    """Points of the largest lattice on so many pixels, a power of two, of lines of sight that count as so many.

    left : lines of sight of all pixels together; claimed : each pixel may take `most_nodes` in any case
    """
    lines = quadrature.most_nodes
    if quadrature.max_nodes is None:
        lines = max(lines if claimed else 0, left // pixels, 0) // legs
    return min(1 << (lines // SHIFTS).bit_length() >> 1, MOST)


@dataclass(frozen=True)
class Means:
    """Means of each shift on each of the `pixels` (n,): `radiance` on film [W/mm²/sr] and `coverage`, (16 n,)."""

    pixels: mi.UInt32
    radiance: PixelArray
    coverage: PixelArray

    @classmethod
    def none(cls, pixels: mi.UInt32) -> Means:
        """Means before the first point."""
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
        """Standard error of `value` [W/mm²/sr], from the scatter of the shifts."""
        deviation = self.radiance - dr.repeat(self.value, SHIFTS)
        return dr.sqrt(dr.block_sum(dr.square(deviation), SHIFTS) / (SHIFTS * (SHIFTS - 1)))

    def of(self, which: mi.Bool) -> Means:
        """Means of the pixels marked in `which`."""
        number = dr.compress(which)
        shifts = dr.repeat(number * SHIFTS, SHIFTS) + dr.tile(dr.arange(mi.UInt32, SHIFTS), dr.width(number))
        columns = (dr.gather(mi.Float64, column, shifts) for column in (self.radiance, self.coverage))
        return Means(dr.gather(mi.UInt32, self.pixels, number), *columns)

    def refined(self, draft: Draft, points: int, more: int) -> Means:
        """Means over `more` points, given these over the first `points`; both are powers of two.

        After the deadline only those of the pixels for which there was time.
        """
        run, done = min(FIRST, more - points), 0
        runs = (more - points) // run
        shifts = dr.arange(mi.UInt32, dr.width(self.pixels) * SHIFTS)
        sums = [dr.zeros(mi.Float64, dr.width(shifts)) for _ in range(2)]
        # One kernel for lattices of all sizes: it contains neither numbers of points nor the sums over runs.
        of_shift, start = dr.opaque(mi.UInt32, runs), dr.opaque(mi.UInt32, points)
        for part in batches(shifts, run * runs, draft.progress.batch):
            if done and draft.progress.deadline.passed():
                break
            done += dr.width(part)
            entry = dr.arange(mi.UInt32, dr.width(part) * runs)
            shift = dr.gather(mi.UInt32, part, entry // of_shift)
            first = start + entry % of_shift * dr.opaque(mi.UInt32, run)
            dr.eval(shift, first)
            columns = _run(draft, self.pixels, shift, first, run)
            dr.eval(columns)
            for total, column in zip(sums, columns, strict=True):
                dr.scatter(total, dr.block_sum(column, runs), part)
            dr.eval(sums)
        whole = done // SHIFTS  # array entries of one pixel follow one another
        touched = dr.gather(mi.UInt32, self.pixels, dr.arange(mi.UInt32, whole))
        draft.count(f"{SHIFTS} lattices of {more}", touched, done * runs * run)
        old, new = (dr.opaque(mi.Float64, share) for share in (points / more, 1 / more))
        radiance, coverage = (
            old * before + new * total for before, total in zip((self.radiance, self.coverage), sums, strict=True)
        )
        dr.eval(radiance, coverage)
        found = replace(self, radiance=radiance, coverage=coverage)
        if whole == dr.width(self.pixels):
            return found
        return found.of(dr.arange(mi.UInt32, dr.width(self.pixels)) < whole)


def _run(
    draft: Draft, pixels: mi.UInt32, shift: mi.UInt32, first: mi.UInt32, count: int
) -> tuple[PixelArray, PixelArray]:
    """Sums of integrand and coverage over `count` points from number `first` on, for each `shift` of `pixels`."""
    pixel = dr.gather(mi.UInt32, pixels, shift // SHIFTS)
    centre, area = draft.centres(pixel), dr.opaque(mi.Float, float(draft.area))
    shifts = [mi.sample_tea_32(pixel, SHIFTS * k + shift % SHIFTS)[0] for k in range(len(VECTOR))]

    def add(k: mi.UInt32, value: mi.Float64, coverage: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        # In units of 2⁻³²: whole numbers wrap around as the lattice does.
        point = dr.brev(first + k)
        x, y, u, v = (
            _folded(start + point * dr.opaque(mi.UInt32, step)) for start, step in zip(shifts, VECTOR, strict=True)
        )
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u, v))
        sight = draft.view.integrand(centre + area * mi.Point2f(x - 0.5, y - 0.5), pupil)
        return value + mi.Float64(sight.integrand), coverage + dr.select(sight.covered, mi.Float64(1), 0)

    return repeat(dr.opaque(mi.UInt32, count), add, mi.Float64(0), mi.Float64(0))


def _folded(place: mi.UInt32) -> mi.Float:
    """Tent transform to [0, 1], by which any integrand becomes periodic."""
    x = mi.Float(place) * 2.0**-31
    return dr.minimum(dr.abs(1 - dr.abs(1 - x)), 1)
