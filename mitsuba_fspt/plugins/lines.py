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

SCAN, GAUSS = 4, 3


def rays_per_chord(bisections: int) -> int:
    """Lines of sight that `integrate_chord` looks along at most."""
    return SCAN + 1 + bisections + 2 * GAUSS


# ---------------------------------------------------------------------- one line of sight


def radiance_on_film(
    scene: mi.Scene, lens: mi.Sensor, position: mi.Point2f, pupil: mi.Point2f
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Integrand of Eq. 9, cos⁴θ · L [W/mm²/sr]; the number of the body that is met, 0 for none; its depth z [mm]."""
    ray, weight, cos_theta = lens.line_of_sight(position, pupil)
    at_one_wavelength(ray)
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
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
        len(rule), node, zero, zero, mi.Vector2f(0), zero, mi.Float(dr.inf), zero
    )
    return value, contrast, moment.x, moment.y, hits, nearest, farthest


# ---------------------------------------------------------------------- chords where the picture jumps


def integrate_chord(scene: mi.Scene, lens: mi.Sensor, chord: Chord, bisections: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Mean of the integrand and of the hits along a chord, split at its largest jump.

    The jump is looked for between neighbours of `SCAN` + 1 points, then bisected towards the larger difference; each
    lit side gets `GAUSS` nodes, a chord without a jump gets them once.
    """

    def look(s: mi.Float) -> tuple[mi.Float, mi.Float]:
        f, body, _ = radiance_on_film(scene, lens, chord.position(s), chord.pupil(s))
        return f, body

    def jump(f: mi.Point2f, body: mi.Point2f) -> mi.Float:
        # An outline outranks whatever steep but smooth change lies elsewhere on the chord.
        return dr.abs(f.y - f.x) + dr.select(body.x != body.y, chord.outline, 0)

    def scan(
        k: mi.UInt32,
        best: mi.Float,
        total: mi.Float,
        at: mi.Point2f,
        f: mi.Point2f,
        body: mi.Point2f,
        lit: mi.Point2f,
        *last: mi.Float,
    ) -> tuple:
        s = 2 * mi.Float(k + 1) / SCAN - 1
        f_s, body_s = look(s)
        f_new, body_new = mi.Point2f(last[0], f_s), mi.Point2f(last[1], body_s)
        size = jump(f_new, body_new)
        larger = size > best
        return (
            dr.select(larger, size, best),
            total + size,
            dr.select(larger, mi.Point2f(s - 2 / SCAN, s), at),
            dr.select(larger, f_new, f),
            dr.select(larger, body_new, body),
            dr.select(body_s > 0, mi.Point2f(dr.minimum(lit.x, s), s), lit),
            f_s,
            body_s,
        )

    def bisect(k: mi.UInt32, at: mi.Point2f, f: mi.Point2f, body: mi.Point2f) -> tuple:
        s = 0.5 * (at.x + at.y)
        f_s, body_s = look(s)
        f_left, body_left = mi.Point2f(f.x, f_s), mi.Point2f(body.x, body_s)
        f_right, body_right = mi.Point2f(f_s, f.y), mi.Point2f(body_s, body.y)
        left = jump(f_left, body_left) >= jump(f_right, body_right)
        return (
            dr.select(left, mi.Point2f(at.x, s), mi.Point2f(s, at.y)),
            dr.select(left, f_left, f_right),
            dr.select(left, body_left, body_right),
        )

    zero, pair = mi.Float(0), mi.Point2f(0)
    f_first, body_first = look(mi.Float(-1))
    lit = dr.select(body_first > 0, mi.Point2f(-1, -1), mi.Point2f(2, -2))
    best, total, at, f, body, lit, *_ = repeat(SCAN, scan, zero, zero, pair, pair, pair, lit, f_first, body_first)
    # One step that is not much larger than the others is a slope: the chord stays whole.
    jumps = best > 2 * (total - best) / (SCAN - 1)
    at, *_ = repeat(bisections, bisect, at, f, body, while_true=lambda at, f, body: jumps & (jump(f, body) > 0))
    split = dr.select(jumps, 0.5 * (at.x + at.y), -1)
    # A side on which every point looked past the phantom is dark.
    left, right = jumps & (lit.x <= split), lit.y >= split

    nodes, weights = (mi.Float(column) for column in rules.gauss(GAUSS))

    def integrate(k: mi.UInt32, value: mi.Float, hits: mi.Float) -> tuple:
        length = dr.select(left & (k < GAUSS), -1, 1) - split
        x = dr.gather(mi.Float, nodes, k % GAUSS)
        # With s = split ± length x² a silhouette's √ (of the cosine, of the place on the surface) becomes linear.
        place, slope = dr.select(jumps, dr.square(x), x), dr.select(jumps, 2 * x, 1)
        weight = dr.gather(mi.Float, weights, k % GAUSS) * 0.5 * slope * dr.abs(length)
        f, body = look(split + length * place)
        return value + weight * f, hits + dr.select(body > 0, weight, 0)

    count = dr.select(left, GAUSS, 0) + dr.select(right, GAUSS, 0)
    value, hits = repeat(mi.UInt32(count), integrate, zero, zero)
    return chord.weight * value, chord.weight * hits


@dataclass
class Chord:
    """Segment s ∈ [-1, 1] through pixel × pupil: across the pupil at a fixed pixel point, or across the pixel."""

    pixel_middle: mi.Point2f
    pixel_half: mi.Vector2f
    pupil_middle: mi.Point2f
    pupil_half: mi.Vector2f
    weight: mi.Float
    outline: mi.Float

    def position(self, s: mi.Float) -> mi.Point2f:
        return self.pixel_middle + s * self.pixel_half

    def pupil(self, s: mi.Float) -> mi.Point2f:
        return self.pupil_middle + s * self.pupil_half


def chords_across(
    rule: rules.Chords, number: mi.UInt32, centre: mi.Point2f, angle: mi.Float, across_pupil: mi.Bool, outline: mi.Float
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
    )
