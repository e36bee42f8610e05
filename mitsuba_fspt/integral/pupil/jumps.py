"""Integral of Eq. M.5 along one transect: jumps are found by bisection, the pieces between them integrated each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from ...jit.loops import repeat
from ..lines.courses import first_met
from ..lines.eq9 import View
from .node_rules import MOST_JUMPS, AlongTransect
from .node_sums import TRANSECTS_TOGETHER
from .transect import Transect

MOST_STEPS = 2  # jumps of J_n on one body: with a third, too few steps are left to estimate the slope from
SHIFT = 0.1  # of an interval: range over which the phase shifts the scanned points
SHORTEST = 1e-6  # half the length of a piece, which divides its moments
FLAT = 1e-4  # variance of z over nodes below which they coincide


def integrate_transect(
    view: View,
    transect: Transect,
    phase: mi.Float,
    along: AlongTransect,
    outline: mi.Float,
    least: mi.Float,
    steep: float,
) -> tuple[mi.Float, mi.Float, mi.Float, mi.UInt32, mi.Float, mi.UInt32]:
    """Means along a transect of the integrand, the same without correction of the nodes' weights, of the coverage;
    number of jumps, depth of the edge at the largest jump [mm], number of lines of sight.

    The transect is split at its `MOST_JUMPS` largest jumps. A scan of `along.scan` + 1 points finds the intervals with
    jumps; `along.bisections` halve each of them towards the larger difference. Where they meet a third body, there is
    another jump. Every piece between jumps that is not dark has `along.nodes` nodes at even distances, the first at the
    share `phase` of a distance.
    outline : size that an outline counts as, in units of the radiance [W/mm²/sr]
    least : smallest jump of the radiance on one body [W/mm²/sr]
    steep : a jump on one body is larger than so many times the mean of the other steps of the scan
    """
    together = view.detail <= TRANSECTS_TOGETHER

    def trace(s: mi.Float) -> Seen:
        position, pupil, _ = transect.at(s)
        sight = view.integrand(position, pupil, together)
        if view.specular:
            return mi.Vector4f(sight.radiance, sight.body, sight.depth, sight.front)
        return mi.Point3f(sight.radiance, sight.body, sight.depth)

    found = _search(trace, phase, along, outline, least, steep, mi.Vector4f(0) if view.specular else mi.Point3f(0))
    jumps, places = found.jumps, found.places()
    nodes = dr.opaque(mi.UInt32, along.nodes)

    # Pieces 0 … jumps between -1, the jumps and 1; an outer one is dark if all its lines of sight miss the phantom.
    def integrate(piece: mi.UInt32, low: mi.Float, since: mi.Vector2d, means: mi.Point3f, rays: mi.UInt32) -> tuple:
        at_start, at_end = piece > 0, piece < jumps
        high = mi.Float(1)
        for k, place in enumerate(places):
            high = dr.select(at_end & (piece == k), place, high)
        middle, half = 0.5 * (low + high), dr.maximum(0.5 * (high - low), SHORTEST)
        dark = dr.select(at_start, ~at_end & (found.lit.y < low), found.lit.x > high)
        count = dr.select(dark, 0, nodes)

        def add(number: mi.UInt32, sums: _Sums) -> tuple[_Sums]:
            share, slope = _towards_jumps((mi.Float(number) + phase) / mi.Float(nodes), at_start, at_end)
            s = low + (high - low) * share
            position, pupil, density = transect.at(s)
            sight = view.integrand(position, pupil, together)
            return (sums.plus(slope * density, (s - middle) / half, sight.integrand, sight.covered),)

        (sums,) = repeat(count, add, _Sums(mi.Vector3f(0), mi.Vector2f(0), mi.Float(0)))
        until = dr.select(at_end, transect.moments(high), mi.Vector2d(1, 0))  # the density is even
        value, covered = sums.corrected(_about(until - since, middle, half))
        plain = 2 * half / mi.Float(nodes) * sums.f.x
        return high, until, means + mi.Point3f(value, plain, covered), rays + count

    start = (mi.Float(-1), mi.Vector2d(0), mi.Point3f(0), found.rays)
    _, _, means, rays = repeat(jumps + 1, integrate, *start)
    depth = dr.select(jumps > 0, found.largest[0].depth(), 0)
    return means.x, means.y, means.z, jumps, depth, rays


# ---------------------------------------------------------------------- search for jumps


Seen: TypeAlias = (
    "mi.Point3f | mi.Vector4f"  # radiance, number of the body, its depth; with specular surfaces that of the first
)


@dataclass
class _Jump:
    """Two neighbouring points of a transect: their positions `at` and the line of sight `before` and `after`."""

    at: mi.Point2f
    before: Seen
    after: Seen

    def middle(self) -> mi.Float:
        """The position half-way between the two."""
        return 0.5 * (self.at.x + self.at.y)

    def depth(self) -> mi.Float:
        """Depth of the nearer surface, which occludes the other [mm]; of the first surfaces where these differ."""
        nearer = dr.minimum(self.before.z, self.after.z)
        if len(self.before) == 3:
            return nearer
        alike = first_met(self.before.y) == first_met(self.after.y)
        return dr.select(alike, nearer, dr.minimum(self.before.w, self.after.w))

    def size(self, outline: mi.Float) -> mi.Float:
        """Change of the radiance [W/mm²/sr]; a change of the body adds `outline`, more than any change on one."""
        before, after = self.before.y, self.after.y
        if len(self.before) == 4:  # no body at the end counts as 0, also behind mirrors and panes
            before, after = dr.maximum(before, 0), dr.maximum(after, 0)
        return dr.abs(self.after.x - self.before.x) + dr.select(before != after, outline, 0)

    def halves(self, s: mi.Float, seen: Seen, outline: mi.Float) -> tuple[_Jump, _Jump]:
        """The two parts on either side of s, where the line of sight is `seen`; first the one with the larger jump."""
        left = _Jump(mi.Point2f(self.at.x, s), self.before, seen)
        right = _Jump(mi.Point2f(s, self.at.y), seen, self.after)
        larger = left.size(outline) >= right.size(outline)
        return dr.select(larger, left, right), dr.select(larger, right, left)


@dataclass
class _Search:
    """State of the search along a transect after so many `rays`.

    largest : the `MOST_JUMPS` largest steps of the scan, the largest first; then each in turn is bisected
    place, seen : position and line of sight of the last point of the scan
    total : sum of all steps
    lit : first and last position at which a line of sight meets a body
    jumps : number of the largest steps that are jumps, from the end of the scan on
    """

    largest: list[_Jump]
    place: mi.Float
    seen: Seen
    total: mi.Float
    lit: mi.Point2f
    jumps: mi.UInt32
    rays: mi.UInt32

    def places(self) -> list[mi.Float]:
        """Positions of the jumps in order along the transect, and 1 for each of the largest steps that is none."""
        ordered: list[mi.Float] = []
        for k, jump in enumerate(self.largest):
            place = dr.select(self.jumps > k, jump.middle(), 1)
            for i, other in enumerate(ordered):
                ordered[i], place = dr.minimum(other, place), dr.maximum(other, place)
            ordered.append(place)
        return ordered

    def bisected(self, turn: mi.UInt32, halves: tuple[_Jump, _Jump], outline: mi.Float) -> _Search:
        """The search with the jump number `turn` replaced by the first of its `halves`.

        Where a third body is between those at its ends, as where the lens sees a face edge-on, there is an outline in
        the other half, too: one more jump, if there is a place for it.
        """
        half, other = halves
        two = (other.size(outline) >= outline) & (self.jumps < MOST_JUMPS)
        largest = [
            dr.select(turn == k, half, dr.select(two & (self.jumps == k), other, old))
            for k, old in enumerate(self.largest)
        ]
        return replace(self, largest=largest, jumps=self.jumps + dr.select(two, mi.UInt32(1), 0))


def _met(seen: Seen) -> mi.Bool:
    """True where a line of sight meets a body, or has radiance from a weak reflection."""
    return seen.y > 0 if len(seen) == 3 else (seen.y > 0) | (seen.x > 0)


def _search(
    trace: Callable[[mi.Float], Seen],
    phase: mi.Float,
    along: AlongTransect,
    outline: mi.Float,
    least: mi.Float,
    steep: float,
    nothing: Seen,
) -> _Search:
    """Scan and bisection of a transect on which `trace` gives the line of sight at a position.

    One loop, so that the ray tracing is compiled once. `nothing`: line of sight that meets no body.
    """
    intervals, bisections = dr.opaque(mi.UInt32, along.scan), dr.opaque(mi.UInt32, along.bisections)
    number = mi.Float(intervals)
    shift = SHIFT * (phase - 0.5)  # edges along pixels would lie on points to bisect, and rounding choose the side

    def scan(found: _Search, s: mi.Float, seen: Seen) -> _Search:
        new = _Jump(mi.Point2f(found.place, s), found.seen, seen)
        size = dr.select(found.rays > 0, new.size(outline), 0)
        total = rest = found.total + size
        # An outline is a jump. A step of one body's radiance is one if it is much larger than the mean of the others;
        # on a parabola the largest step is at most 3 times the mean.
        largest, jumps, large = [], mi.UInt32(0), found.rays == intervals
        for k, old in enumerate(found.largest):
            old_size = old.size(outline)
            larger, most = size > old_size, dr.maximum(size, old_size)
            largest.append(dr.select(larger, new, old))
            new, size = dr.select(larger, old, new), dr.minimum(size, old_size)
            rest = rest - most  # not `-=`, which would change the total with it
            jump = most >= outline
            if k < MOST_STEPS:
                jump = jump | (most > dr.maximum(steep * rest / (number - (k + 1)), least))
            large &= jump
            jumps += dr.select(large, mi.UInt32(1), 0)
        lit = dr.select(_met(seen), mi.Point2f(dr.minimum(found.lit.x, s), s), found.lit)
        return _Search(largest, s, seen, total, lit, jumps, found.rays)

    def once(found: _Search) -> tuple[_Search]:
        k = found.rays
        scans, inside = k <= intervals, (k > 0) & (k < intervals)
        even = dr.select(inside, 2 * (mi.Float(k) + shift) / number, dr.select(k > 0, 2, 0)) - 1
        turn = (k - intervals - 1) // bisections
        jump = found.largest[0]
        for i, other in enumerate(found.largest[1:], 1):
            jump = dr.select(turn == i, other, jump)
        s = dr.select(scans, even, jump.middle())
        seen = trace(s)
        found = dr.select(scans, scan(found, s, seen), found.bisected(turn, jump.halves(s, seen, outline), outline))
        found.rays = k + 1
        return (found,)

    # Not `dr.zeros`: of a dataclass's fields it keeps the types of the variant that it meets first.
    none = [_Jump(mi.Point2f(0), nothing, nothing) for _ in range(MOST_JUMPS)]
    start = _Search(none, mi.Float(0), nothing, mi.Float(0), mi.Point2f(2, -2), mi.UInt32(0), mi.UInt32(0))
    return dr.while_loop((start,), lambda found: found.rays <= intervals + found.jumps * bisections, once)[0]


# ---------------------------------------------------------------------- pieces between jumps


def _towards_jumps(x: mi.Float, at_start: mi.Bool, at_end: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Position in a piece for x in [0, 1], denser towards the ends that are jumps, and its derivative by x.

    A silhouette's square root (of the cosine, of the position on the surface) is linear in x there.
    """
    y = 1 - x
    place = dr.select(at_start, dr.select(at_end, x * x * (3 - 2 * x), x * x), dr.select(at_end, 1 - y * y, x))
    slope = dr.select(at_start, dr.select(at_end, 6 * x * y, 2 * x), dr.select(at_end, 2 * y, 1))
    return place, slope


