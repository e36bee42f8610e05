"""Chords through pupil and pixel where the line of sight jumps: more of them until no pixel around moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .. import rules
from .draft import LANES, Draft, chunks
from .lines import chords_across, integrate_chord

if TYPE_CHECKING:
    from .draft import Index
    from .grid import Image, Mask

SAFETY = 3.0  # the last change of a level and of its neighbours, times this, bounds what is left
FIRST_GAIN = 0.3  # what is left of the difference to twelve nodes once the first chords are in, at most
LEAST_JUMP = 0.1  # of the tolerance: less is not looked for


def integrate_by_chords(draft: Draft, rough: Mask) -> None:
    """More chords each round on the pixels that the last round still moved, or moved a neighbour of."""
    where = rough
    angle = draft.grid.principal_angle(*draft.grid.gradient(draft.value), 1 + math.ceil(dr.max(draft.blur)[0] / 2))
    across_pupil = _across_pupil(draft)
    split, count = draft.grid.full(mi.Bool, False), 0
    for level, (m, q) in enumerate(rules.CHORD_LEVELS):
        rule, along = rules.chords(m, q, draft.area), rules.along_chord(level)
        if 16 + len(rule) * along.rays > draft.quadrature.max_nodes or not dr.any(where):
            break
        means = _apply(draft, where, angle, across_pupil, rule, along)
        if level == 0:
            split = _first_chords(draft, where, means)
            # Across the pupil all other directions have Gauss nodes: right for smooth pixels, sharp or not.
            across_pupil |= _calm(draft, split)
        else:
            # What the change before this one should have become by now, lest two wrong values agree by chance.
            draft.change *= dr.opaque(mi.Float64, (count / len(rule)) ** rules.CHORD_ORDER)
            moved = dr.maximum(dr.abs(means.value - draft.value), draft.change)
            draft.change = dr.select(where, moved, draft.change)
            draft.value = dr.select(where, means.value, draft.value)
            draft.hits = dr.select(where, means.hits, draft.hits)
            # A jump that no chord met before: what was moved until now says nothing of it.
            fresh = where & means.jumps & ~split
            split |= fresh
            error = SAFETY * draft.grid.spread_max(draft.change)
            error = dr.select(fresh, dr.maximum(error, 2 * draft.tolerance), error)
            draft.error = dr.select(where, error, draft.error)
        count = len(rule)
        where &= draft.error > draft.tolerance
        dr.eval(draft.change, draft.value, draft.hits, draft.error, split, where)


@dataclass(frozen=True)
class _Means:
    """Of each marked pixel mean radiance on film, share of hits, whether a chord is split by a jump.

    odds : what every other chord has more of the mean than the rest
    """

    value: Image
    hits: Image
    jumps: Mask
    odds: Image


def _first_chords(draft: Draft, where: Mask, means: _Means) -> Mask:
    """Take the first chords where they are split by a jump, and return these pixels; elsewhere nodes were better.

    At a jump chords are far better than nodes, as long as their two halves agree.
    """
    moved = dr.maximum(dr.abs(means.value - draft.value), FIRST_GAIN * draft.change)
    change = dr.select(where, dr.maximum(FIRST_GAIN * moved, dr.abs(means.odds) / 2), 0)
    split = where & means.jumps
    draft.value = dr.select(split, means.value, draft.value)
    draft.hits = dr.select(split, means.hits, draft.hits)
    error = dr.maximum(SAFETY * draft.grid.spread_max(change), draft.unseen_by_chords(split))
    draft.error = dr.select(where, error, draft.error)
    draft.change = dr.select(split, change, 0)  # nothing changed elsewhere yet
    return split


def _apply(
    draft: Draft, where: Mask, angle: Image, across_pupil: Mask, rule: rules.Chords, along: rules.AlongChord
) -> _Means:
    """Means of all chords of a rule at the marked pixels, 0 elsewhere."""
    index = dr.compress(where)
    images = [draft.grid.full(mi.Float64, 0) for _ in range(4)]
    rays = 0
    for part in chunks(index, max(1, LANES // len(rule))):
        *sums, looks = _chord_sums(draft, part, angle, across_pupil, rule, along)
        for image, column in zip(images, sums, strict=True):
            dr.scatter(image, column, part)
        dr.eval(images)
        rays += int(dr.sum(looks)[0])
    draft.count(f"{len(rule)} chords", dr.width(index), rays)
    value, hits, jumps, odds = images
    return _Means(value, hits, jumps > 0, odds)


def _chord_sums(
    draft: Draft, part: Index, angle: Image, across_pupil: Mask, rule: rules.Chords, along: rules.AlongChord
) -> list[Image]:
    """Of each listed pixel sums over its chords, in one launch: value, hits, jumps, odds and lines of sight."""
    count = dr.opaque(mi.UInt32, len(rule))
    lane = dr.arange(mi.UInt32, dr.width(part) * len(rule))
    pixel, number = dr.gather(mi.UInt32, part, lane // count), lane % count
    chord = chords_across(
        rule,
        number,
        draft.window.centres(pixel),
        mi.Float(dr.gather(mi.Float64, angle, pixel)),
        dr.gather(mi.Bool, across_pupil, pixel),
        mi.Float(2 * draft.peak),
        mi.Float(LEAST_JUMP * draft.tolerance),
    )
    value, hits, jumps, looks = (mi.Float64(n) for n in integrate_chord(draft.scene, draft.lens, chord, along))
    means = [value, hits, jumps, dr.select(number % 2 == 0, value, -value), looks]
    dr.eval(means)  # together: a reduction evaluates what it needs alone, and would trace every ray twice
    return [dr.block_sum(mean, len(rule)) for mean in means]


def _across_pupil(draft: Draft) -> Mask:
    """True where a jump crosses the pupil more than the pixel: its blur disc is wider than a pixel."""
    if not draft.area:
        return draft.grid.full(mi.Bool, True)
    nearest = -draft.grid.spread_max(-draft.nearest)
    return ((draft.lens.blur_radius(nearest) > 0.5) | draft.clipped) & ~draft.stopped


def _calm(draft: Draft, split: Mask) -> Mask:
    """True where neither a pixel nor its neighbours jump: no chord of theirs was split, no outline passes."""
    return ~draft.grid.dilate(split | draft.grid.outline(draft.hits, 1), 1)
