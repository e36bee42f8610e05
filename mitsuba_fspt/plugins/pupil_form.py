"""Eq. 9 in its pupil form: P = étendue · mean over pixel and pupil of cos⁴θ · L(first surface point on the line).

A ladder of three rules. Four nodes over pupil and pixel serve every pixel; where the picture bends, twelve; where the
line of sight jumps (a silhouette, an occluder, an edge of J_n), chords: along each the jumps are found by bisection and
the pieces between them are integrated on their own, so that only smooth averages are left to sample.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import pixels, rules
from ..quadrature import Quadrature, Solution
from .lines import apply_rule, chords_across, integrate_chord
from .window import Window, visible_window

LANES = 1 << 22  # lines of sight in flight: bounds the memory, not the picture
SAFETY = 3.0  # the last change of a chord level and of its neighbours, times this, bounds what is left
FLOAT32_FLOOR = 2e-7  # share of the brightest pixel that float32 rays cannot resolve
# A silhouette can pass between a rule's outermost nodes and the rim of the pupil: that far in (blur radii). Near one,
# a rule is wrong by up to this share of the light.
GAP = {4: 0.5, 12: 0.2}
CUT = {4: 1.0, 12: 0.3}
LEAST_JUMP = 0.1  # of the tolerance: less is not looked for
TURN_REACH = 2  # pixels around over which a smooth correction is averaged, lest it add the roughness of J_n
FIRST_GAIN = 0.3  # what is left of the difference between four and twelve nodes once the first chords are in
MOST_GAIN = 8.0  # twelve nodes may agree with four by chance: no better than the estimate for four over this
LEAST_GAIN = 0.5  # no difference between four and twelve nodes promises more than to shrink to this

Image = NDArray[np.float64]


def solve(scene: mi.Scene, lens: mi.Sensor, quadrature: Quadrature, known: Solution | None = None) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window; see `Quadrature` for what is promised.

    Where a partial solution is `known` no work is done, and what comes back is rough.
    """
    return _Ladder(scene, lens, quadrature, known).climb()


def coverage(scene: mi.Scene, lens: mi.Sensor) -> Image:
    """Share of each pixel's lines of sight that meet a surface, by twelve of them; shape (h, w)."""
    window = visible_window(scene, lens)
    index = np.arange(math.prod(window.shape), dtype=np.uint32)
    hits = [apply_rule(scene, lens, window.centres(part), rules.twelve(True))[4] for part in _chunks(index, LANES)]
    return window.expand(np.concatenate([np.zeros(0), *(h.numpy() for h in hits)]).reshape(window.shape))


