"""Transects through pixel × pupil where the line of sight jumps: more of them until no pixel around moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..jit.batches import batches
from ..jit.loops import repeat
from ..jit.pixel_grid import COVERAGE_ROUNDING, parted
from . import node_rules
from .draft import Draft
from .jumps import integrate_transect
from .nodes import apply_nodes
from .transect import transect

if TYPE_CHECKING:
    from ..jit.pixel_grid import Mask, PixelArray

DARK_LEVELS = 3  # while no light is found anywhere
FAR = 1e30  # depth [mm] that stands for infinity, where an edge has a finite blur


def integrate_by_transects(draft: Draft, rough: Mask, levels: list[tuple[int, node_rules.AlongTransect]]) -> None:
    """More transects each round on the pixels that the last round still moved, or moved a neighbour of."""
    ladder = _Ladder(draft, rough)
    for level, (count, along) in enumerate(levels):
        if not dr.any(ladder.where):
            break
        ladder.climb(level, node_rules.transects(count), along)
        draft.progress((3 + level) / (2 + len(levels)))  # after two steps of nodes


class _Ladder:
    """Which pixels the next transects go to, and what is known of them.

    where : pixels to look at
    wanted : pixels that are shown, and those around that doubt them
    edges : which way transects go
    split : True where a transect met a jump
    smooth : True where node rules may do as well
    left : what the value may be wrong by, of every pixel on its own
    count, means : of the last round, how many transects and what they found
    """

    def __init__(self, draft: Draft, rough: Mask) -> None:
        self.draft, self.edges, self.wanted = draft, edges_of(draft), draft.wanted()
        self.estimator = draft.estimator
        self.where = rough & self.wanted
        self.split, self.smooth = (draft.grid.full(mi.Bool, known) for known in (False, True))
        self.left = draft.grid.full(mi.Float64, 0)
        self.count = 0
        self.means: Means | None = None

    def climb(self, level: int, rule: node_rules.Transects, along: node_rules.AlongTransect) -> None:
        """One round: values, what is left of the error, and whether a neighbour knows better."""
        draft, where = self.draft, self.where
        if self.means:
            self.edges.learn(draft, self.means, self.split, across=level % 2 == 0)
        self.means = means = apply_transects(draft, where, self.edges, rule, along)
        # What hides light may be cut by outlines all over the pupil but where the light comes past it.
        lit = means.value > dr.opaque(mi.Float64, self.estimator.dim) * draft.peak
        fresh = where & means.jumps & lit & ~self.split
        self.split |= fresh
        self.smooth = self.smooth & where & ~self.split
        value, coverage, scatter = means.value, means.coverage, means.scatter
        if 0 < level <= node_rules.SMOOTH_LEVELS and dr.any(self.smooth):
            seen = apply_nodes(draft, node_rules.product(level, draft.area), self.smooth, ("value", "coverage"))
            value, coverage = dr.select(self.smooth, seen.value, value), dr.select(self.smooth, seen.coverage, coverage)
        moved = dr.abs(value - draft.value)
        if level == 0:
            left, unseen = self._first(fresh, moved, scatter, parted(coverage))
        else:
            left, unseen = self._later(level, fresh, moved, scatter, len(rule))
            self.smooth = self.smooth & (moved < self.estimator.bumpy * value)
        # Whose neighbour meets a jump at last, or was misled, may pass the same by and be as wrong as that one was:
        # who met no jump, and who has settled.
        unseen = dr.select((self.split & where) | ~draft.open, 0, unseen)
        self.left = dr.select(where, left, self.left)
        better = where if level else fresh  # where the first transects meet no jump nodes are
        draft.value = dr.select(better, value, draft.value)
        draft.set_coverage(dr.select(better, coverage, draft.coverage))
        known = self.split & ~fresh
        draft.error = dr.maximum(dr.select(where, dr.maximum(self.left, self._doubt(known)), draft.error), unseen)
        tolerance = draft.tolerance
        dark = (tolerance <= 0) & dr.opaque(mi.Bool, level + 1 < DARK_LEVELS)
        self.where = (where | (unseen > 0)) & ((draft.error > tolerance) | dark) & self.wanted
        self.count = len(rule)
        dr.eval(draft.value, draft.error, self.split, self.smooth, self.left, self.where)

    def _unsettled(self, left: PixelArray) -> PixelArray:
        """What is left, or so much that another level is needed."""
        return dr.maximum(left, self.estimator.unsettled * self.draft.tolerance)

    def _doubt(self, known: Mask) -> PixelArray:
        """What pixels may be wrong by for all that neighbours know; `known`: which pixels know an edge themselves."""
        near, edge = self.draft.grid.spread_all((self.left, dr.select(self.split, self.left, 0)))
        doubt = dr.maximum(dr.opaque(mi.Float64, self.estimator.doubt) * near, dr.select(known, 0, edge))
        return dr.select(self.edges.sharp, near, doubt)

    def _first(
        self, fresh: Mask, moved: PixelArray, scatter: PixelArray, silhouette: Mask
    ) -> tuple[PixelArray, PixelArray]:
        """What may be left after the first transects, and what they pass by beside a jump.

        That two of them and the nodes agree says enough of a silhouette, and of another jump too little.
        """
        draft, estimator = self.draft, self.estimator
        left = dr.maximum(estimator.first_gain * moved, scatter)
        left = dr.select(silhouette, left, self._unsettled(left))
        missed = dr.maximum(
            estimator.nodes_gain * moved, dr.select(parted(draft.coverage), draft.error, draft.roughness)
        )
        # Who is known from elsewhere takes no transects, and knows of the silhouette all the same.
        return dr.select(fresh, left, missed), draft.unseen_by_transects(fresh | (draft.outline & ~draft.open))

    def _later(
        self, level: int, fresh: Mask, moved: PixelArray, scatter: PixelArray, count: int
    ) -> tuple[PixelArray, PixelArray]:
        """What may be left, and what neighbours of a jump that is met at last, or of who was misled, may be wrong by.

        The less a level moved of what was left before the less is left, but lest two wrong values agree by chance no
        less than the order of convergence grants. What was moved until now says nothing of a fresh jump.
        """
        before, estimator = self.left, self.estimator
        least, most = estimator.least_gain, estimator.most_gain
        change = dr.maximum(moved, before * dr.opaque(mi.Float64, (self.count / count) ** estimator.order))
        gain = dr.clip(dr.select(before > 0, most * change / before, most), least, most)
        left = dr.maximum(change * gain, scatter)
        if level <= node_rules.SMOOTH_LEVELS:
            # On what is smooth each step of the node rules gains more than it moves.
            left = dr.select(self.smooth, estimator.step_gain * moved, left)
        left = dr.select(fresh, self._unsettled(left), left)
        farther = dr.maximum(dr.opaque(mi.Float64, estimator.misled) * before, self.draft.tolerance)
        misled = self.where & (moved > farther)
        return left, self.draft.near_edge(dr.select(fresh | misled, moved, 0))


# ---------------------------------------------------------------------- which way transects go


@dataclass
class Edges:
    """Of the edge a pixel may see: `angle` across it, signed `blur` radius [pixels], whether it counts as `sharp`."""

    angle: PixelArray
    blur: PixelArray
    sharp: Mask

    def learn(self, draft: Draft, means: Means, split: Mask, across: bool = False) -> None:
        """Blur of the edges that were met; pixels that see none are smooth, and none is sharp.

        Whoever met none may see the tip of a neighbour's, and looks next towards where more or fewer lines hit; at
        every other level `across` that, for what dark bodies leave of the light may lie beside all such transects.
        """
        grid, jumps = draft.grid, means.jumps
        around = (means.blur, -means.blur, jumps, split | draft.outline)
        ahead, behind, known, near = grid.spread_all(around)
        blur = dr.select(jumps, means.blur, _most_blurred(ahead, -behind))
        self.blur = dr.select(known & ~draft.clipped, blur, self.blur)
        self.sharp = (dr.abs(self.blur) < draft.estimator.sharp) & near
        x, y = grid.gradient(grid.box_sum(draft.coverage, _around(draft)))
        alike = dr.abs(x) + dr.abs(y) < COVERAGE_ROUNDING
        turn = dr.opaque(mi.Float64, math.pi / 2 if across else 0)
        self.angle = dr.select(split | alike, self.angle, dr.atan2(y, x) + turn)
        dr.eval(self.angle, self.blur, self.sharp)


def _around(draft: Draft) -> int:
    """From how far around a pixel learns which way its edge runs [pixels]."""
    return 1 + math.ceil(draft.most_blur / 2)


def _most_blurred(ahead: PixelArray, behind: PixelArray) -> PixelArray:
    """Of two signed blur radii the larger: between them, where neither edge is sharp, the mean may be."""
    return dr.select(ahead > -behind, ahead, behind)


def edges_of(draft: Draft) -> Edges:
    """Across the change of the picture around, with the blur of what is nearest to the lens.

    The image-plane stop is sharp.
    """
    grid = draft.grid
    angle = grid.principal_angle(*grid.gradient(draft.value), _around(draft))
    nearest = grid.spread_max(-draft.nearest)
    # Who sees no silhouette may still see a part of a blurred one that his nodes missed.
    farther = grid.spread_max(nearest, draft.reach(12)[1] - 1)
    nearest = -dr.select(draft.outline & dr.isfinite(nearest), nearest, farther)
    blur = dr.select(draft.clipped, 0, draft.lens.blur_radius(nearest))
    return Edges(angle, blur, dr.abs(blur) < draft.estimator.sharp)


# ---------------------------------------------------------------------- many transects in one launch


@dataclass(frozen=True)
class Means:
    """Of each marked pixel mean radiance on film, share of coverage, whether a transect is split by a jump.

    scatter : what the value may be wrong by for all that the transects differ
    blur : signed radius of the most blurred edge that a transect met, 0 where none did [pixels]
    """

    value: PixelArray
    coverage: PixelArray
    jumps: Mask
    scatter: PixelArray
    blur: PixelArray


def apply_transects(
    draft: Draft, where: Mask, edges: Edges, rule: node_rules.Transects, along: node_rules.AlongTransect
) -> Means:
    """Means over all transects of a rule at the marked pixels, 0 elsewhere."""
    index, table = draft.grid.pixels(where), mi.Float(rule.table)
    images = [draft.grid.full(mi.Float64, 0) for _ in range(6)]
    rays = 0
    for part in batches(index, len(rule)):
        *found, looks = _along_transects(draft, part, edges, rule, table, along)
        for image, column in zip(images, _sums(part, edges, rule, table, found), strict=True):
            dr.scatter(image, column, part)
        dr.eval(images)
        rays += int(dr.sum(looks)[0])
    draft.count(f"{len(rule)} transects", dr.width(index), rays)
    value, coverage, squares, trend, split, blur = images
    number, estimator = dr.opaque(mi.Float64, len(rule)), draft.estimator
    variance = squares - value * value
    spread = dr.opaque(mi.Float64, estimator.kink if len(rule) > 2 else estimator.spread)
    blurred = spread * dr.safe_sqrt(variance - trend) / number
    # Those of a sharp edge differ as it slants, each has a part of it that is its own, and all may pass a corner by.
    slant = estimator.slant * dr.safe_sqrt(variance) / (number * dr.sqrt(number))
    sharp = dr.maximum(slant, estimator.corner * value / (number * number))
    return Means(value, coverage, split > 0, dr.select(edges.sharp, sharp, blurred), blur)


def _along_transects(
    draft: Draft,
    part: mi.UInt32,
    edges: Edges,
    rule: node_rules.Transects,
    table: mi.Float,
    along: node_rules.AlongTransect,
) -> tuple[mi.Float, mi.Float, mi.UInt32, mi.Float, mi.UInt32]:
    """Of each transect of the listed pixels, those of a pixel one after the other: value, coverage, number of jumps,
    signed blur radius of the edge at the largest, 0 without one [pixels], lines of sight taken.
    """
    count = dr.opaque(mi.UInt32, len(rule))
    lane = dr.arange(mi.UInt32, dr.width(part) * len(rule))
    pixel, number = dr.gather(mi.UInt32, part, lane // count), lane % count
    angle, blur = (mi.Float(dr.gather(mi.Float64, image, pixel)) for image in (edges.angle, edges.blur))
    first = dr.select(dr.gather(mi.Bool, edges.sharp, pixel), mi.UInt32(0), 3)
    place = mi.Point3f(*(dr.gather(mi.Float, table, (first + k) * count + number) for k in range(3)))
    phase = dr.gather(mi.Float, table, 7 * count + number)
    curve = transect(draft.centres(pixel), angle, blur, place, dr.opaque(mi.Float, float(draft.area)))
    outline = mi.Float(2 * draft.at_least_peak(dr.max(draft.value)))
    least, steep = mi.Float(draft.estimator.least_jump * draft.tolerance), draft.estimator.steep
    value, coverage, jumps, depth, looks = integrate_transect(draft.view, curve, phase, along, outline, least, steep)
    # Of the edge of a weak reflection beside nothing the depth is not known.
    known = (jumps > 0) & dr.isfinite(depth)
    blur = mi.Float(dr.select(known, draft.lens.blur_radius(mi.Float64(dr.minimum(depth, FAR))), 0))
    found = value, coverage, jumps, blur, looks
    dr.eval(found)  # together: a reduction evaluates what it needs alone, and would trace every ray twice
    return found


def _sums(
    part: mi.UInt32, edges: Edges, rule: node_rules.Transects, table: mi.Float, found: list[mi.Float]
) -> list[PixelArray]:
    """Of each listed pixel means over its transects of value, coverage, value squared, what of that is a trend; how
    many a jump splits, and the blur of the most blurred edge.

    `found` as of `_along_transects`: value, coverage, jumps, blur.
    """
    count = dr.opaque(mi.UInt32, len(rule))
    first = dr.arange(mi.UInt32, dr.width(part)) * count
    sharp, even = dr.gather(mi.Bool, edges.sharp, part), dr.opaque(mi.Float, 1 / len(rule))

    def add(k: mi.UInt32, sums: list[PixelArray], trends: list[PixelArray], ends: list[mi.Float]) -> tuple:
        value, coverage, blur = (dr.gather(mi.Float, found[n], first + k) for n in (0, 1, 3))
        weight = mi.Float64(dr.select(sharp, even, dr.gather(mi.Float, table, 6 * count + k)))
        share, split = weight * mi.Float64(value), dr.gather(mi.UInt32, found[2], first + k) > 0
        terms = share, weight * mi.Float64(coverage), share * mi.Float64(value), dr.select(split, mi.Float64(1), 0)
        sums = [total + term for total, term in zip(sums, terms, strict=True)]
        polynomials = [dr.gather(mi.Float, table, (8 + n) * count + k) for n in range(len(trends))]
        trends = [total + share * mi.Float64(p) for total, p in zip(trends, polynomials, strict=True)]
        return sums, trends, [dr.maximum(ends[0], blur), dr.minimum(ends[1], blur)]

    nothing = [mi.Float64(0) for _ in range(4)], [mi.Float64(0) for _ in range(node_rules.TRENDS)]
    sums, trends, (ahead, behind) = repeat(count, add, *nothing, [mi.Float(-dr.inf), mi.Float(dr.inf)])
    value, coverage, squares, split = sums
    trend = sum(map(dr.square, trends))
    return [value, coverage, squares, trend, split, mi.Float64(_most_blurred(ahead, behind))]
