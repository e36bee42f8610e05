"""Large pictures by blocks of pixels: where the picture is smooth over several of them, few blocks say it all.

The pupil form gives the power on square blocks of pixels, as on a film of larger pixels. Where it is smooth over five
blocks a polynomial of fourth degree along each axis has their powers as its integrals, so that the power on a block is
kept, and gives that on its pixels. Blocks with an edge, and those on which single pixels contradict, are solved pixel
by pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..jit.block_grid import BlockGrid
from ..jit.mesh_buffers import box_of
from ..jit.pixel_grid import COVERAGE_ROUNDING, parted
from . import node_rules
from .draft import Draft
from .eq9 import View
from .node_sums import apply_rule
from .nodes import BOTH, first_nodes, twelve_nodes
from .progress import SILENT, Progress
from .pupil_form import refine
from .quadrature import FLOAT32_FLOOR, Quadrature
from .shortcuts import Finding
from .solution import Solution
from .transects import integrate_by_transects
from .window import Window

# Pixels along a block, with the smallest rtol for which so large ones pay; blocks along a picture's shorter side.
SIDES, FEWEST = ((8, 3e-3), (4, 0.0)), 96
MARGIN = 2  # blocks around those that are wanted, from which the polynomials of these follow
REFINED = 0.5  # of rtol: asked of blocks; what is left is for what lies between them
BLURRED = 1.5  # blocks: blur radius from which on no edge is narrower than a block
AROUND = 2  # blocks around those that are solved by pixels
LEVELS = 4  # of transects on blocks; where more are needed pixels take them
SMALL = 4.0  # blocks: a body that is smaller may have its edges within single blocks
# Of the change from polynomials over three blocks to those over five, on a block and its neighbours: on blurred edges
# and corners, whose pictures have kinks at the rim of the blur disc, up to 3.1 times as much is left for blur radii
# from 1.5 to 16 blocks.
BEND_GAIN = 3.2
MOST = 0.5  # of the blocks: where more are to be solved by pixels all are
STREAM = 0x9E3779B9  # of the random pixels that are tried

Plane = NDArray[np.float64]
Marks = NDArray[np.bool_]


@dataclass(frozen=True)
class Blocks:
    """Blocks of `side`² pixels over a window and `MARGIN` blocks around it.

    lens : the same lens before a film of such blocks
    coarse : window of blocks on that film
    fine : window of all their pixels on the film itself
    """

    side: int
    lens: mi.Sensor
    coarse: Window
    fine: Window

    @classmethod
    def of(cls, window: Window, lens: mi.Sensor, rtol: float) -> Blocks | None:
        """The largest blocks that a window has enough of; None where it is too small, or its film has an odd side."""
        size = [int(n) for n in lens.film().size()]
        fits = [side for side, least in SIDES if rtol >= least and min(window.shape) >= side * FEWEST]
        if not fits or any(n % 2 for n in size):
            return None
        side, (left, top) = fits[0], window.corner
        # Both films have the optical axis in the middle; pixels before the first of the film fill up its first block.
        before = [(side * 2 * math.ceil(n / (2 * side)) - n) // 2 for n in size]
        first = [(k + b) // side - MARGIN for k, b in zip((left, top), before, strict=True)]
        last = [
            math.ceil((k + n + b) / side) + MARGIN
            for k, n, b in zip((left, top), window.shape[::-1], before, strict=True)
        ]
        width, height = (end - start for start, end in zip(first, last, strict=True))
        inner = (height - 2 * MARGIN, width - 2 * MARGIN)
        offset = (first[0] + MARGIN, first[1] + MARGIN)
        coarse = Window(-MARGIN, -MARGIN, (height, width), inner, offset, window.blur / side)
        x, y = (side * start - b for start, b in zip(first, before, strict=True))
        fine = replace(
            window,
            top=y - window.crop_offset[1],
            left=x - window.crop_offset[0],
            shape=(side * height, side * width),
        )
        return cls(side, lens.coarser(side), coarse, fine)


def solve(
    view: View,
    blocks: Blocks,
    quadrature: Quadrature,
    spots: Marks,
    least_peak: float = 0.0,
    progress: Progress = SILENT,
) -> Solution | None:
    """As `pupil_form.solve`, with values between blocks interpolated; None where most blocks have an edge.

    spots : blocks (h, w) with light too narrow for lines of sight
    """
    picture = _Picture(view, blocks, quadrature, spots, least_peak, progress)
    rough = picture.rough()
    share = np.count_nonzero(rough) / rough.size
    if share > MOST:
        return None
    return picture.solution(rough)


class _Picture:
    """The picture on blocks: `value` [W/mm²/sr], `error`, `coverage` (h, w), and `edge`, where it may jump."""

    def __init__(
        self,
        view: View,
        blocks: Blocks,
        quadrature: Quadrature,
        spots: Marks,
        least_peak: float,
        progress: Progress,
    ) -> None:
        self.view, self.blocks, self.quadrature = view, blocks, quadrature
        coarse = replace(quadrature, rtol=max(REFINED * quadrature.rtol, FLOAT32_FLOOR))
        seen = replace(view, lens=blocks.lens, detail=view.detail * blocks.side**2)
        draft = Draft(seen, blocks.coarse, coarse, None, least_peak, progress.part(0, 2))
        blurred = _refine_blurred(draft)
        images = [draft.grid.array(image) for image in draft.images()]
        self.value, self.error = (image / blocks.lens.etendue for image in images[:2])
        self.coverage = images[2]
        edge = (draft.outline | parted(draft.coverage)) & ~blurred
        self.edge = _spread(draft.grid.array(edge), 1) | spots | _small_bodies(seen, blocks.coarse)
        self.peak = max(float(draft.peak[0]), least_peak)
        self.tolerance = quadrature.rtol * self.peak
        self.rays, self.levels, self.findings = draft.rays, draft.levels, draft.findings
        self.progress = progress
        self.bent = BEND_GAIN * _bend(self.value, blocks.side)

    def rough(self) -> Marks:
        """Blocks (h, w) that are to be solved by pixels, after single pixels of the others have been tried."""
        # Near blurred edges four lines of sight prove nothing.
        whole = -_spread(-self.coverage, 1) > 1 - COVERAGE_ROUNDING
        rough = self._beyond()
        number = np.flatnonzero(whole & ~rough)
        if number.size:
            off, edge = self._tried(number)
            there = np.zeros(rough.shape)
            there.ravel()[number] = off
            self.bent = np.maximum(self.bent, _spread(there, 1))
            marks = np.zeros(rough.shape, bool)
            marks.ravel()[number] = edge
            self.edge |= _spread(marks, 1)
            rough = self._beyond()
        return rough & self._wanted()

    def _beyond(self) -> Marks:
        """Blocks with an edge, or with more than the tolerance left."""
        return self.edge | (self._left() > self.tolerance)

    def _left(self) -> Plane:
        """What pixels of each block may be wrong by, (h, w): errors of blocks near by, and of the interpolation."""
        return _propagated(self.error, self.blocks.side) + self.bent

    def _wanted(self) -> Marks:
        """Blocks (h, w) with a pixel of the crop window, or of the rim that estimates need."""
        wanted = np.zeros(self.value.shape, bool)
        wanted[MARGIN - 1 : 1 - MARGIN, MARGIN - 1 : 1 - MARGIN] = True
        return wanted

    def _tried(self, number: NDArray[np.int64]) -> tuple[Plane, Marks]:
        """On one random pixel of each of these blocks: how far it is from the interpolated value; whether it has an
        edge that the block does not show.
        """
        side, width = self.blocks.side, self.value.shape[1]
        row, column = np.divmod(number, width)
        random = mi.sample_tea_32(mi.UInt32(number), mi.UInt32(STREAM & 0xFFFFFFFF))
        i, j = (np.asarray(r.numpy() % side).astype(np.int64) for r in random)
        place = (row * side + i) * (width * side) + column * side + j
        centres = self.blocks.fine.centres(mi.UInt32(place.astype(np.uint32)))
        seen = apply_rule(self.view, centres, node_rules.four(True), ("value", "coverage"))
        dr.eval(seen.value, seen.coverage)
        self.rays += 4 * number.size
        self.levels.append(f"4 nodes: {number.size} pixels")
        weights = part_weights(side, MARGIN)
        around = sliding_window_view(np.pad(self.value, MARGIN, mode="edge"), (2 * MARGIN + 1,) * 2)[row, column]
        found = np.einsum("na,nab,nb->n", weights[i], around, weights[j], optimize=True)
        return np.abs(found - seen.value.numpy()), seen.coverage.numpy() < 1 - COVERAGE_ROUNDING

    def solution(self, rough: Marks) -> Solution:
        """The picture with the `rough` blocks solved by pixels."""
        side, etendue = self.blocks.side, self.view.lens.etendue
        count = int(np.count_nonzero(rough))
        why = f"{rough.size - count} of {rough.size} blocks of {side}² pixels are smooth"
        weights = part_weights(side, MARGIN)
        value = np.maximum(means_of_parts(self.value * etendue, weights), 0)
        inside = (self.coverage > COVERAGE_ROUNDING) & (self.coverage < 1 - COVERAGE_ROUNDING) & ~rough
        coverage = _repeated(self.coverage, side)
        if inside.any():
            coverage = np.clip(means_of_parts(self.coverage, weights), 0, 1)
        least = np.where(_spread(self.coverage, MARGIN) > 0, self.quadrature.least_error * self.peak, 0)
        error = _repeated(np.maximum(self._left(), least) * etendue, side)
        planes = (value, error, coverage)
        levels = [f"blocks: {level}" for level in self.levels]
        findings = [Finding("smooth blocks", True, why)]
        rays = self.rays
        if count:
            # Blocks around show which way an edge runs and whether one passes near by; their values stay.
            grid = BlockGrid(_spread(rough, AROUND), side)
            progress = self.progress.part(1, 2)
            draft = Draft(self.view, self.blocks.fine, self.quadrature, None, self.peak, progress, grid)
            own = _repeated(rough, side)
            draft.open, draft.known = grid.flat(own), grid.flat(value / etendue)
            refine(draft, np.broadcast_to(0.0, grid.shape))
            for plane, image in zip(planes, draft.images(), strict=True):
                grid.lay(dr.select(draft.open, image, grid.flat(plane)), plane)
            rays, levels = rays + draft.rays, levels + draft.levels
            findings += draft.findings
        else:
            findings += self.findings
        self.progress(1.0)
        whole = (self.blocks.fine.expand(plane) for plane in planes)
        return Solution(*whole, rays, tuple(levels), findings=tuple(findings))


def _refine_blurred(draft: Draft) -> mi.Bool:
    """Refine the blocks of a draft without an edge narrower than a block; returns which those are."""
    rough = first_nodes(draft, np.zeros(draft.grid.shape))
    least = draft.grid.spread_max(-draft.least_blur)
    blurred = -least >= dr.opaque(mi.Float64, BLURRED)
    quadrature = draft.quadrature
    levels = node_rules.transect_levels(quadrature.rtol, draft.area, quadrature.max_nodes - BOTH)[:LEVELS]
    rough = twelve_nodes(draft, rough, transects_follow=bool(levels)) & blurred
    if levels and dr.any(rough):
        integrate_by_transects(draft, rough, levels)
    return blurred


def _small_bodies(view: View, window: Window) -> Marks:
    """Blocks (h, w) that light of bodies smaller than `SMALL` blocks may cross."""
    shapes = [box_of([shape]) for shape in view.scene.shapes()]
    ends = np.array([[box.min, box.max] for box in shapes], np.float64).reshape(-1, 2, 3)
    corners = np.stack([ends[:, (k >> np.arange(3)) & 1, np.arange(3)] for k in range(8)], axis=1)
    centre, blur = view.lens.film_discs(corners)
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


def part_weights(side: int, reach: int) -> Plane:
    """Means over parts of the middle of 2 reach + 1 cells, (side, cells), of the polynomial with these cells' means.

    The integral of the polynomial interpolates the sums of the cells at their ends.
    """
    ends = np.arange(2 * reach + 2) - reach - 0.5
    parts = np.arange(side + 1) / side - 0.5
    # Lagrange's polynomials of the ends, at the ends of the parts.
    factor = [np.prod([(parts - other) / (end - other) for other in ends if other != end], axis=0) for end in ends]
    lagrange = np.array(factor).T  # (side + 1, ends)
    sums = np.tril(np.ones((2 * reach + 2, 2 * reach + 1)), -1)
    return np.diff(lagrange @ sums, axis=0) * side


def means_of_parts(cells: Plane, weights: Plane) -> Plane:
    """Means of parts of cells (h, w) by `weights` (parts, cells) along each axis: (parts h, parts w)."""
    reach = weights.shape[1] // 2
    for _ in range(2):  # along the columns of the transposed, then of the original
        around = sliding_window_view(np.pad(cells.T, ((0, 0), (reach, reach)), mode="edge").T, 2 * reach + 1, axis=0)
        cells = np.einsum("sk,hwk->hsw", weights, around, optimize=True).reshape(-1, cells.shape[1]).T
    return np.ascontiguousarray(cells)


def _propagated(errors: Plane, side: int) -> Plane:
    """Error of the parts of each cell, (h, w), that follows from independent errors of cells (h, w)."""
    share = np.square(part_weights(side, MARGIN)).max(axis=0)
    square = np.square(errors)
    for axis in (0, 1):
        pad = [(MARGIN, MARGIN) if k == axis else (0, 0) for k in (0, 1)]
        square = sliding_window_view(np.pad(square, pad, mode="edge"), 2 * MARGIN + 1, axis=axis) @ share
    return np.sqrt(square)


def _bend(cells: Plane, side: int) -> Plane:
    """Largest change of a part of each cell and its neighbours from polynomials over three cells to five, (h, w)."""
    parts = [0, side // 2, side - 1]  # corners, where it is largest, and the middle
    five, three = (means_of_parts(cells, part_weights(side, reach)[parts]) for reach in (MARGIN, MARGIN - 1))
    height, width = cells.shape
    change = np.abs(five - three).reshape(height, len(parts), width, len(parts)).max(axis=(1, 3))
    return _spread(change, 1)


def _spread(image: NDArray, reach: int) -> NDArray:
    """Largest value within `reach` cells (square) of each cell."""
    for axis in (0, 1):
        pad = [(reach, reach) if k == axis else (0, 0) for k in (0, 1)]
        image = sliding_window_view(np.pad(image, pad, mode="edge"), 2 * reach + 1, axis=axis).max(axis=-1)
    return image


def _repeated(cells: NDArray, side: int) -> NDArray:
    """Each cell's value on all its parts."""
    return np.repeat(np.repeat(cells, side, axis=1), side, axis=0)
