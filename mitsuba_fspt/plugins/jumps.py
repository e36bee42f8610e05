"""The integral along one transect: its jumps are found by bisection, the pieces between them integrated each."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..rules import AlongTransect
from .lines import radiance_on_film, repeat
from .transect import Transect

STEEP = 4.0  # a jump is so many times larger than the mean of the transect's other steps
SHIFT = 0.1  # of an interval: by which scanned points are moved, as the phase wants
SHORTEST = 1e-6  # half of a piece, lest its moments are divided by nothing
FLAT = 1e-4  # variance of z over nodes that lie in one place


def integrate_transect(
    scene: mi.Scene,
    lens: mi.Sensor,
    transect: Transect,
    phase: mi.Float,
    along: AlongTransect,
    outline: mi.Float,
    least: mi.Float,
) -> tuple[mi.Float, ...]:
    """Of a transect means of integrand and hits, number of jumps, depth of the edge at the largest, lines of sight.

    It is split at its two largest jumps. A jump is looked for between neighbours of `along.scan` + 1 points, then
    bisected towards the larger difference; every piece that is not dark gets `along.nodes` at even distances, the first
    of them at `phase` of one; a transect without a jump is one piece. In units of the integrand an `outline` counts so
    much as a jump of the radiance, and less than `least` does not.
    """
    intervals = dr.opaque(mi.UInt32, along.scan)
    step = 2 / mi.Float(intervals)
    # Where edges run along pixels they would lie on points to bisect, and rounding choose the side.
    shift = SHIFT * (phase - 0.5)

    def look(s: mi.Float) -> mi.Point3f:
        position, pupil, _ = transect.at(s)
        return mi.Point3f(*radiance_on_film(scene, lens, position, pupil)[1:])

    def size(jump: _Jump) -> mi.Float:
        # An outline outranks whatever steep but smooth change lies elsewhere on the transect.
        return dr.abs(jump.after.x - jump.before.x) + dr.select(jump.before.y != jump.after.y, outline, 0)

    def scan(k: mi.UInt32, first: _Jump, second: _Jump, total: mi.Float, lit: mi.Point2f, last: _Jump) -> tuple:
        inside = (k > 0) & (k < intervals)
        s = dr.select(inside, step * (mi.Float(k) + shift), dr.select(k > 0, 2, 0)) - 1
        seen = look(s)
        new = _Jump(mi.Point2f(last.at.y, s), last.after, seen)
        new_size = dr.select(k > 0, size(new), 0)
        largest, larger = new_size > size(first), new_size > size(second)
        second = dr.select(largest, first, dr.select(larger, new, second))
        first = dr.select(largest, new, first)
        lit = dr.select(seen.y > 0, mi.Point2f(dr.minimum(lit.x, s), s), lit)
        return first, second, total + new_size, lit, new

    def bisect(k: mi.UInt32, jump: _Jump, other: _Jump) -> tuple:
        # Half of the rounds for the first jump, then the two change places.
        turn = k == bisections
        jump, other = dr.select(turn, other, jump), dr.select(turn, jump, other)
        s = 0.5 * (jump.at.x + jump.at.y)
        seen = look(s)
        left = _Jump(mi.Point2f(jump.at.x, s), jump.before, seen)
        right = _Jump(mi.Point2f(s, jump.at.y), seen, jump.after)
        return dr.select(size(left) >= size(right), left, right), other

    bisections = dr.opaque(mi.UInt32, along.bisections)
    first, second, total, lit, _ = repeat(
        intervals + 1, scan, dr.zeros(_Jump), dr.zeros(_Jump), mi.Float(0), mi.Point2f(2, -2), dr.zeros(_Jump)
    )
    # A step that is not much larger than the others is a slope; on a parabola one is at most 3 times their mean.
    one, two = size(first), size(second)
    jumps = one > dr.maximum(STEEP * (total - one) / (mi.Float(intervals) - 1), least)
    both = jumps & (two > dr.maximum(STEEP * (total - one - two) / (mi.Float(intervals) - 2), least))
    last = dr.select(both, mi.Int(2), dr.select(jumps, mi.Int(1), 0))
    found, other = repeat(mi.UInt32(last) * bisections, bisect, first, second)
    first, second = dr.select(both, other, found), dr.select(both, found, other)
    s_first, s_second = 0.5 * (first.at.x + first.at.y), 0.5 * (second.at.x + second.at.y)
    left = dr.select(jumps, dr.select(both, dr.minimum(s_first, s_second), s_first), 1)
    right = dr.select(both, dr.maximum(s_first, s_second), 1)

    # Pieces 0 … last between -1, left, right, 1; an outer one on which every point looked past the phantom is dark.
    begin = dr.select(jumps & (lit.x > left), 1, 0)
    end = dr.select(lit.y >= dr.select(both, right, dr.select(jumps, left, -1)), last + 1, last)
    to_left, to_right = transect.moments(left), transect.moments(right)
    to_end = mi.Vector2d(1, 0)  # the density is even
    nodes = dr.opaque(mi.UInt32, along.nodes)

    def integrate(k: mi.UInt32, value: mi.Float, hits: mi.Float, sums: _Sums) -> tuple:
        piece, number = mi.Int(k // nodes) + begin, k % nodes
        at_start, at_end = piece > 0, piece < last
        low = dr.select(at_start, dr.select(piece == 1, left, right), -1)
        high = dr.select(at_end, dr.select(piece == 0, left, right), 1)
        middle, half = 0.5 * (low + high), dr.maximum(0.5 * (high - low), SHORTEST)
        share, slope = _towards_jumps((mi.Float(number) + phase) / mi.Float(nodes), at_start, at_end)
        s = low + (high - low) * share
        position, pupil, density = transect.at(s)
        f, _, body, _ = radiance_on_film(scene, lens, position, pupil)
        sums = dr.select(number == 0, dr.zeros(_Sums), sums).plus(slope * density, (s - middle) / half, f, body)
        until = dr.select(at_end, dr.select(piece == 0, to_left, to_right), to_end)
        since = dr.select(at_start, dr.select(piece == 1, to_left, to_right), mi.Vector2d(0))
        more_value, more_hits = sums.corrected(_about(until - since, middle, half))
        done = number == nodes - 1
        return value + dr.select(done, more_value, 0), hits + dr.select(done, more_hits, 0), sums

    count = mi.UInt32(dr.maximum(end - begin, 0)) * nodes
    value, hits, _ = repeat(count, integrate, mi.Float(0), mi.Float(0), dr.zeros(_Sums))
    looks = intervals + 1 + mi.UInt32(last) * bisections + count
    return value, hits, mi.Float(last), dr.select(jumps, first.depth(), 0), mi.Float(looks)


def _towards_jumps(x: mi.Float, at_start: mi.Bool, at_end: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Place in a piece, x in [0, 1] drawn towards the ends that are jumps, and its derivative.

    There a silhouette's square root (of the cosine, of the place on the surface) becomes linear.
    """
    y = 1 - x
    place = dr.select(at_start, dr.select(at_end, x * x * (3 - 2 * x), x * x), dr.select(at_end, 1 - y * y, x))
    slope = dr.select(at_start, dr.select(at_end, 6 * x * y, 2 * x), dr.select(at_end, 2 * y, 1))
    return place, slope


