"""Refinement by transects where the integrand of Eq. M.5 jumps: more at each level, until the error is small."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ...jit.batches import batches
from ...jit.loops import repeat
from ...jit.pixel_grid import COVERAGE_ROUNDING, parted
from ...jit.tables import Table
from ..quadrature import FLOAT32_FLOOR
from . import node_rules
from .draft import Draft
from .jumps import integrate_transect
from .nodes import AGREEMENT, apply_nodes
from .transect import transect

if TYPE_CHECKING:
    from ...jit.pixel_grid import Mask, PixelArray

# Lines of sight that pixels which take these levels are expected to take, but no more than a quarter of the most.
HARD = {1: 600, 3: 1 << 14}
UNKNOWN = 1.5  # error over the tolerance where a jump is crossed for the first time, so that another level follows
LEAST_JUMP = 0.1  # of the tolerance: a smaller step along a transect is no jump, as its error is below that
DARK_LEVELS = 3  # levels of transects that are taken while no line of sight of the image has met light
# Where at least this share of the transects across a sharp edge crosses several edges, as at corners and on texels, a
# corner may lie between two transects, and their order is lower by this factor. Where fewer do, as where a smooth
# outline touches a transect, that adds less than an eighth to the error.
SEVERAL_SHARE, SEVERAL_ORDER = 1 / 16, 2 / 3
# Number of transects from which their mean with uncorrected weights of the nodes is accurate, as phases are even: from
# there on the change by the correction counts as an error. Where there are many steps along a transect, the correction
# makes the values of all transects wrong in the same way, and no level tells.
MANY = 72
# Number of transects from which their scatter shows edges of different blur; the share of the light of surfaces edge-on
# that fewer may miss.
SEVERAL_BLURS, MISSED_EDGE_ON = 24, 0.1
STRAIGHT = 0.9  # least length of the mean of unit vectors at twice the angles of edges that run alike
FAR = 1e30  # depth [mm] at which larger ones are clipped; the blur of an edge is finite there


def integrate_by_transects(
    draft: Draft,
    rough: Mask,
    levels: list[tuple[int, node_rules.AlongTransect]],
    among: Mask | None = None,
    faces: Callable[[Mask, float], Mask] | None = None,
) -> None:
    """Refine the `rough` pixels, and those around on which the same edge may lie, by transects.

    levels : number of transects of each level, and the accuracy along each
    among : pixels that may be refined; None: all that influence a pixel of the crop window
    faces : gives some of the marked pixels their value from the faces of all surfaces, if that is quicker than so many
        lines of sight each, and returns the others
    """
    refinement = _Refinement(draft, rough, draft.wanted() if among is None else draft.wanted() & among)
    for level, (count, along) in enumerate(levels):
        if faces and level in HARD and dr.any(refinement.where):
            lines = min(HARD[level], draft.quadrature.most_nodes / 4)
            refinement.leave(faces(refinement.where, lines))
        if not dr.any(refinement.where):
            break
        if draft.progress.deadline.passed():
            if level == 0:
                draft.spread_error(rough)
            break
        refinement.refine(level, node_rules.transects(count), along)
        draft.progress((3 + level) / (2 + len(levels)))  # after two steps of nodes


class _Refinement:
    """State of the refinement by transects.

    where : pixels that take the next level
    wanted : pixels that may take transects
    edges : direction and blur of the edge on each pixel
    has_jump : True where a transect has crossed a jump
    smooth : True where no transect has crossed one, so that node rules may converge
    value, remaining : of the last level of each pixel, and the error that follows from its own transects [W/mm²/sr]
    own : the same error of the value in `draft`, that of an earlier level if it is smaller there [W/mm²/sr]
    count, means : number of transects of the last level, and their means
    """

    def __init__(self, draft: Draft, rough: Mask, wanted: Mask) -> None:
        self.draft, self.edges, self.wanted = draft, edges_of(draft), wanted
        self.estimator = draft.estimator
        self.where = rough & self.wanted
        self.has_jump, self.smooth = (draft.grid.full(mi.Bool, known) for known in (False, True))
        self.value = draft.value
        self.remaining, self.own = (draft.grid.full(mi.Float64, 0) for _ in range(2))
        self.count = 0
        self.means: Means | None = None

    def leave(self, where: Mask) -> None:
        """Continue on the pixels `where` alone; the others have got their values from elsewhere."""
        self.own = dr.select(self.where & ~where, 0, self.own)
        self.where = where
        dr.eval(self.own, self.where)

    def refine(self, level: int, rule: node_rules.Transects, along: node_rules.AlongTransect) -> None:
        """One level: new values and errors, and the pixels that take the next level."""
        draft, where = self.draft, self.where
        if self.means:
            self.edges.update(draft, self.means, self.has_jump, across=level % 2 == 0)
        self.means = means = apply_transects(draft, where, self.edges, rule, along)
        if means.done is not None:  # the other pixels keep the value and the error of the level before
            if level == 0:
                draft.spread_error(where & ~means.done)
            self.where = where = where & means.done
        # The outline of a dark body counts only where lines of sight meet light, by more than float32 rounds.
        lit = means.value > dr.opaque(mi.Float64, FLOAT32_FLOOR) * draft.peak
        first_met = where & means.jumps & lit & ~self.has_jump
        self.has_jump |= first_met
        self.smooth = self.smooth & where & ~self.has_jump
        value, coverage = self._smooth_by_nodes(level)
        change = dr.abs(value - self.value)
        if level == 0:
            remaining, around = self._after_first(first_met, change, parted(coverage))
        else:
            remaining, around = self._after_later(level, first_met, change, len(rule))
            self.smooth = self.smooth & (value > 0)  # where all is dark, only transects detect a small body
        if len(rule) < SEVERAL_BLURS:
            unseen = dr.opaque(mi.Float64, MISSED_EDGE_ON) * draft.edge_on
            remaining = dr.select(self.has_jump, dr.maximum(remaining, unseen), remaining)
            # The edge of a neighbour may end between all transects of a pixel, which run along it.
            corner = self.has_jump & self.edges.turn(draft, self.has_jump)
            remaining = dr.select(corner, self._above_tolerance(remaining), remaining)
            # Between pixels that see all and nothing of a body there is an outline, though no transect has crossed it.
            uncrossed = draft.outline & ~draft.grid.dilate(self.has_jump, 1)
            around = dr.maximum(around, draft.missed_edge_error(uncrossed))
        # An edge may reach into pixels around whose transects have crossed no jump.
        around = dr.select((self.has_jump & where) | ~draft.computed, 0, around)
        replaced = where if level else first_met  # without a jump, nodes are more accurate than two transects
        self.value = dr.select(replaced, value, self.value)
        self.remaining = dr.select(where, remaining, self.remaining)
        many = len(rule) >= MANY
        kept = self._earlier_is_better(remaining, first_met, many) if level > 1 else mi.Bool(False)
        self.own = dr.select(where & ~kept, remaining, self.own)
        draft.value = dr.select(replaced & ~kept, value, draft.value)
        draft.set_coverage(dr.select(replaced & ~kept, coverage, draft.coverage))
        error = dr.maximum(self.own, self._by_neighbours(self.has_jump & ~first_met))
        draft.error = dr.maximum(dr.select(where, error, draft.error), around)
        tolerance = draft.tolerance
        dark = (tolerance <= 0) & dr.opaque(mi.Bool, level + 1 < DARK_LEVELS)
        self.where = (where | (around > 0)) & ((draft.error > tolerance) | dark) & self.wanted
        self.count = len(rule)
        dr.eval(draft.value, draft.error, self.has_jump, self.smooth, self.where)
        dr.eval(self.value, self.remaining, self.own)

    def _earlier_is_better(self, remaining: PixelArray, first_met: Mask, many: bool) -> Mask:
        """Pixels whose value in the draft has a smaller error than that of this level, which lies within that error.

        A value beyond it contradicts the earlier error, which was too small, and so does a jump that is new. Without an
        earlier level the error is 0. A value of the first level is not kept, as its error follows from a few transects
        and a node rule alone.
        """
        agrees = dr.abs(self.value - self.draft.value) <= self.own
        if many:  # the correction may make the values of both levels wrong in the same way
            agrees &= self.smooth | (dr.abs(self.means.plain - self.draft.value) <= self.own)
        return agrees & (self.own > 0) & (self.own < remaining) & ~first_met

    def _smooth_by_nodes(self, level: int) -> tuple[PixelArray, PixelArray]:
        """Value and coverage of the level: by a node rule on smooth pixels, by transects on the others."""
        value, coverage = self.means.value, self.means.coverage
        if not 0 < level <= node_rules.SMOOTH_LEVELS or not dr.any(self.smooth):
            return value, coverage
        rule = node_rules.product(level, self.draft.area)
        seen = apply_nodes(self.draft, rule, self.smooth, ("value", "coverage"))
        return dr.select(self.smooth, seen.value, value), dr.select(self.smooth, seen.coverage, coverage)

    def _above_tolerance(self, remaining: PixelArray) -> PixelArray:
        """The error that remains, or one above the tolerance, so that another level follows."""
        return dr.maximum(remaining, UNKNOWN * self.draft.tolerance)

    def _by_neighbours(self, met_before: Mask) -> PixelArray:
        """Error of each pixel that follows from the errors of its neighbours, as their edges may reach into it.

        `neighbour_share` of a neighbour's error; all of it where the edge is sharp, or where the neighbour's transects
        have crossed a jump and those of the pixel had not (`met_before`).
        """
        near, with_jump = self.draft.grid.spread_all((self.own, dr.select(self.has_jump, self.own, 0)))
        share = dr.opaque(mi.Float64, self.estimator.neighbour_share)
        blurred = dr.maximum(share * near, dr.select(met_before, 0, with_jump))
        return dr.select(self.edges.sharp, near, blurred)

    def _after_first(self, first_met: Mask, change: PixelArray, silhouette: Mask) -> tuple[PixelArray, PixelArray]:
        """Error that remains after the first transects, and error of pixels around a jump, which may have missed it.

        Two transects that agree suffice on a silhouette, which coverage shows too, but not on a step of J_n. Without a
        jump there may be a dim spot far below a pixel, or the edges of a coarse mesh.
        """
        estimator = self.estimator
        at_jump = dr.maximum(estimator.first_ratio * change, self.means.scatter)
        at_jump = dr.select(silhouette, at_jump, self._above_tolerance(at_jump))
        elsewhere = dr.select(parted(self.draft.coverage), self.draft.error, self.draft.roughness)
        elsewhere = dr.maximum(estimator.nodes_ratio * change, elsewhere)
        # Pixels that another solution gives take no transects; their outlines count as jumps here.
        jumps = first_met | (self.draft.outline & ~self.draft.computed)
        return dr.select(first_met, at_jump, elsewhere), self.draft.missed_edge_error(jumps)

    def _after_later(
        self, level: int, first_met: Mask, change: PixelArray, count: int
    ) -> tuple[PixelArray, PixelArray]:
        """Error that remains after a later level, and error around pixels that this level changed beyond their error.

        It is the change of the value, which counts as no smaller than the order of convergence predicts, as two wrong
        values may agree by chance.
        Where a jump is crossed for the first time another level follows, as earlier changes do not bound its error.
        """
        before, estimator = self.remaining, self.estimator
        fewer, order = self.count / count, estimator.order
        one, several = (dr.opaque(mi.Float64, fewer**own) for own in (order, SEVERAL_ORDER * order))
        assumed = dr.maximum(change, before * dr.select(self.edges.sharp & self.means.several, several, one))
        remaining = dr.maximum(assumed, self.means.scatter)
        if count >= MANY:
            remaining = dr.maximum(remaining, dr.abs(self.means.value - self.means.plain))
        if level <= node_rules.SMOOTH_LEVELS:
            # On smooth pixels the next node rule mostly changes the value by less than this one did.
            remaining = dr.select(self.smooth, dr.opaque(mi.Float64, AGREEMENT) * change, remaining)
        remaining = dr.select(first_met, self._above_tolerance(remaining), remaining)
        expected = dr.maximum(dr.opaque(mi.Float64, estimator.unexpected) * before, self.draft.tolerance)
        unexpected = self.where & (change > expected)
        return remaining, self.draft.near_edge(dr.select(first_met | unexpected, change, 0))


# ---------------------------------------------------------------------- direction and blur of edges


@dataclass
class Edges:
    """Edge on each pixel: `angle` of its normal [rad], signed `blur` radius [pixels], whether it counts as `sharp`."""

    angle: PixelArray
    blur: PixelArray
    sharp: Mask

    def update(self, draft: Draft, means: Means, has_jump: Mask, across: bool = False) -> None:
        """Set the blur to that of the edges which the last transects crossed, on pixels around as well.

        Where no transect has crossed a jump, the end of a neighbour's edge may lie on the pixel: the next transects go
        along the gradient of the coverage, at every other level `across` it, as light beside a dark body may lie
        between all those along it. Where none around has crossed one either, the blur changes its sign: an outline may
        lie on the other side of the virtual detector plane than the nearest surface.
        """
        grid, jumps = draft.grid, means.jumps
        around = (means.blur, -means.blur, jumps, has_jump | draft.outline)
        ahead, behind, known, near = grid.spread_all(around)
        blur = dr.select(jumps, means.blur, _most_blurred(ahead, -behind))
        self.blur = dr.select(known & ~draft.clipped, blur, -self.blur)
        self.sharp = (dr.abs(self.blur) < draft.estimator.sharp) & near
        x, y = grid.gradient(grid.box_sum(draft.coverage, _around(draft)))
        alike = dr.abs(x) + dr.abs(y) < COVERAGE_ROUNDING
        turn = dr.opaque(mi.Float64, math.pi / 2 if across else 0)
        self.angle = dr.select(has_jump | alike, self.angle, dr.atan2(y, x) + turn)
        dr.eval(self.angle, self.blur, self.sharp)

    def turn(self, draft: Draft, has_jump: Mask) -> Mask:
        """True where edges on a pixel and around, on pixels with a jump, have normals of different directions."""
        weight, (sine, cosine) = dr.select(has_jump, mi.Float64(1), 0), dr.sincos(2 * self.angle)
        number, x, y = (draft.grid.box_sum(weight * of, 1) for of in (1, cosine, sine))
        return dr.square(x) + dr.square(y) < dr.square(dr.opaque(mi.Float64, STRAIGHT) * number)


def _around(draft: Draft) -> int:
    """Radius [pixels] of the square over which the gradient is averaged for the direction of an edge."""
    return 1 + math.ceil(draft.most_blur / 2)


def _most_blurred(ahead: PixelArray, behind: PixelArray) -> PixelArray:
    """The one of two signed blur radii with the larger magnitude; their mean could be 0, that of a sharp edge."""
    return dr.select(ahead > -behind, ahead, behind)


def edges_of(draft: Draft) -> Edges:
    """Edges before the first transect: normal along the gradient of the image, blur of the nearest surface.

    The image-plane stop is sharp.
    """
    grid = draft.grid
    angle = grid.principal_angle(*grid.gradient(draft.value), _around(draft))
    nearest = grid.spread_max(-draft.nearest)
    # On a pixel without a silhouette there may be a part of a blurred one that its nodes missed.
    farther = grid.spread_max(nearest, draft.reach(12)[1] - 1)
    nearest = -dr.select(draft.outline & dr.isfinite(nearest), nearest, farther)
    blur = dr.select(draft.clipped, 0, draft.camera.blur_radius(nearest))
    return Edges(angle, blur, dr.abs(blur) < draft.estimator.sharp)


# ---------------------------------------------------------------------- evaluation of transects


@dataclass(frozen=True)
class Means:
    """Means over the transects of each marked pixel.

    value, coverage : mean radiance on film [W/mm²/sr], share of lines of sight that meet a glowing surface
    plain : `value` without correction of the weights of the nodes along the transects
    jumps : True where a transect crosses a jump
    several : True where a share of the transects, `SEVERAL_SHARE`, crosses more than one
    scatter : error of the value that follows from the differences between transects [W/mm²/sr]
    blur : signed radius of the most blurred edge that a transect crosses, 0 without one [pixels]
    done : False on pixels that the deadline left out; None if there are none
    """

    value: PixelArray
    plain: PixelArray
    coverage: PixelArray
    jumps: Mask
    several: Mask
    scatter: PixelArray
    blur: PixelArray
    done: Mask | None = None


def apply_transects(
    draft: Draft, where: Mask, edges: Edges, rule: node_rules.Transects, along: node_rules.AlongTransect
) -> Means:
    """Means over all transects of a rule at the marked pixels, 0 elsewhere."""
    index, table = draft.grid.pixels(where), Table(rule.columns)
    found = _OfPixels(**{field.name: draft.grid.full(mi.Float64, 0) for field in fields(_OfPixels)})
    rays = count = 0
    for part in batches(index, len(rule), draft.progress.batch):
        if count and draft.progress.deadline.passed():
            break
        each = _along_transects(draft, part, edges, rule, table, along)
        of_part = _over_transects(part, edges, rule, table, each)
        for field in fields(_OfPixels):
            dr.scatter(getattr(found, field.name), getattr(of_part, field.name), part)
        dr.eval(found)
        rays += int(dr.sum(each.rays)[0])
        count += dr.width(part)
    touched = dr.gather(mi.UInt32, index, dr.arange(mi.UInt32, count))
    draft.count(f"{len(rule)} transects", touched, rays)
    done = None
    if count < dr.width(index):
        done = draft.grid.full(mi.Bool, False)
        dr.scatter(done, mi.Bool(True), touched)
    number, estimator = dr.opaque(mi.Float64, len(rule)), draft.estimator
    variance = found.squares - found.value * found.value
    scatter = dr.opaque(mi.Float64, estimator.scatter * rule.relative_scatter)
    blurred = scatter * dr.safe_sqrt(variance - found.trend) / number
    # A sharp edge slants: each transect crosses a part of its own. A second edge may lie between two of them.
    slant = estimator.slant * dr.safe_sqrt(variance) / (number * dr.sqrt(number))
    sharp = dr.maximum(slant, found.between)
    return Means(
        found.value,
        found.plain,
        found.coverage,
        jumps=found.split > 0,
        several=found.several >= SEVERAL_SHARE * number,
        scatter=dr.select(edges.sharp, sharp, blurred),
        blur=found.blur,
        done=done,
    )


@dataclass
class _OfTransects:
    """Results of each transect of some pixels, those of a pixel one after the other.

    value, coverage : means along the transect;  plain : that of the value without correction of the nodes' weights
    jumps : their number;  rays : number of lines of sight
    blur : signed blur radius of the edge at the largest jump, 0 without one [pixels]
    """

    value: mi.Float
    plain: mi.Float
    coverage: mi.Float
    jumps: mi.UInt32
    blur: mi.Float
    rays: mi.UInt32


@dataclass
class _OfPixels:
    """Results over the transects of each pixel.

    value, plain, coverage, squares : means of the value, of the plain one, of the coverage and of the squared value
    trend : sum of the squared trends of the value
    split, several : number of transects with a jump, and with more than one
    blur : signed radius of the most blurred edge [pixels]
    between : error of a second edge between two transects, see `_second_edge`
    """

    value: mi.Float64
    plain: mi.Float64
    coverage: mi.Float64
    squares: mi.Float64
    trend: mi.Float64
    split: mi.Float64
    several: mi.Float64
    blur: mi.Float64
    between: mi.Float64


def _along_transects(
    draft: Draft,
    part: mi.UInt32,
    edges: Edges,
    rule: node_rules.Transects,
    table: Table,
    along: node_rules.AlongTransect,
) -> _OfTransects:
    """Each transect of the pixels `part`."""
    count = dr.opaque(mi.UInt32, len(rule))
    lane = dr.arange(mi.UInt32, dr.width(part) * len(rule))
    pixel, number = dr.gather(mi.UInt32, part, lane // count), lane % count
    angle, blur = (mi.Float(dr.gather(mi.Float64, image, pixel)) for image in (edges.angle, edges.blur))
    sharp = dr.gather(mi.Bool, edges.sharp, pixel)
    place = mi.Point3f(*(table.gather_either(sharp, f"sharp{k}", f"blurred{k}", number) for k in range(3)))
    phase = table.gather("phase", number)
    curve = transect(draft.centres(pixel), angle, blur, place, dr.opaque(mi.Float, float(draft.area)))
    outline = mi.Float(2 * draft.at_least_peak(dr.max(draft.value)))
    least, steep = mi.Float(LEAST_JUMP * draft.tolerance), draft.estimator.steep
    dr.eval(outline, least)  # what they are computed from would tell the kernels of two levels apart
    seen = integrate_transect(draft.view, curve, phase, along, outline, least, steep)
    value, plain, coverage, jumps, depth, rays = seen
    # The edge of a weak reflection beside nothing has no depth.
    has_depth = (jumps > 0) & dr.isfinite(depth)
    blur = mi.Float(dr.select(has_depth, draft.camera.blur_radius(mi.Float64(dr.minimum(depth, FAR))), 0))
    found = _OfTransects(value, plain, coverage, jumps, blur, rays)
    dr.eval(found)  # together, as a later reduction of one of them would trace every ray again
    return found


def _over_transects(
    part: mi.UInt32,
    edges: Edges,
    rule: node_rules.Transects,
    table: Table,
    found: _OfTransects,
) -> _OfPixels:
    """Results over the transects of each pixel of `part`, from those of all its transects."""
    count = dr.opaque(mi.UInt32, len(rule))
    first = dr.arange(mi.UInt32, dr.width(part)) * count
    sharp, even = dr.gather(mi.Bool, edges.sharp, part), dr.opaque(mi.Float, 1 / len(rule))

    def add(k: mi.UInt32, sums: dict[str, PixelArray], trends: list[PixelArray], blurs: tuple) -> tuple:
        value, plain, coverage, blur = (
            dr.gather(mi.Float, of, first + k) for of in (found.value, found.plain, found.coverage, found.blur)
        )
        weight = mi.Float64(dr.select(sharp, even, table.gather("weight", k)))
        share, jumps = weight * mi.Float64(value), dr.gather(mi.UInt32, found.jumps, first + k)
        terms = {
            "value": share,
            "plain": weight * mi.Float64(plain),
            "coverage": weight * mi.Float64(coverage),
            "squares": share * mi.Float64(value),
            "split": dr.select(jumps > 0, mi.Float64(1), 0),
            "several": dr.select(jumps > 1, mi.Float64(1), 0),
        }
        sums = {name: total + terms[name] for name, total in sums.items()}
        trends = [total + share * mi.Float64(table.gather(f"trend{n}", k)) for n, total in enumerate(trends)]
        return sums, trends, (dr.maximum(blurs[0], blur), dr.minimum(blurs[1], blur))

    sums = {name: mi.Float64(0) for name in ("value", "plain", "coverage", "squares", "split", "several")}
    trends = [mi.Float64(0) for _ in range(node_rules.TRENDS)]
    sums, trends, blurs = repeat(count, add, sums, trends, (mi.Float(-dr.inf), mi.Float(dr.inf)))
    return _OfPixels(
        **sums,
        trend=sum(map(dr.square, trends)),
        blur=mi.Float64(_most_blurred(*blurs)),
        between=_second_edge(dr.width(part), rule, found.value),
    )


def _second_edge(pixels: int, rule: node_rules.Transects, value: mi.Float) -> PixelArray:
    """Error of a second edge between two transects of each pixel, from the `value` of all transects, pixel by pixel.

    In the order of transects across a sharp edge, their position along it increases, so that a second edge gives two
    second differences d that are much larger than the others. √(Σd² − 2 (Σ|d|)²/n) is then √2 times the jump, of which
    half is the error at most; it is 0 where all differences vary alike. On a net, where the edge is nearly along many
    transects, it cuts all but one of them evenly: the error is at most the largest |d| over n.
    """
    count = len(rule)
    first = dr.arange(mi.UInt32, pixels) * dr.opaque(mi.UInt32, count)

    def add(k: mi.UInt32, squares: PixelArray, sizes: PixelArray, most: PixelArray) -> tuple[PixelArray, ...]:
        before, here, after = (dr.gather(mi.Float, value, first + k + n) for n in range(3))
        size = mi.Float64(dr.abs(before - 2 * here + after))
        return squares + size * size, sizes + size, dr.maximum(most, size)

    zero = mi.Float64(0)
    squares, sizes, most = repeat(dr.opaque(mi.UInt32, count - 2), add, zero, zero, zero)
    jumps = 0.5 * dr.safe_sqrt(squares - dr.opaque(mi.Float64, 2 / count) * sizes * sizes)
    return (dr.minimum(jumps, most) if rule.is_net else jumps) / dr.opaque(mi.Float64, count)
