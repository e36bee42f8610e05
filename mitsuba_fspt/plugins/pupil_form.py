"""Eq. 9 in its pupil form: P = étendue · mean over pixel and pupil of cos⁴θ · L(first surface point on the line).

A ladder of three rules. Four nodes over pupil and pixel serve every pixel, one where the pupil is as good as a point,
and blur stays in the pixel; where the picture bends, twelve; where the line of sight jumps (a silhouette, an occluder,
an edge of J_n), chords: along each the jumps are found by bisection and the pieces between them are integrated on their
own, so that only smooth averages are left to sample.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import pixels, rules
from ..quadrature import Quadrature, Solution
from ..shortcuts import Finding
from .lines import apply_rule, chords_across, integrate_chord
from .window import Window, visible_window

LANES = 1 << 22  # lines of sight in flight: bounds the memory, not the picture
SAFETY = 3.0  # the last change of a chord level and of its neighbours, times this, bounds what is left
FLOAT32_FLOOR = 2e-7  # share of the brightest pixel that float32 rays cannot resolve
# A silhouette can pass between the outermost of a rule's nodes, or of the first four chords, and the rim of the pupil:
# that far in (blur radii). A straight one makes them wrong by at most this share of the light, where it parts the nodes
# and where it does not.
GAP = {1: 1.0, 4: 0.6, 12: 0.25, "chords": 0.1}
CUT = {1: 0.5, 4: 0.35, 12: 0.3}
UNSEEN = {1: 0.5, 4: 0.25, 12: 0.15, "chords": 0.0125}
POINT = 0.1  # of rtol: what the curvature of cos⁴θ over the pupil may make
IN_PIXEL = 0.5  # blur radius that stays in the pixel
SETTLED = 0.25  # of the tolerance: where the picture bends less, more nodes would change it by less than a tenth
LEAST_JUMP = 0.1  # of the tolerance: less is not looked for
TURN_REACH = 2  # pixels around over which a smooth correction is averaged, lest it add the roughness of J_n
FIRST_GAIN = 0.3  # what is left of the difference to twelve nodes once the first chords are in, at most
MOST_GAIN = 8.0  # twelve nodes may agree with four by chance: no better than the estimate for four over this
LEAST_GAIN = 0.5  # no difference between four and twelve nodes promises more than to shrink to this

Image = NDArray[np.float64]


def solve(
    scene: mi.Scene, lens: mi.Sensor, window: Window, quadrature: Quadrature, known: Solution | None = None
) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window; see `Quadrature` for what is promised.

    Only pixels of the `window` are looked at, the others are dark. Where a partial solution is `known` no work is done,
    and what comes back is rough.
    """
    return _Ladder(scene, lens, window, quadrature, known).climb()


def coverage(scene: mi.Scene, lens: mi.Sensor) -> Image:
    """Share of each pixel's lines of sight that meet a surface, by twelve of them; shape (h, w)."""
    window = visible_window(scene, lens)
    index = np.arange(math.prod(window.shape), dtype=np.uint32)
    hits = [apply_rule(scene, lens, window.centres(part), rules.twelve(True))[4] for part in _chunks(index, LANES)]
    return window.expand(np.concatenate([np.zeros(0), *(h.numpy() for h in hits)]).reshape(window.shape))


