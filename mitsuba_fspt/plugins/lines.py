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
from .elements import scalar

SCAN, BISECTIONS, GAUSS = 4, 8, 3
RAYS_PER_CHORD = SCAN + 1 + BISECTIONS + 2 * GAUSS


# ---------------------------------------------------------------------- one line of sight


def radiance_on_film(
    scene: mi.Scene, lens: mi.Sensor, position: mi.Point2f, pupil: mi.Point2f
) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """Integrand of Eq. 9, cos⁴θ · L [W/mm²/sr]; whether the line of sight meets a surface; and its depth z [mm]."""
    ray, weight, cos_theta = lens.line_of_sight(position, pupil)
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    radiance = scalar(si.emitter(scene).eval(si))
    return weight * radiance, si.is_valid(), si.t * cos_theta


def repeat(count: int, body: Callable[..., tuple], *state: Any, while_true: Callable[..., mi.Bool] | None = None) -> tuple:
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
        f, hit, depth = radiance_on_film(scene, lens, centre + mi.Point2f(dx, dy), mi.Point2f(ax, ay))
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


def integrate_chord(scene: mi.Scene, lens: mi.Sensor, chord: Chord) -> tuple[mi.Float, mi.Float]:
    """Mean of the integrand and of the hits along a chord, split at its largest jump.

    The jump is looked for between neighbours of `SCAN` + 1 points, then bisected towards the larger difference.
    """

    def look(s: mi.Float) -> tuple[mi.Float, mi.Float]:
        f, hit, _ = radiance_on_film(scene, lens, chord.position(s), chord.pupil(s))
        return f, dr.select(hit, mi.Float(1), 0)

    def jump(f: mi.Point2f, hit: mi.Point2f) -> mi.Float:
        return dr.abs(f.y - f.x) + chord.floor * dr.abs(hit.y - hit.x)

    def scan(k: mi.UInt32, best: mi.Float, at: mi.Point2f, f: mi.Point2f, hit: mi.Point2f, *last: mi.Float) -> tuple:
        s = 2 * mi.Float(k + 1) / SCAN - 1
        f_s, hit_s = look(s)
        f_new, hit_new = mi.Point2f(last[0], f_s), mi.Point2f(last[1], hit_s)
        size = jump(f_new, hit_new)
        larger = size > best
        return (
            dr.select(larger, size, best),
            dr.select(larger, mi.Point2f(s - 2 / SCAN, s), at),
            dr.select(larger, f_new, f),
            dr.select(larger, hit_new, hit),
            f_s,
            hit_s,
        )

    def bisect(k: mi.UInt32, at: mi.Point2f, f: mi.Point2f, hit: mi.Point2f) -> tuple:
        s = 0.5 * (at.x + at.y)
        f_s, hit_s = look(s)
        f_left, hit_left = mi.Point2f(f.x, f_s), mi.Point2f(hit.x, hit_s)
        f_right, hit_right = mi.Point2f(f_s, f.y), mi.Point2f(hit_s, hit.y)
        left = jump(f_left, hit_left) >= jump(f_right, hit_right)
        return (
            dr.select(left, mi.Point2f(at.x, s), mi.Point2f(s, at.y)),
            dr.select(left, f_left, f_right),
            dr.select(left, hit_left, hit_right),
        )

    nodes, weights = (mi.Float(column) for column in rules.gauss(GAUSS))

    def integrate(k: mi.UInt32, value: mi.Float, hits: mi.Float, split: mi.Float) -> tuple:
        begin = dr.select(k < GAUSS, -1, split)
        length = dr.select(k < GAUSS, split, 1) - begin
        weight = dr.gather(mi.Float, weights, k % GAUSS) * 0.5 * length
        f, hit = look(begin + length * dr.gather(mi.Float, nodes, k % GAUSS))
        return value + weight * f, hits + weight * hit, split

    zero, pair = mi.Float(0), mi.Point2f(0)
    best, at, f, hit, *_ = repeat(SCAN, scan, zero, pair, pair, pair, *look(mi.Float(-1)))
    at, *_ = repeat(BISECTIONS, bisect, at, f, hit, while_true=lambda at, f, hit: jump(f, hit) > 0)
    value, hits, _ = repeat(2 * GAUSS, integrate, zero, zero, 0.5 * (at.x + at.y))
    return chord.weight * value, chord.weight * hits


@dataclass
class Chord:
    """Segment s ∈ [-1, 1] through pixel × pupil: across the pupil at a fixed pixel point, or across the pixel."""

    pixel_middle: mi.Point2f
    pixel_half: mi.Vector2f
    pupil_middle: mi.Point2f
    pupil_half: mi.Vector2f
    weight: mi.Float
    floor: mi.Float

    def position(self, s: mi.Float) -> mi.Point2f:
        return self.pixel_middle + s * self.pixel_half

    def pupil(self, s: mi.Float) -> mi.Point2f:
        return self.pupil_middle + s * self.pupil_half


def chord_at(
    centre: mi.Point2f, angle: mi.Float, across_pupil: mi.Bool, u: mi.Point3f, area: bool, floor: mi.Float
) -> Chord:
    """Chord number `u` ∈ [0, 1)³ of a pixel whose picture changes along `angle`.

    Across the pupil: direction n = (cos, sin), distance sin φ from the middle, half length cos φ; with φ uniform the
    mean over the disc is that of 2 cos²φ × (chord mean), smooth and periodic in φ. Across the pixel: along the film
    axis nearest to n, at a pupil point of its own. The tent map makes the pixel's coordinates periodic.
    """
    step = mi.Vector2f(_tent(u.y), _tent(u.z)) - 0.5 if area else mi.Vector2f(0)
    n = mi.Vector2f(dr.cos(angle), dr.sin(angle))
    phi = dr.pi * (u.x - 0.5)
    sine, cosine = dr.sincos(phi)
    disc = dr.sqrt(_tent(u.y)) * mi.Vector2f(dr.cos(2 * dr.pi * u.x), dr.sin(2 * dr.pi * u.x))
    along_x = dr.abs(n.x) > dr.abs(n.y)
    side = _tent(u.z) - 0.5
    fixed = dr.select(along_x, mi.Vector2f(0, side), mi.Vector2f(side, 0))
    moving = dr.select(along_x, mi.Vector2f(0.5, 0), mi.Vector2f(0, 0.5))
    return Chord(
        pixel_middle=centre + dr.select(across_pupil, step, fixed),
        pixel_half=dr.select(across_pupil, mi.Vector2f(0), moving),
        pupil_middle=dr.select(across_pupil, sine * mi.Vector2f(-n.y, n.x), disc),
        pupil_half=dr.select(across_pupil, cosine * n, mi.Vector2f(0)),
        weight=dr.select(across_pupil, 2 * dr.square(cosine), 1),
        floor=floor,
    )


def _tent(x: mi.Float) -> mi.Float:
    return 1 - dr.abs(2 * x - 1)