@dataclass
class _Jump:
    """Two neighbouring points of a transect: their places `at`, and radiance, number of the body and depth at each."""

    at: mi.Point2f
    before: mi.Point3f
    after: mi.Point3f

    def depth(self) -> mi.Float:
        """Of what is nearer, and hides the other [mm]."""
        before, after = (dr.select(seen.y > 0, seen.z, dr.inf) for seen in (self.before, self.after))
        return dr.minimum(before, after)


def _about(moments: mi.Vector2d, middle: mi.Float, half: mi.Float) -> mi.Vector2f:
    """Moments of 1 and z = (s - middle) / half from those of 1 and s."""
    first = (moments.y - mi.Float64(middle) * moments.x) / mi.Float64(half)
    return mi.Vector2f(mi.Float(moments.x), mi.Float(first))


@dataclass
class _Sums:
    """Over the nodes of a piece, of weights times 1, z and z²; times f, z f; times hits; z ∈ [-1, 1] is the place."""

    one: mi.Vector3f
    f: mi.Vector2f
    hits: mi.Float

    def plus(self, weight: mi.Float, z: mi.Float, f: mi.Float, body: mi.Float) -> _Sums:
        """The sums with one more node."""
        return _Sums(
            self.one + weight * mi.Vector3f(1, z, z * z),
            self.f + weight * f * mi.Vector2f(1, z),
            self.hits + dr.select(body > 0, weight, 0),
        )

    def corrected(self, exact: mi.Vector2f) -> tuple[mi.Float, mi.Float]:
        """Integrals of f and of the hits by weights times α + β z, for which those of 1 and z are `exact`.

        The density has kinks that a few nodes do not see, and f is almost linear.
        """
        scale, mean = exact.x / self.one.x, self.one.y / self.one.x
        variance = self.one.z - self.one.y * mean
        tilt = dr.select(variance > FLAT * self.one.x, (exact.y - exact.x * mean) / variance, 0)
        found = self.one.x > 0  # on a piece of no measure there is nothing to correct
        value = scale * self.f.x + tilt * (self.f.y - mean * self.f.x)
        return dr.select(found, value, 0), dr.select(found, scale * self.hits, 0)
