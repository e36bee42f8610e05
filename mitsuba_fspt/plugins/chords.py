"""Chords through pupil and pixel where the line of sight jumps: more of them until no pixel around moves."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import pixels, rules
from .draft import LANES, Draft, Image, Index, Mask, chunks
from .lines import chords_across, integrate_chord

SAFETY = 3.0  # the last change of a level and of its neighbours, times this, bounds what is left
FIRST_GAIN = 0.3  # what is left of the difference to twelve nodes once the first chords are in, at most
LEAST_JUMP = 0.1  # of the tolerance: less is not looked for


def integrate_by_chords(draft: Draft, rough: Mask) -> None:
    """More chords each round on the pixels that the last round still moved, or moved a neighbour of."""
    index = np.flatnonzero(rough).astype(np.uint32)
    angle = pixels.principal_angle(*pixels.gradient(draft.value), 1 + math.ceil(draft.blur.max() / 2))
    across_pupil = _across_pupil(draft)
    count = 0
    for level, (m, q) in enumerate(rules.CHORD_LEVELS):
        rule, along = rules.chords(m, q, draft.area), rules.along_chord(level)
        if not len(index) or 16 + len(rule) * along.rays > draft.quadrature.max_nodes:
            break
        columns = [
            _chord_means(draft, part, angle.flat[part], across_pupil.flat[part], rule, along)
            for part in chunks(index, max(1, LANES // len(rule)))
        ]
        mean, met, jumps, looks, odds = np.concatenate(columns, axis=1)
        draft.count(f"{len(rule)} chords", len(index), int(looks.sum()))
        if level == 0:
            split = _first_chords(draft, index, mean, met, jumps, odds)
            # Across the pupil all other directions have Gauss nodes: right for smooth pixels, sharp or not.
            across_pupil |= _calm(draft, split)
        else:
            # What the change before this one should have become by now, lest two wrong values agree by chance.
            draft.change *= (count / len(rule)) ** rules.CHORD_ORDER
            draft.change.flat[index] = np.maximum(np.abs(mean - draft.value.flat[index]), draft.change.flat[index])
            draft.value.flat[index], draft.hits.flat[index] = mean, met
            # A jump that no chord met before: what was moved until now says nothing of it.
            fresh = (jumps > 0) & ~split.flat[index]
            split.flat[index] |= jumps > 0
            error = SAFETY * pixels.spread_max(draft.change).flat[index]
            draft.error.flat[index] = np.where(fresh, np.maximum(error, 2 * draft.tolerance), error)
        count = len(rule)
        index = index[draft.error.flat[index] > draft.tolerance]


def _first_chords(draft: Draft, index: Index, mean: Image, met: Image, jumps: Image, odds: Image) -> Mask:
    """Take the first chords where they are split by a jump, and return these pixels; elsewhere nodes were better.

    At a jump chords are far better than nodes, as long as their two halves agree.
    """
    moved = np.maximum(np.abs(mean - draft.value.flat[index]), FIRST_GAIN * draft.change.flat[index])
    draft.change[:] = 0
    draft.change.flat[index] = np.maximum(FIRST_GAIN * moved, np.abs(odds) / 2)
    jump = jumps > 0
    split = np.zeros(draft.value.shape, bool)
    split.flat[index] = jump
    draft.value.flat[index[jump]], draft.hits.flat[index[jump]] = mean[jump], met[jump]
    error = np.maximum(SAFETY * pixels.spread_max(draft.change), draft.unseen_by_chords(split))
    draft.error.flat[index] = error.flat[index]
    draft.change[~split] = 0  # nothing changed there yet
    return split


def _chord_means(
    draft: Draft, part: Index, angle: Image, across_pupil: Mask, rule: rules.Chords, along: rules.AlongChord
) -> list[Image]:
    """Of each listed pixel mean radiance on film, share of hits, jumps and lines of sight, in one launch.

    Last what every other chord has more of the mean than the rest.
    """
    count = dr.opaque(mi.UInt32, len(rule))
    lane = dr.arange(mi.UInt32, len(part) * len(rule))
    pixel, number = lane // count, lane % count
    chord = chords_across(
        rule,
        number,
        dr.gather(mi.Point2f, draft.window.centres(part), pixel),
        dr.gather(mi.Float, mi.Float(angle), pixel),
        dr.gather(mi.Bool, mi.Bool(across_pupil), pixel),
        dr.opaque(mi.Float, 2 * float(draft.value.max())),
        dr.opaque(mi.Float, LEAST_JUMP * draft.tolerance),
    )
    means = [mi.Float64(mean) for mean in integrate_chord(draft.scene, draft.lens, chord, along)]
    means.append(dr.select(number % 2 == 0, means[0], -means[0]))
    dr.eval(means)  # together: a reduction evaluates what it needs alone, and would trace every ray twice
    sums = [dr.block_sum(mean, len(rule)) for mean in means]
    dr.eval(sums)
    return [column.numpy() for column in sums]


def _across_pupil(draft: Draft) -> Mask:
    """True where a jump crosses the pupil more than the pixel: its blur disc is wider than a pixel."""
    if not draft.area:
        return np.ones(draft.value.shape, bool)
    nearest = -pixels.spread_max(-draft.nearest)
    return ((draft.lens.blur_radius(nearest) > 0.5) | draft.clipped) & ~draft.stopped


def _calm(draft: Draft, split: Mask) -> Mask:
    """True where neither a pixel nor its neighbours jump: no chord of theirs was split, no outline passes."""
    return ~pixels.dilate(split | pixels.outline(draft.hits, 1), 1)
