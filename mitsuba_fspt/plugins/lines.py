"""Lines of sight as kernels: the integrand of Eq. 9, rules over pixel and pupil, and chords that find a jump.

Every function here is one loop of one kernel, over as many lines of sight as the arrays are wide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .. import rules
from .elements import at_one_wavelength, scalar

STEEP = 4.0  # a jump is so many times larger than the mean of the chord's other steps

# ---------------------------------------------------------------------- one line of sight


def radiance_on_film(
    scene: mi.Scene, lens: mi.Sensor, position: mi.Point2f, pupil: mi.Point2f
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Integrand of Eq. 9, cos⁴θ · L [W/mm²/sr]; number of the body met, 0 for none or no passage; its depth z [mm]."""
    ray, weight, cos_theta = lens.line_of_sight(position, pupil)
    at_one_wavelength(ray)
    # Embree traces packets of neighbouring lines of sight three times slower than single rays.
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=weight > 0)
    radiance = scalar(si.emitter(scene).eval(si))
    body = mi.Float(dr.reinterpret_array(mi.UInt32, si.shape))
    return weight * radiance, body, si.t * cos_theta


def repeat(
    count: int | mi.UInt32,
    body: Callable[..., tuple],
    *state: Any,
    while_true: Callable[..., mi.Bool] | None = None,
) -> tuple:
    """`state` after `count` rounds of state = body(k, *state), as one loop inside the kernel."""

    def condition(k: mi.UInt32, *state: Any) -> mi.Bool:
        more = k < count
        return more & while_true(*state) if while_true else more

    return dr.while_loop((mi.UInt32(0), *state), condition, lambda k, *state: (k + 1, *body(k, *state)))[1:]


# ---------------------------------------------------------------------- rules on every pixel


def apply_rule(scene: mi.Scene, lens: mi.Sensor, centre: mi.Point2f, rule: rules.Rule) -> tuple[mi.Float, ...]:
    """Weighted sums of one rule at every pixel: value, contrast, first moments over the pupil, hits, depth range."""
    table = [mi.Float(column) for column in (*rule.pupil.T, *rule.pixel.T, rule.weight, rule.contrast)]

    def node(
        k: mi.UInt32,
        value: mi.Float,
        contrast: mi.Float,
        moment: mi.Vector2f,
        hits: mi.Float,
        nearest: mi.Float,
        farthest: mi.Float,
    ) -> tuple:
        ax, ay, dx, dy, weight, null = (dr.gather(mi.Float, column, k) for column in table)
        f, body, depth = radiance_on_film(scene, lens, centre + mi.Point2f(dx, dy), mi.Point2f(ax, ay))
        hit = body > 0
        return (
            value + weight * f,
            contrast + null * f,
            moment + weight * f * mi.Vector2f(ax, ay),
            hits + dr.select(hit, weight, 0),
            dr.select(hit, dr.minimum(nearest, depth), nearest),
            dr.select(hit, dr.maximum(farthest, depth), farthest),
        )

    zero = mi.Float(0)
    value, contrast, moment, hits, nearest, farthest = repeat(
        dr.opaque(mi.UInt32, len(rule)), node, zero, zero, mi.Vector2f(0), zero, mi.Float(dr.inf), zero
    )
    return value, contrast, moment.x, moment.y, hits, nearest, farthest


# ---------------------------------------------------------------------- chords where the picture jumps


