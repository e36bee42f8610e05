"""Large images by blocks of pixels, between which a smooth image is interpolated.

The pupil form (M.5) gives the power on square blocks of pixels, as on a film of larger pixels. The polynomial of fourth
degree along each axis whose integrals over five blocks are their powers gives the power on the parts of the middle
one; it keeps the power on the block. Blocks with an edge, and those on which the estimated error of the interpolation
or the difference to a single pixel exceeds the tolerance, are divided into smaller ones, down to pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, reduce

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window
from ...jit.block_grid import BlockGrid
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import box_of
from ...jit.pixel_grid import COVERAGE_ROUNDING, Grid, parted
from ..lines.eq9 import View
from ..progress import SILENT, Progress
from ..quadrature import FLOAT32_FLOOR, Quadrature
from ..shortcuts import Finding
from ..solution import Solution
from . import node_rules
from .draft import Draft
from .node_sums import apply_rule
from .nodes import BOTH, first_nodes, twelve_nodes
from .pupil_form import refine
from .seen_points import Unseen
from .transects import edges_of, integrate_by_transects

# Pixels along the largest blocks; fewest blocks along the shorter side of an image for which blocks save time.
SIDES, FEWEST = (8, 4), 128
REACH = 2  # blocks on either side of one that its polynomial depends on
MARGIN = 3  # blocks around the crop window that polynomials and their error estimates depend on
REFINED = 0.5  # of rtol: tolerance of blocks; the rest is for the interpolation
BLURRED = 1.5  # blocks: least blur radius at which an edge is interpolated
LEVELS = 4  # of transects on blocks; where more are needed, blocks are divided
SMALL = 4.0  # blocks: the image of a smaller body may lie within single blocks
# Error of the interpolation over the change from polynomials over five blocks to those over seven, on a block and its
# neighbours: at most 9.2 on blurred edges and corners, whose images have kinks at the rim of the blur disc, 11.9 in the
# middles of pixels, for blur radii from 1.5 to 16 blocks.
BEND_GAIN = {"area": 9.2, "centre": 12.0}
MOST = 0.5  # share of the blocks: where more are to be divided into pixels all pixels are computed
COST = 2.0  # pixels that take as many lines of sight as a block, whose tolerance is smaller
RIM_ORDER = 1.5  # power of the block's side by which the error falls at the rim of a blur disc
# Error over the largest difference to nine pixels, one of a block and of each neighbour: independent normal ones
# exceed it on one pixel of 600.
TRIED_GAIN = 2.5
STREAM = 0x9E3779B9  # seed of the random pixels that are compared
AT_ONCE = 1 << 16  # blocks whose neighbours are gathered together: 26 MB

Plane = NDArray[np.float64]
Marks = NDArray[np.bool_]


@dataclass(frozen=True)
class Blocks:
    """Blocks of `side`² pixels over a window and `MARGIN` of the largest blocks around it.

    camera : the same camera with a film of such blocks
    window : of all blocks on that film, on which it may begin between two of its pixels
    """

    side: int
    camera: Camera
    window: Window

    def __str__(self) -> str:
        return f"blocks of {self.side}² pixels" if self.side > 1 else "pixels"


def blocks_of(window: Window, camera: Camera) -> tuple[Blocks, ...]:
    """The largest blocks of which a window has `FEWEST`, then their halves down to pixels; none for a small window."""
    largest = next((side for side in SIDES if min(window.shape) >= side * FEWEST), 0)
    if not largest:
        return ()
    blocks = tuple(math.ceil(n / largest) for n in window.shape)
    left, top = (n - MARGIN * largest for n in window.corner)
    found, side = [], largest
    while side > 1:
        coarser, times = camera.coarser(side), largest // side
        # The optical axis is in the middle of both films.
        places = zip((left, top), camera.film.size, coarser.film.size, strict=True)
        offset = tuple((n - own / 2) / side + its / 2 + MARGIN * times for n, own, its in places)
        inner, shape = (tuple(times * (n + more) for n in blocks) for more in (0, 2 * MARGIN))
        whole = Window(-MARGIN * times, -MARGIN * times, shape, inner, offset, window.blur / side)
        found.append(Blocks(side, coarser, whole))
        side //= 2
    left, top = (n - its for n, its in zip((left, top), window.crop_offset, strict=True))
    shape = tuple(largest * (n + 2 * MARGIN) for n in blocks)
    return (*found, Blocks(1, camera, replace(window, top=top, left=left, shape=shape)))


def solve(
    view: View,
    blocks: tuple[Blocks, ...],
    quadrature: Quadrature,
    find_unseen: Callable[[Blocks], Unseen],
    least_peak: float = 0.0,
    progress: Progress = SILENT,
) -> Solution | None:
    """As `pupil_form.solve`, with values between blocks interpolated; None if most blocks are divided into pixels.

    find_unseen : gives light and shade that lines of sight may miss on blocks
    """
    image = _BlockImage(view, blocks, quadrature, find_unseen, least_peak)
    while image.own.any():
        image.compute(progress)
        if image.blocks.side == 1:
            break
        rough = image.rough()
        smaller = image.smaller(rough)
        if smaller.side == 1 and np.count_nonzero(rough) > MOST * rough.size:
            return None
        image.part(rough, smaller)
    progress(1.0)
    return image.solution()


class _BlockImage:
    """Image on blocks (h, w): `value` [W/mm²/sr], its `error` and `coverage`.

    blocks, own : the present size; True where blocks are computed, False where larger ones gave their value
    edge : True for blocks on which the image may jump
    narrow : True for blocks on which dark bodies, or openings between them, are narrow for a block, or J_n varies
        within it
    blur : least blur radius of an edge on a block or a neighbour [pixels]
    draft, refined : image of the present blocks in the pupil form; True where transects were taken
    passed_on : error of the pixels of a block that follows from the errors of the blocks around [W/mm²/sr]
    bent : estimated error of the interpolation on the pixels of a block [W/mm²/sr]
    peak : lower bound of the brightest block or pixel [W/mm²/sr]
    tolerance : rtol times `peak` [W/mm²/sr]
    """

    def __init__(
        self,
        view: View,
        sizes: tuple[Blocks, ...],
        quadrature: Quadrature,
        find_unseen: Callable[[Blocks], Unseen],
        least_peak: float,
    ) -> None:
        self.find_unseen = find_unseen
        self.view, self.sizes, self.quadrature, self.peak = view, sizes, quadrature, least_peak
        self.blocks, shape = sizes[0], sizes[0].window.shape
        self.grid, self.own = Grid(shape), np.ones(shape, bool)
        self.value, self.error, self.coverage = (np.zeros(shape) for _ in range(3))
        self.rays, self.levels, self.shares = 0, [], []
        self.findings: list[Finding] = []

    def compute(self, progress: Progress) -> None:
        """Compute the blocks of the present size that are not interpolated from larger ones."""
        blocks, grid = self.blocks, self.grid
        progress = progress.part(self.sizes.index(blocks), len(self.sizes))
        draft = Draft(self._seen(), blocks.window, self._quadrature(), None, self.peak, progress, grid)
        draft.computed, draft.given = grid.flat(self.own), grid.flat(self.value)
        unseen = self.find_unseen(blocks)
        draft.set_surfaces(unseen.straight)
        draft.set_dark(unseen.dark)
        self.edge, self.blur = np.zeros(self.own.shape, bool), np.zeros(self.own.shape)
        if blocks.side > 1:
            blur, self.refined = _refine_blurred(draft)
            grid.lay((blur < BLURRED) & (draft.outline | parted(draft.coverage)), self.edge)
            grid.lay(blur * blocks.side, self.blur)
            self.narrow = np.zeros(self.own.shape, bool)
            grid.lay(draft.in_doubt() | draft.varied(), self.narrow)
        else:
            refine(draft, np.broadcast_to(0.0, grid.shape))
        power, error, coverage = draft.images()
        images = (power / blocks.camera.etendue, error / blocks.camera.etendue, coverage)
        for plane, image in zip((self.value, self.error, self.coverage), images, strict=True):
            grid.lay(dr.select(draft.computed, image, grid.flat(plane)), plane)
        if self.own.all():
            # Blocks with a sharp edge are not refined: their error may be large.
            certain = float(dr.max(dr.select(draft.shown, draft.value - draft.error, 0))[0])
            self.peak = max(self.peak, certain) or float(draft.peak[0])
            self.tolerance = self.quadrature.rtol * self.peak
        self.shares.append(f"{np.count_nonzero(self.own)} {blocks}")
        self.rays += draft.rays
        self.levels += [f"{blocks}, {level}" if blocks.side > 1 else level for level in draft.levels]
        self.findings, self.draft = draft.findings, draft

    def _seen(self) -> View:
        """View of the lens before a film of such blocks."""
        return replace(self.view, camera=self.blocks.camera, detail=self.view.detail * self.blocks.side**2)

    def _quadrature(self) -> Quadrature:
        """Accuracy of the blocks, or of pixels."""
        if self.blocks.side == 1:
            return self.quadrature
        return replace(self.quadrature, rtol=max(REFINED * self.quadrature.rtol, FLOAT32_FLOOR), pixel="area")

    def rough(self) -> Marks:
        """Blocks (h, w) to be divided, after a comparison of single pixels on the others.

        The errors of the others become those of their pixels.
        """
        self.edge = _spread(self.edge, 1) | _small_bodies(self._seen(), self.blocks.window) | self.narrow
        pixel = self.quadrature.pixel
        self.bent = BEND_GAIN[pixel] * _bend(self.value, self.blocks.side, pixel, self.own)
        self.passed_on = _propagated(self.error, self.blocks.side, pixel)
        # Near blurred edges four lines of sight are too few for a comparison.
        refined = np.zeros(self.own.shape, bool)
        self.grid.lay(self.refined, refined)
        whole = (-_spread(-self.coverage, 1) > 1 - COVERAGE_ROUNDING) & ~refined
        compared = self.grid.flat(whole & ~self._beyond() & self.own)  # in the order in which rays are traced fastest
        number = self.grid.place(self.grid.pixels(compared)).numpy().astype(np.int64)
        if number.size:
            off, edge = np.zeros(whole.shape), np.zeros(whole.shape, bool)
            off.ravel()[number], edge.ravel()[number] = self._compared(number)
            self.bent = np.maximum(self.bent, TRIED_GAIN * _spread(off, 1))
            self.edge |= _spread(edge, 1)
        rough = self._beyond() & self.own
        if self.own.all():  # except blocks farther from the crop window than estimates reach
            rough &= np.pad(np.ones([n - 2 * MARGIN + 2 for n in rough.shape], bool), MARGIN - 1)
        least = np.where(_spread(self.coverage, REACH) > 0, self.quadrature.least_error * self.peak, 0)
        self.error = np.where(self.own, np.maximum(self._left(), least), self.error)
        return rough

    def _beyond(self) -> Marks:
        """Blocks with an edge, or with an error above the tolerance."""
        return self.edge | (self._left() > self.tolerance)

    def _left(self) -> Plane:
        """Error of the pixels of each block, (h, w): root of the summed squares of both contributions."""
        return np.hypot(self.passed_on, self.bent)

    def _compared(self, number: NDArray[np.int64]) -> tuple[Plane, Marks]:
        """Difference between one random pixel and the interpolated value on each of these blocks; True where the pixel
        has an edge.
        """
        side, width = self.blocks.side, self.value.shape[1]
        row, column = np.divmod(number, width)
        random = mi.sample_tea_32(from_numpy(mi.UInt32, number), mi.UInt32(STREAM & 0xFFFFFFFF))
        i, j = (np.asarray(r.numpy() % side).astype(np.int64) for r in random)
        place = (row * side + i) * (width * side) + column * side + j
        centres = self.sizes[-1].window.centres(from_numpy(mi.UInt32, place))
        seen = apply_rule(self.view, centres, node_rules.four(self.quadrature.pixel == "area"), ("value", "coverage"))
        dr.eval(seen.value, seen.coverage)
        self.rays += 4 * number.size
        self.levels.append(f"{self.blocks}, one pixel each: {number.size} pixels")
        weights = part_weights(side, REACH, self.quadrature.pixel)
        found = np.einsum("na,nab,nb->n", weights[i], _around(self.value, row, column), weights[j], optimize=True)
        return np.abs(found - seen.value.numpy()), seen.coverage.numpy() < 1 - COVERAGE_ROUNDING

    def smaller(self, rough: Marks) -> Blocks:
        """The largest smaller blocks that save more lines of sight than they take; else pixels.

        The error is taken to fall with the side as at the rim of a blur disc, by its power 3/2. Where an edge is
        narrower than a block there is no estimate of it.
        """
        left, blur = np.where(self.edge, 0, self.error)[rough], np.where(self.edge, self.blur, np.inf)[rough]
        for smaller in self.sizes:
            do = left * (smaller.side / self.blocks.side) ** RIM_ORDER <= self.tolerance
            do &= blur >= BLURRED * smaller.side
            if 1 < smaller.side < self.blocks.side and np.count_nonzero(do) * smaller.side**2 > COST * do.size:
                return smaller
        return self.sizes[-1]

    def part(self, rough: Marks, smaller: Blocks) -> None:
        """Divide into smaller blocks: parts of the `rough` ones are to be computed, the others are interpolated."""
        parts = self.blocks.side // smaller.side
        # Blocks around are evaluated for direction and reach of edges; their values stay.
        around = rough.copy()
        self.grid.lay(self.draft.grown_by_reach(self.grid.flat(rough)), around)
        self.grid = BlockGrid(around, parts) if rough.any() else None
        self.error, self.own = _repeated(self.error, parts), _repeated(rough, parts)
        weights = part_weights(parts, REACH, self.quadrature.pixel if smaller.side == 1 else "area")
        self.value = np.maximum(means_of_parts(self.value, weights), 0)
        inside = parted(self.coverage) & ~rough
        weights, around = part_weights(parts, REACH), _around(self.coverage, *np.nonzero(inside))
        coverage = _repeated(self.coverage, parts)
        by_blocks = coverage.reshape(rough.shape[0], parts, -1, parts).swapaxes(1, 2)
        by_blocks[inside] = np.clip(np.einsum("ia,nab,jb->nij", weights, around, weights, optimize=True), 0, 1)
        self.blocks, self.coverage = smaller, coverage

    def solution(self) -> Solution:
        """The image of pixels."""
        etendue, window = self.view.camera.etendue, self.sizes[-1].window
        why = f"{', '.join(self.shares)} are computed for {self.own.size} pixels"
        findings = (Finding("smooth blocks", True, why), *self.findings)
        power, error = (etendue * window.expand(image) for image in (self.value, self.error))
        coverage = window.expand(self.coverage)
        return Solution(power, error, coverage, self.rays, tuple(self.levels), findings=findings)


def _refine_blurred(draft: Draft) -> tuple[mi.Float64, mi.Bool]:
    """Refine the blocks of a draft without an edge narrower than a block.

    Where all lines of sight meet glowing surfaces, an edge is that of the nearest body and has its blur; steps of J_n
    bend the image. Returns the blur radius of the least blurred edge that may be on each block or a neighbour
    [blocks], and True where transects were taken.
    """
    rough = first_nodes(draft, np.zeros(draft.grid.shape))
    quadrature, enough = draft.quadrature, dr.opaque(mi.Float64, BLURRED)
    levels = node_rules.transect_levels(quadrature.rtol, draft.area, quadrature.most_nodes - BOTH)[:LEVELS]
    if not draft.progress.deadline.passed():
        rough = twelve_nodes(draft, rough, transects_follow=bool(levels))
    least = -draft.grid.spread_max(-draft.least_blur)
    inside = ~(draft.outline | parted(draft.coverage))
    blurred = (least >= enough) | (inside & (dr.abs(edges_of(draft).blur) >= enough))
    rough &= blurred
    if levels and dr.any(rough):
        integrate_by_transects(draft, rough, levels, among=blurred)
    return least, rough


def _small_bodies(view: View, window: Window) -> Marks:
    """Blocks (h, w) that light of bodies smaller than `SMALL` blocks may reach."""
    shapes = [box_of([shape]) for shape in view.scene.shapes()]
    ends = np.array([[box.min, box.max] for box in shapes], np.float64).reshape(-1, 2, 3)
    corners = np.stack([ends[:, (k >> np.arange(3)) & 1, np.arange(3)] for k in range(8)], axis=1)
    centre, blur = view.camera.film_discs(corners)
    low, high = centre.min(axis=1), centre.max(axis=1)
    small = ((high - low).max(axis=1) < SMALL) | ~np.isfinite(blur).all(axis=(1, 2))
    reach = np.where(np.isfinite(blur), blur, 2.0 * max(window.shape)).max(axis=1)
    size = np.array(window.shape[::-1])
    first = np.clip(np.floor(low - reach) - 1 - window.corner, 0, size).astype(int)[small]
    last = np.clip(np.ceil(high + reach) + 1 - window.corner, 0, size).astype(int)[small]
    count = np.zeros((window.shape[0] + 1, window.shape[1] + 1), np.int64)
    for x, y, sign in ((first, first, 1), (last, first, -1), (first, last, -1), (last, last, 1)):
        np.add.at(count, (y[:, 1], x[:, 0]), sign)
    return count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0


# ---------------------------------------------------------------------- polynomials over blocks


@cache
def part_weights(side: int, reach: int, pixel: str = "area") -> Plane:
    """Means over parts of the middle of 2 reach + 1 cells, (side, cells), of the polynomial with these cells' means.

    The integral of the polynomial interpolates the sums of the cells at their ends. `pixel` 'centre': its values in
    the middle of the parts.
    """
    ends = np.arange(2 * reach + 2) - reach - 0.5
    lagrange = [Polynomial.fromroots(ends[ends != end]) / np.prod(end - ends[ends != end]) for end in ends]
    sums = np.tril(np.ones((2 * reach + 2, 2 * reach + 1)), -1)
    if pixel == "centre":
        middles = (np.arange(side) + 0.5) / side - 0.5
        weights = np.array([of.deriv()(middles) for of in lagrange]).T @ sums
    else:
        parts = np.arange(side + 1) / side - 0.5
        weights = np.diff(np.array([of(parts) for of in lagrange]).T @ sums, axis=0) * side
    weights.flags.writeable = False  # as it is shared
    return weights


def means_of_parts(cells: Plane, weights: Plane) -> Plane:
    """Means of parts of cells (h, w) by `weights` (parts, cells) along each axis: (parts h, parts w)."""
    count = weights.shape[1]
    for _ in range(2):  # along the second axis, then along the first: each pass ends with the other one first
        ends = np.pad(cells.T, ((count // 2, count // 2), (0, 0)), mode="edge")
        around = sliding_window_view(ends, count, axis=0).swapaxes(1, 2)
        cells = (weights @ around).reshape(-1, ends.shape[1])
    return cells


def _around(cells: Plane, row: NDArray[np.int64], column: NDArray[np.int64], reach: int = REACH) -> Plane:
    """The cells within `reach` of each of n cells (row, column), (n, 2 reach + 1, 2 reach + 1)."""
    return sliding_window_view(np.pad(cells, reach, mode="edge"), (2 * reach + 1,) * 2)[row, column]


def _propagated(errors: Plane, side: int, pixel: str) -> Plane:
    """Error of the parts of each cell, (h, w), that follows from independent errors of cells (h, w)."""
    share = np.square(part_weights(side, REACH, pixel)).max(axis=0)
    square = np.square(errors)
    for axis in (0, 1):
        pad = [(REACH, REACH) if k == axis else (0, 0) for k in (0, 1)]
        square = sliding_window_view(np.pad(square, pad, mode="edge"), 2 * REACH + 1, axis=axis) @ share
    return np.sqrt(square)


def _bend(cells: Plane, side: int, pixel: str, on: Marks) -> Plane:
    """Largest change of a part of each cell and its neighbours from polynomials over five cells to seven, (h, w).

    It is right `on` the marked cells; their neighbours are computed for it, and no others.
    """
    parts = [0, side // 2, side - 1]  # corners, where it is largest, and the middle
    seven, five = (part_weights(side, reach, pixel)[parts] for reach in (REACH + 1, REACH))
    five = np.pad(five, ((0, 0), (1, 1)))
    weights = (np.kron(seven, seven) - np.kron(five, five)).T  # cells around, parts
    row, column = np.nonzero(_spread(on, 1))
    change = np.zeros(cells.shape)
    for k in range(0, len(row), AT_ONCE):
        some = row[k : k + AT_ONCE], column[k : k + AT_ONCE]
        around = _around(cells, *some, REACH + 1).reshape(-1, len(weights))
        change[some] = np.abs(around @ weights).max(axis=1)
    return _spread(change, 1)


def _spread(image: NDArray, reach: int) -> NDArray:
    """Largest value within `reach` cells (square) of each cell."""
    for _ in range(2):
        height, ends = image.shape[0], np.pad(image, ((reach, reach), (0, 0)), mode="edge")
        image = reduce(np.maximum, (ends[k : k + height] for k in range(2 * reach + 1))).T
    return image


def _repeated(cells: NDArray, side: int) -> NDArray:
    """Each cell's value on all its parts."""
    return np.repeat(np.repeat(cells, side, axis=1), side, axis=0)