class _Ladder:
    """The picture while it is refined: mean radiance on film, its error and coverage, shape (h, w)."""

    def __init__(
        self, scene: mi.Scene, lens: mi.Sensor, window: Window, quadrature: Quadrature, known: Solution | None
    ) -> None:
        self.scene, self.lens, self.window, self.quadrature = scene, lens, window, quadrature
        self.area = quadrature.pixel == "area"
        shape = window.shape
        self.value, self.error, self.hits, self.change, self.angle = (np.zeros(shape) for _ in range(5))
        # Pixels for which a second border of the lens cuts the pupil, whatever is sharp.
        self.clipped = self.window.off_axis(lens) > lens.optics.clear_field
        self.across_pupil = np.ones(shape, bool)
        self.open = np.ones(shape, bool)  # pixels that are not known from elsewhere
        self.known = np.zeros(shape)
        if known is not None:
            self.open, self.known = ~self.window.cut(known.where), self.window.cut(known.power) / lens.etendue
        self.nearest = np.full(shape, np.inf)
        self.blur = np.zeros(shape)  # largest blur radius of what a pixel or a neighbour sees [pixels]
        self.rays = 0
        self.levels: list[str] = []
        self.findings: list[Finding] = []

    def climb(self) -> Solution:
        if self.value.size:
            rough = self._first_nodes(rules.one() if self._one_will_do() else rules.four(self.area))
            if self.quadrature.max_nodes >= 16:
                rough = self._twelve_nodes(rough)
                if rough.any():
                    self._chords(rough)
        error = np.maximum(self.error, FLOAT32_FLOOR * self.value.max(initial=0.0))
        error[self.hits == 0] = self.error[self.hits == 0]
        power, error = (self.window.expand(image) * self.lens.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.hits, 0, 1))
        return Solution(power, error, coverage, self.rays, tuple(self.levels), findings=tuple(self.findings))

    @property
    def tolerance(self) -> float:
        return self.quadrature.rtol * float(self.value.max(initial=0.0))

    # ------------------------------------------------------------------ smooth pixels

    def _one_will_do(self) -> bool:
        """True where lines of sight differ over the pupil, if at all, like the picture over the pixel."""
        lens, blur = self.lens.optics, self.window.blur
        curvature = 0.0 if lens.model == "pinhole" else 2 * (lens.discs[0].radius / lens.focus_distance) ** 2
        will_do = curvature <= POINT * self.quadrature.rtol and blur <= IN_PIXEL and len(lens.discs) == 1
        taken = will_do and self.quadrature.takes("one line")
        why = f"cos⁴θ differs by {curvature:.1e} over the pupil, blur discs reach {blur:.2g} pixels"
        self.findings.append(Finding("one line", taken, why))
        return taken

    def _first_nodes(self, rule: rules.Rule) -> NDArray[np.bool_]:
        """One or four nodes over pupil and pixel everywhere; returns the pixels that they do not settle."""
        everything = np.ones(self.window.shape, bool)
        value, contrast, mx, my, self.hits, self.nearest, far = self._apply(rule, everything)
        self.blur = self._blur(far)
        self.value = value = np.where(self.open, value, self.known)
        # Fourth order like the rule's own error: f = m exp(g·a/m) has M = g/4.
        slope = 4 * np.hypot(mx, my)
        bend = np.abs(contrast) + np.divide(slope**4, 4 * value**3, out=np.zeros_like(value), where=value > 0)
        neighbours = self.area or len(rule) == 1  # tell how the picture bends
        if neighbours:
            xx, yy = pixels.second_differences(value)
            xxxx, yyyy = pixels.second_differences(xx)[0], pixels.second_differences(yy)[1]
            bend += (np.abs(xxxx) + np.abs(yyyy)) / 12
            if len(rule) == 1:
                more = rules.one_spread(xx + yy, self.blur, self.area)
            else:
                curl = pixels.gradient(mx)[1] - pixels.gradient(my)[0]
                turn = rules.four_turn(curl, xx + yy)
                more = -pixels.mean_where(turn, ~pixels.outline(self.hits, 1), TURN_REACH)
            self.value = np.maximum(value + np.where(self.hits > 1 - pixels.ROUNDING, more, 0), 0)
        bend = pixels.spread_max(bend)
        self.error = np.maximum(bend, self._cut_off(len(rule)))
        rough = (self.error > self.tolerance) | (bend > SETTLED * self.tolerance)
        if (neighbours and min(rough.shape) < 3) or not self.quadrature.takes("smooth"):
            rough[:] = True
        rough = self._grown(rough & self.open, len(rule)) & self.open
        smooth = int(np.count_nonzero(~rough & (self.hits > 0)))
        why = f"{smooth} of {rough.size} pixels see the surface, smooth and no edge of it"
        self.findings.append(Finding("smooth", smooth > 0, why))
        return rough

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
        return rough & self._grown(rougher, 12)

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
        reach = self._reach(nodes)
        share = np.where(pixels.grow(pixels.outline(self.hits, 1), reach - 1), UNSEEN[nodes], 0.0)
        share[pixels.parted(self.hits) | self.clipped] = CUT[nodes]
        return share * self._whole(reach.max())

    def _whole(self, reach: int) -> Image:
        """Largest value within `reach` pixels, if no line of sight missed."""
        whole = np.divide(self.value, self.hits, out=np.zeros_like(self.value), where=self.hits > pixels.ROUNDING)
        return pixels.spread_max(whole, reach)

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
        self.angle = pixels.principal_angle(*pixels.gradient(self.value), 1 + math.ceil(self.blur.max() / 2))
        self.across_pupil = self._across_pupil()
        count = 0
        for level, (m, q) in enumerate(rules.CHORD_LEVELS):
            rule, along = rules.chords(m, q, self.area), rules.along_chord(level)
            if not len(index) or 16 + len(rule) * along.rays > self.quadrature.max_nodes:
                break
            columns = [self._chord_means(part, rule, along) for part in _chunks(index, max(1, LANES // len(rule)))]
            mean, met, jumps, looks, odds = np.concatenate(columns, axis=1)
            self._count(f"{len(rule)} chords", len(index), int(looks.sum()))
            if level == 0:
                self._first_chords(index, mean, met, jumps, odds)
            else:
                # What the change before this one should have become by now, lest two wrong values agree by chance.
                self.change *= (count / len(rule)) ** rules.CHORD_ORDER
                self.change.flat[index] = np.maximum(np.abs(mean - self.value.flat[index]), self.change.flat[index])
                self.value.flat[index], self.hits.flat[index] = mean, met
                self.error.flat[index] = SAFETY * pixels.spread_max(self.change).flat[index]
            count = len(rule)
            index = index[self.error.flat[index] > self.tolerance]

    def _first_chords(self, index: NDArray[np.uint32], mean: Image, met: Image, jumps: Image, odds: Image) -> None:
        """Far better than nodes where there is a jump, as long as their two halves agree; elsewhere nodes were."""
        moved = np.maximum(np.abs(mean - self.value.flat[index]), FIRST_GAIN * self.change.flat[index])
        self.change[:] = 0
        self.change.flat[index] = np.maximum(FIRST_GAIN * moved, np.abs(odds) / 2)
        split = np.zeros(self.value.shape, bool)
        split.flat[index] = jumps > 0
        chords = index[jumps > 0]
        self.value.flat[chords], self.hits.flat[chords] = mean[jumps > 0], met[jumps > 0]
        reach = self._reach("chords")
        near = pixels.grow(split, reach) & ~split
        unseen = np.where(near, UNSEEN["chords"] * self._whole(reach.max()), 0)
        self.error.flat[index] = np.maximum(SAFETY * pixels.spread_max(self.change), unseen).flat[index]
        self.change[~split] = 0  # nothing changed there yet
        # Across the pupil all other directions have Gauss nodes: right for smooth pixels, sharp or not.
        self.across_pupil |= self._calm(split)

    def _chord_means(self, part: NDArray[np.uint32], rule: rules.Chords, along: rules.AlongChord) -> list[Image]:
        """Of each listed pixel mean radiance on film, share of hits, jumps and lines of sight, in one launch.

        Last what every other chord has more of the mean than the rest.
        """
        count = dr.opaque(mi.UInt32, len(rule))
        lane = dr.arange(mi.UInt32, len(part) * len(rule))
        pixel, number = lane // count, lane % count
        chord = chords_across(
            rule,
            number,
            dr.gather(mi.Point2f, self.window.centres(part), pixel),
            dr.gather(mi.Float, mi.Float(self.angle.flat[part]), pixel),
            dr.gather(mi.Bool, mi.Bool(self.across_pupil.flat[part]), pixel),
            dr.opaque(mi.Float, 2 * float(self.value.max())),
            dr.opaque(mi.Float, LEAST_JUMP * self.tolerance),
        )
        means = integrate_chord(self.scene, self.lens, chord, along)
        means = [mi.Float64(mean) for mean in means]
        means.append(dr.select(number % 2 == 0, means[0], -means[0]))
        dr.eval(means)  # together: a reduction evaluates what it needs alone, and would trace every ray twice
        sums = [dr.block_sum(mean, len(rule)) for mean in means]
        dr.eval(sums)
        return [column.numpy() for column in sums]

    def _across_pupil(self) -> NDArray[np.bool_]:
        """True where a jump crosses the pupil more than the pixel: its blur disc is wider than a pixel."""
        if not self.area:
            return np.ones(self.value.shape, bool)
        nearest = -pixels.spread_max(-self.nearest)
        return (self.lens.blur_radius(nearest) > 0.5) | self.clipped

    def _calm(self, split: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """True where neither a pixel nor its neighbours jump: no chord of theirs was split, no outline passes."""
        return ~pixels.dilate(split | pixels.outline(self.hits, 1), 1)

    def _blur(self, farthest: Image) -> Image:
        """Of what is nearest or farthest: from the sharp plane on, blur grows either way."""
        seen = np.isfinite(self.nearest)
        blur = np.zeros(seen.shape)
        blur[seen] = self.lens.blur_radius(np.array([self.nearest[seen], farthest[seen]])).max(axis=0)
        return pixels.spread_max(np.minimum(blur, max(seen.shape)))

    def _grown(self, rough: NDArray[np.bool_], nodes: int) -> NDArray[np.bool_]:
        """`rough` and the surroundings in which what makes it rough may hide; of a silhouette `_cut_off` knows."""
        return rough | pixels.grow(rough & ~pixels.outline(self.hits, 1), self._reach(nodes))

    def _reach(self, nodes: int | str) -> NDArray[np.int64]:
        return 1 + np.ceil(GAP[nodes] * self.blur).astype(np.int64)

    def _count(self, what: str, count: int, rays: int) -> None:
        self.rays += rays
        self.levels.append(f"{what}: {count} pixels")


def _chunks(index: NDArray[np.uint32], size: int) -> list[NDArray[np.uint32]]:
    return [index[k : k + size] for k in range(0, len(index), size)]