def _about(moments: mi.Vector2d, middle: mi.Float, half: mi.Float) -> mi.Vector2f:
    """Moments of 1 and z = (s - middle) / half from those of 1 and s."""
    first = (moments.y - mi.Float64(middle) * moments.x) / mi.Float64(half)
    return mi.Vector2f(mi.Float(moments.x), mi.Float(first))


@dataclass
class _Sums:
    """Sums over the nodes of a piece: weights times 1, z, z²; times f, z f; times coverage; z in [-1, 1]."""

    one: mi.Vector3f
    f: mi.Vector2f
    coverage: mi.Float

    def plus(self, weight: mi.Float, z: mi.Float, f: mi.Float, covered: mi.Bool) -> _Sums:
        """The sums with one more node."""
        return _Sums(
            self.one + weight * mi.Vector3f(1, z, z * z),
            self.f + weight * f * mi.Vector2f(1, z),
            self.coverage + dr.select(covered, weight, 0),
        )

    def corrected(self, exact: mi.Vector2f) -> tuple[mi.Float, mi.Float]:
        """Integrals of f and of the coverage with weights times α + β z that integrate 1 and z to their `exact` values.

        The density has kinks that a few nodes do not resolve; f is almost linear.
        """
        scale, mean = exact.x / self.one.x, self.one.y / self.one.x
        variance = self.one.z - self.one.y * mean
        tilt = dr.select(variance > FLAT * self.one.x, (exact.y - exact.x * mean) / variance, 0)
        found = self.one.x > 0  # else the piece has no measure
        value = scale * self.f.x + tilt * (self.f.y - mean * self.f.x)
        return dr.select(found, value, 0), dr.select(found, scale * self.coverage, 0)
