"""Tiles: parts of a large image of Eq. 9, solved one after the other, so that the memory for work is that of one part.

Each tile is solved with a rim of neighbours that estimates need, as a crop window is, and all to the same tolerance.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera.window import Window
from ..jit.pixel_grid import Grid
from ..runtime.errors import SceneError
from ..runtime.memory import available_memory
from .shortcuts import Finding
from .solution import Solution
from .surface.pixel_sums import memory_of

SIDE = 2048  # pixels along a tile with its rim; Dr.Jit allocates powers of two
LARGE = 1 << 26  # pixels: the planes of a larger image are of float32, as they are in its file
# Beside the planes: bytes that the work on one tile takes, sums by faces apart; then a pixel, that checks and the file
# take, and that copies of planes of float64 in float32 take, by the bytes of a value.
WORK, WRITING = 1 << 30, {4: 2, 8: 14}
REACH = 2  # pixels around that the error of a displacement depends on
COUNT = re.compile(r"\b\d+\b")


def tiles_of(window: Window) -> list[Window]:
    """Parts of a window, each with its rim, that together show all pixels that it shows; none if it is empty."""
    sides = (window.top, window.left)
    rows, columns = (
        range(first + part.start, first + part.stop) for first, part in zip(sides, window.inner, strict=True)
    )
    if len(rows) * len(columns) <= SIDE**2:
        return [window.tile(rows, columns)] if rows and columns else []
    most = SIDE - 2 * window.rim
    return [window.tile(*sides) for sides in itertools.product(_split(rows, most), _split(columns, most))]


def _split(side: range, most: int) -> list[range]:
    """As few equal parts as have `most` pixels at most."""
    count = math.ceil(len(side) / most)
    ends = [side.start + len(side) * k // count for k in range(count + 1)]
    return [range(*pair) for pair in itertools.pairwise(ends)]


class Mosaic:
    """Image of the crop window of `window`, put together from the solutions of its tiles.

    Raises SceneError where the memory does not suffice for it.
    """

    def __init__(self, window: Window) -> None:
        self.window, self.tiles = window, tiles_of(window)
        kind = np.dtype(np.float64 if math.prod(window.full) <= LARGE else np.float32)
        _require_memory(window.full, kind.itemsize)
        self.power, self.error, self.coverage = (np.zeros(window.full, kind) for _ in range(3))
        self._rays = 0
        self._levels: list[str] = []
        self._findings: list[Finding] = []

    def put(self, tile: Window, part: Solution) -> None:
        """Lay the solution of a tile at its place."""
        here = self._place(tile)
        self.power[here], self.error[here], self.coverage[here] = part.power, part.error, part.coverage
        self._rays += part.rays
        self._levels += part.levels
        self._findings += part.findings

    def solution(self, least_error: float, rounding: float) -> Solution:
        """The whole image.

        least_error : smallest error that is stated, over the brightest pixel
        rounding : by which float32 displaces lines of sight [pixels], 0 where that does not count
        """
        levels, findings = tuple(self._levels), tuple(self._findings)
        if len(self.tiles) > 1:
            self._level_errors(least_error)
            levels, findings = _added_levels(levels), _common_findings(findings)
        if rounding:
            for here in map(self._place, self.tiles):
                self.error[here] += rounding * self._steepest_on(here)
        return Solution(self.power, self.error, self.coverage, self._rays, levels, findings=findings)

    def _place(self, tile: Window) -> tuple[slice, slice]:
        """Rows and columns of a tile in the crop window."""
        left, top = (its - own for its, own in zip(tile.crop_offset, self.window.crop_offset, strict=True))
        return slice(top, top + tile.full[0]), slice(left, left + tile.full[1])

    def _level_errors(self, least_error: float) -> None:
        """Raise the errors to the least one that follows from the whole image; parameters as of `solution`."""
        least = least_error * float(self.power.max(initial=0.0))
        for tile in self.tiles:
            here = self._place(tile)
            error = self.error[here]
            np.maximum(error, least, out=error, where=self.coverage[here] > 0)

    def _steepest_on(self, here: tuple[slice, slice]) -> NDArray[np.float64]:
        """`_steepest` on a tile, with the pixels around it."""
        first = [max(0, side.start - REACH) for side in here]
        around = tuple(slice(start, side.stop + REACH) for start, side in zip(first, here, strict=True))
        steepest = _steepest(self.power[around].astype(np.float64, copy=False))
        return steepest[tuple(slice(side.start - k, side.stop - k) for k, side in zip(first, here, strict=True))]


def _steepest(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest gradient [W/pixel] of the power (h, w) on each pixel and its neighbours."""
    grid = Grid(power.shape)
    x, y = grid.gradient(grid.flat(power))
    return grid.array(grid.spread_max(dr.sqrt(x * x + y * y)))


def _require_memory(full: tuple[int, int], size: int) -> None:
    """Raise SceneError where three planes with values of `size` bytes, and the work or the writing, do not fit."""
    pixels = math.prod(full)
    needed = pixels * 3 * size + max(WORK + memory_of(2 * SIDE**2), pixels * WRITING[size])
    free = available_memory() if pixels > SIDE**2 else None
    if free is not None and needed > free:
        height, width = full
        raise SceneError(
            f"fspt_integral: a film of {width} x {height} pixels needs {needed} bytes ({needed / 2**30:.1f} GiB) of "
            f"memory, {free} are free. Give a smaller film, or render it in parts by its crop window."
        )


def _added_levels(levels: Sequence[str]) -> tuple[str, ...]:
    """`Solution.levels` of all tiles together: pixels and lines of sight of each step are added up."""
    steps: dict[str, list[str]] = {}
    for text in levels:
        steps.setdefault(text.partition(":")[0], []).append(text.partition(":")[2])
    return tuple(f"{step}:{_added(counts)}" for step, counts in steps.items())


def _common_findings(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """For each shortcut whether any tile took it, with the reason of the first that did, else of the first tile."""
    shortcuts: dict[str, list[Finding]] = {}
    for finding in findings:
        shortcuts.setdefault(finding.name, []).append(finding)
    common = []
    for name, some in shortcuts.items():
        first = next((finding for finding in some if finding.taken), some[0])
        why = _added([finding.why for finding in some]) if name == "smooth" else first.why  # that counts pixels
        common.append(Finding(name, first.taken, why))
    return tuple(common)


def _added(texts: Sequence[str]) -> str:
    """A text with the sums of the whole numbers in these texts, which differ in them alone."""
    sums = iter(np.sum([[int(count) for count in COUNT.findall(text)] for text in texts], axis=0).tolist())
    return COUNT.sub(lambda _: str(next(sums)), texts[0])