class _Ladder:
    """The picture while it is refined: mean radiance on film, its error and coverage, shape (h, w)."""

    def __init__(self, scene: mi.Scene, lens: mi.Sensor, quadrature: Quadrature, known: Solution | None = None) -> None:
        self.scene, self.lens, self.quadrature = scene, lens, quadrature
        self.area = quadrature.pixel == "area"
        self.window: Window = visible_window(scene, lens)
        shape = self.window.shape
        self.value, self.error, self.hits, self.change = (np.zeros(shape) for _ in range(4))
        # Pixels for which a second border of the lens cuts the pupil, whatever is sharp.
        self.clipped = self.window.off_axis(lens) > lens.optics.clear_field
        # Pixels that the border of the image-plane stop cuts: a jump across the pixel, wherever the light comes from.
        inside, cut = self.window.stopped(lens)
        self.stopped, self.beyond = cut & self.area, ~(inside | cut)
        self.open = np.ones(shape, bool)  # pixels that are not known from elsewhere
        self.known = np.zeros(shape)
        if known is not None:
            self.open, self.known = ~self.window.cut(known.where), self.window.cut(known.power) / lens.etendue
        self.nearest = np.full(shape, np.inf)
        self.blur = 0.0  # largest blur radius in the picture [pixels]
        self.rays = 0
        self.levels: list[str] = []

    def climb(self) -> Solution:
        if self.value.size:
            rough = self._four_nodes()
            if self.quadrature.max_nodes >= 16:
                rough = self._twelve_nodes(rough)
                if rough.any():
                    self._chords(rough)
        error = np.maximum(self.error, FLOAT32_FLOOR * self.value.max(initial=0.0))
        error[self.hits == 0] = self.error[self.hits == 0]
        error[self.beyond] = 0
        power, error = (self.window.expand(image) * self.lens.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.hits, 0, 1))
        return Solution(power, error, coverage, self.rays, tuple(self.levels))

    @property
    def tolerance(self) -> float:
        return self.quadrature.rtol * float(self.value.max(initial=0.0))

    # ------------------------------------------------------------------ smooth pixels

    def _four_nodes(self) -> NDArray[np.bool_]:
        """Four nodes over pupil and pixel everywhere; returns the pixels that they do not settle."""
        everything = np.ones(self.window.shape, bool)
        value, contrast, mx, my, self.hits, self.nearest, far = self._apply(rules.four(self.area), everything)
        self.blur = self._largest_blur(far)
        self.value = value = np.where(self.open, value, self.known)
        # Fourth order like the rule's own error: f = m exp(g·a/m) has M = g/4.
        slope = 4 * np.hypot(mx, my)
        bend = np.abs(contrast) + np.divide(slope**4, 4 * value**3, out=np.zeros_like(value), where=value > 0)
        if self.area:
            xx, yy = pixels.second_differences(value)
            xxxx, yyyy = pixels.second_differences(xx)[0], pixels.second_differences(yy)[1]
            bend += (np.abs(xxxx) + np.abs(yyyy)) / 12
            curl = pixels.gradient(mx)[1] - pixels.gradient(my)[0]
            turned = pixels.mean_where(rules.four_turn(curl, xx + yy), ~pixels.outline(self.hits, 1), TURN_REACH)
            self.value = np.maximum(value - np.where(self.hits > 1 - pixels.ROUNDING, turned, 0), 0)
        self.error = np.maximum(pixels.spread_max(bend), self._cut_off(4))
        rough = self.error > self.tolerance
        if self.area and min(rough.shape) < 3:
            rough[:] = True  # no neighbour tells how the picture bends
        return pixels.dilate(rough & self.open, self._reach(4)) & self.open

    def _twelve_nodes(self, rough: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Twelve nodes over pupil and pixel on the rough pixels and their surroundings where four mislead.

        Returns the pixels that twelve do not settle either. Four nodes cannot see all that they miss, so a lattice of
        pixels is probed with twelve: what four were off by there counts for the pixels around.
        """
        probes = pixels.lattice(rough.shape) & (self.hits > 0) & ~rough & self.open
        difference = self._refine(rough | probes)
        doubt = pixels.spread_over_lattice(np.where(probes, difference, 0))
        self.error = np.where(rough, self.error, np.maximum(self.error, doubt))
        misled = ~rough & (self.hits > 0) & (self.error > self.tolerance) & self.open
        if misled.any():
            self._refine(misled & ~probes)
        rough = rough | misled
        rougher = rough & (self.error > self.tolerance)
        return rough & pixels.dilate(rougher, self._reach(12))

    def _refine(self, where: NDArray[np.bool_]) -> Image:
        """Twelve nodes on the marked pixels; returns how far four were off there, 0 elsewhere."""
        value, _, _, _, hits, nearest, _ = self._apply(rules.twelve(self.area), where)
        difference = np.where(where, np.abs(value - self.value), 0)
        self.change = np.maximum(self.change, difference)
        # Where the ladder converges, each rung gains as much as the last one, on a kinked J_n less, on a jump nothing.
        gain = np.divide(8 * difference, self.error, out=np.ones_like(value), where=self.error > 0)
        self.value = np.where(where, value, self.value)
        self.hits = np.where(where, hits, self.hits)
        self.nearest = np.minimum(self.nearest, nearest)
        error = np.maximum(pixels.spread_max(difference * np.clip(gain, LEAST_GAIN, 1)), self.error / MOST_GAIN)
        self.error = np.where(where, np.maximum(error, self._cut_off(12)), self.error)
        return difference

    def _cut_off(self, nodes: int) -> Image:
        """What a rule may be wrong by where an edge crosses or hides between its nodes and the pupil's rim.

        A silhouette, or the border of the lens.
        """
        brightest = pixels.spread_max(self.value)
        return np.where(
            pixels.outline(self.hits, self._reach(nodes)) | self.clipped | self.stopped, CUT[nodes] * brightest, 0
        )

    def _apply(self, rule: rules.Rule, where: NDArray[np.bool_]) -> list[Image]:
        """Images of `apply_rule`'s sums at the marked pixels, 0 (depths: inf, 0) elsewhere."""
        index = np.flatnonzero(where).astype(np.uint32)
        fills = (0, 0, 0, 0, 0, np.inf, 0)
        images = [np.full(where.size, fill, dtype=np.float64) for fill in fills]
        for part in _chunks(index, LANES):
            sums = apply_rule(self.scene, self.lens, self.window.centres(part), rule)
            dr.eval(sums)
            for image, column in zip(images, sums, strict=True):
                image[part] = column.numpy()
        self._count(f"{len(rule)} nodes", len(index), len(index) * len(rule))
        return [image.reshape(where.shape) for image in images]

    # ------------------------------------------------------------------ jumps

    def _chords(self, rough: NDArray[np.bool_]) -> None:
        """More chords each round on the pixels that the last round still moved, or moved a neighbour of."""
        index = np.flatnonzero(rough).astype(np.uint32)
        angle = pixels.principal_angle(*pixels.gradient(self.value), 1 + math.ceil(self.blur / 2)).ravel()
        across_pupil = self._across_pupil().ravel()
        value, hits, error = self.value.ravel(), self.hits.ravel(), self.error.ravel()
        change, split, count = self.change.ravel(), np.zeros(value.shape, bool), 0
        for level, (m, q) in enumerate(rules.CHORD_LEVELS):
            rule, along = rules.chords(m, q, self.area), rules.along_chord(level)
            if not len(index) or 16 + len(rule) * along.rays > self.quadrature.max_nodes:
                break
            rays = 0.0
            # What the change before this one should have become by now, lest two wrong values agree by chance.
            change *= (count / len(rule)) ** rules.CHORD_ORDER if count else FIRST_GAIN
            count = len(rule)
            for part in _chunks(index, max(1, LANES // count)):
                mean, met, jumps, looks = self._chord_means(part, angle[part], across_pupil[part], rule, along)
                rays += looks.sum()
                change[part] = np.maximum(np.abs(mean - value[part]), change[part])
                # Where the first chords meet no jump after all, twelve nodes were the better rule.
                better = (jumps > 0) | (level > 0)
                value[part], hits[part] = np.where(better, mean, value[part]), np.where(better, met, hits[part])
                split[part] = jumps > 0
            self._count(f"{count} chords", len(index), int(rays))
            error[index] = SAFETY * pixels.spread_max(change.reshape(self.value.shape)).ravel()[index]
            index = index[error[index] > self.tolerance]
            if level == 0:
                change[~split] = 0  # nothing changed there yet
                # Across the pupil all other directions have Gauss nodes: right for smooth pixels, sharp or not.
                across_pupil |= self._calm(split.reshape(self.value.shape)).ravel()

    def _chord_means(
        self,
        part: NDArray[np.uint32],
        angle: Image,
        across_pupil: NDArray[np.bool_],
        rule: rules.Chords,
        along: rules.AlongChord,
    ) -> list[Image]:
        """Of each listed pixel mean radiance on film, share of hits, jumps and lines of sight, in one launch."""
        count = dr.opaque(mi.UInt32, len(rule))
        lane = dr.arange(mi.UInt32, len(part) * len(rule))
        pixel, number = lane // count, lane % count
        chord = chords_across(
            rule,
            number,
            dr.gather(mi.Point2f, self.window.centres(part), pixel),
            dr.gather(mi.Float, mi.Float(angle), pixel),
            dr.gather(mi.Bool, mi.Bool(across_pupil), pixel),
            dr.opaque(mi.Float, 2 * float(self.value.max())),
            dr.opaque(mi.Float, LEAST_JUMP * self.tolerance),
        )
        means = integrate_chord(self.scene, self.lens, chord, along)
        means = [mi.Float64(mean) for mean in means]
        dr.eval(means)  # together: a reduction evaluates what it needs alone, and would trace every ray twice
        sums = [dr.block_sum(mean, len(rule)) for mean in means]
        dr.eval(sums)
        return [column.numpy() for column in sums]

    def _across_pupil(self) -> NDArray[np.bool_]:
        """True where a jump crosses the pupil more than the pixel: its blur disc is wider than a pixel."""
        if not self.area:
            return np.ones(self.value.shape, bool)
        nearest = -pixels.spread_max(-self.nearest)
        return ((self.lens.blur_radius(nearest) > 0.5) | self.clipped) & ~self.stopped

    def _calm(self, split: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """True where neither a pixel nor its neighbours jump: no chord of theirs was split, no outline passes."""
        return ~pixels.dilate(split | pixels.outline(self.hits, 1), 1)

    def _largest_blur(self, far: Image) -> float:
        """Of what is nearest or farthest: from the sharp plane on, blur grows either way."""
        seen = np.isfinite(self.nearest)
        depths = np.array([self.nearest[seen].min(initial=np.inf), far[seen].max(initial=0.0)])
        return float(self.lens.blur_radius(depths).max()) if seen.any() else 0.0

    def _reach(self, nodes: int) -> int:
        return 1 + math.ceil(min(GAP[nodes] * self.blur, max(self.value.shape)))

    def _count(self, what: str, count: int, rays: int) -> None:
        self.rays += rays
        self.levels.append(f"{what}: {count} pixels")


def _chunks(index: NDArray[np.uint32], size: int) -> list[NDArray[np.uint32]]:
    return [index[k : k + size] for k in range(0, len(index), size)]