def integrate_chord(scene: mi.Scene, lens: mi.Sensor, chord: Chord, along: rules.AlongChord) -> tuple[mi.Float, ...]:
    """Mean of the integrand and of the hits along a chord, number of jumps and of lines of sight it took.

    It is split at its two largest jumps. A jump is looked for between neighbours of `along.scan` + 1 points, then
    bisected towards the larger difference; every piece that is not dark gets `along.gauss` nodes, a chord without a
    jump is one piece.
    """
    intervals = dr.opaque(mi.UInt32, along.scan)
    step = 2 / mi.Float(intervals)

    def look(s: mi.Float) -> tuple[mi.Float, mi.Float]:
        f, body, _ = radiance_on_film(scene, lens, chord.position(s), chord.pupil(s))
        return f, body

    def size(jump: _Jump) -> mi.Float:
        # An outline outranks whatever steep but smooth change lies elsewhere on the chord.
        return dr.abs(jump.f.y - jump.f.x) + dr.select(jump.body.x != jump.body.y, chord.outline, 0)

    def scan(k: mi.UInt32, first: _Jump, second: _Jump, total: mi.Float, lit: mi.Point2f, last: mi.Point2f) -> tuple:
        s = step * mi.Float(k) - 1
        f, body = look(s)
        new = _Jump(mi.Point2f(s - step, s), mi.Point2f(last.x, f), mi.Point2f(last.y, body))
        new_size = dr.select(k > 0, size(new), 0)
        largest, larger = new_size > size(first), new_size > size(second)
        second = dr.select(largest, first, dr.select(larger, new, second))
        first = dr.select(largest, new, first)
        lit = dr.select(body > 0, mi.Point2f(dr.minimum(lit.x, s), s), lit)
        return first, second, total + new_size, lit, mi.Point2f(f, body)

    def bisect(k: mi.UInt32, jump: _Jump, other: _Jump) -> tuple:
        # Half of the rounds for the first jump, then the two change places.
        turn = k == bisections
        jump, other = dr.select(turn, other, jump), dr.select(turn, jump, other)
        s = 0.5 * (jump.at.x + jump.at.y)
        f, body = look(s)
        left = _Jump(mi.Point2f(jump.at.x, s), mi.Point2f(jump.f.x, f), mi.Point2f(jump.body.x, body))
        right = _Jump(mi.Point2f(s, jump.at.y), mi.Point2f(f, jump.f.y), mi.Point2f(body, jump.body.y))
        return dr.select(size(left) >= size(right), left, right), other

    bisections = dr.opaque(mi.UInt32, along.bisections)
    first, second, total, lit, _ = repeat(
        intervals + 1, scan, dr.zeros(_Jump), dr.zeros(_Jump), mi.Float(0), mi.Point2f(2, -2), mi.Point2f(0)
    )
    # A step that is not much larger than the others is a slope; on a parabola one is at most 3 times their mean.
    one, two = size(first), size(second)
    jumps = one > dr.maximum(STEEP * (total - one) / (mi.Float(intervals) - 1), chord.least)
    both = jumps & (two > dr.maximum(STEEP * (total - one - two) / (mi.Float(intervals) - 2), chord.least))
    rounds = dr.select(both, 2, dr.select(jumps, 1, 0)) * bisections
    found, other = repeat(rounds, bisect, first, second)
    first, second = dr.select(both, other, found), dr.select(both, found, other)
    s_first, s_second = 0.5 * (first.at.x + first.at.y), 0.5 * (second.at.x + second.at.y)
    left = dr.select(jumps, dr.select(both, dr.minimum(s_first, s_second), s_first), 1)
    right = dr.select(both, dr.maximum(s_first, s_second), 1)

    # Pieces 0 … last between -1, left, right, 1; an outer one on which every point looked past the phantom is dark.
    last = dr.select(both, 2, dr.select(jumps, 1, 0))
    begin = dr.select(jumps & (lit.x > left), 1, 0)
    end = dr.select(lit.y >= dr.select(both, right, dr.select(jumps, left, -1)), last + 1, last)
    gauss = dr.opaque(mi.UInt32, along.gauss)
    nodes, weights = (mi.Float(column) for column in rules.gauss(along.gauss))

    def integrate(k: mi.UInt32, value: mi.Float, hits: mi.Float) -> tuple:
        piece = mi.Int(k // gauss) + begin
        low = dr.select(piece == 0, -1, dr.select(piece == 1, left, right))
        high = dr.select(piece == last, 1, dr.select(piece == 0, left, right))
        x = dr.gather(mi.Float, nodes, k % gauss)
        share, slope = _towards_jumps(x, piece > 0, piece < last)
        weight = dr.gather(mi.Float, weights, k % gauss) * slope * 0.5 * (high - low)
        f, body = look(low + (high - low) * share)
        return value + weight * f, hits + dr.select(body > 0, weight, 0)

    count = mi.UInt32(dr.maximum(end - begin, 0)) * gauss
    value, hits = repeat(count, integrate, mi.Float(0), mi.Float(0))
    looks = intervals + 1 + mi.UInt32(last) * bisections + count
    return chord.weight * value, chord.weight * hits, mi.Float(last), mi.Float(looks)


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
    """Two neighbouring points of a chord: places `at`, integrand `f`, numbers of the bodies met."""

    at: mi.Point2f
    f: mi.Point2f
    body: mi.Point2f


@dataclass
class Chord:
    """Segment s ∈ [-1, 1] through pixel × pupil: across the pupil at a fixed pixel point, or across the pixel.

    In units of the integrand an `outline` counts so much as a jump, and less than `least` does not.
    """

    pixel_middle: mi.Point2f
    pixel_half: mi.Vector2f
    pupil_middle: mi.Point2f
    pupil_half: mi.Vector2f
    weight: mi.Float
    outline: mi.Float
    least: mi.Float

    def position(self, s: mi.Float) -> mi.Point2f:
        return self.pixel_middle + s * self.pixel_half

    def pupil(self, s: mi.Float) -> mi.Point2f:
        return self.pupil_middle + s * self.pupil_half


def chords_across(
    rule: rules.Chords,
    number: mi.UInt32,
    centre: mi.Point2f,
    angle: mi.Float,
    across_pupil: mi.Bool,
    outline: mi.Float,
    least: mi.Float,
) -> Chord:
    """Chord `number` of a rule for pixels whose picture changes along `angle`.

    Across the pupil: direction n = (cos, sin), distance sin φ from the middle, half length cos φ; with φ uniform the
    mean over the disc is that of 2 cos²φ × (chord mean), smooth and periodic in φ. Across the pixel: along the film
    axis nearest to n.
    """
    across, dx, dy, weight, side, ax, ay = (
        dr.gather(mi.Float, mi.Float(column), number)
        for column in (rule.across, *rule.pixel.T, rule.weight, rule.side, *rule.pupil.T)
    )
    n = mi.Vector2f(dr.cos(angle), dr.sin(angle))
    sine, cosine = dr.sincos(dr.pi * (across - 0.5))
    along_x = dr.abs(n.x) > dr.abs(n.y)
    fixed = dr.select(along_x, mi.Vector2f(0, side), mi.Vector2f(side, 0))
    moving = dr.select(along_x, mi.Vector2f(0.5, 0), mi.Vector2f(0, 0.5))
    return Chord(
        pixel_middle=centre + dr.select(across_pupil, mi.Vector2f(dx, dy), fixed),
        pixel_half=dr.select(across_pupil, mi.Vector2f(0), moving),
        pupil_middle=dr.select(across_pupil, sine * mi.Vector2f(-n.y, n.x), mi.Vector2f(ax, ay)),
        pupil_half=dr.select(across_pupil, cosine * n, mi.Vector2f(0)),
        weight=dr.select(across_pupil, 2 * dr.square(cosine) * weight, dr.opaque(mi.Float, 1 / len(rule))),
        outline=outline,
        least=least,
    )
