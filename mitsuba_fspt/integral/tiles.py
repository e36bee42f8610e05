"""Tiles: parts of a large picture, solved one after the other, so that the memory for work is that of one part.

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

from ..jit.pixel_grid import Grid
from ..runtime.errors import SceneError
from ..runtime.memory import available_memory
from .shortcuts import Finding
from .solution import Solution
from .window import Window

SIDE = 2048  # pixels along a tile with its rim; Dr.Jit allocates powers of two
LARGE = 1 << 26  # pixels: the planes of a larger picture are of float32, as they are in its file
WORK = 3 << 28  # bytes that the work on one tile takes beside the planes
WRITING = 2  # bytes a pixel that checks and the compression of the file take beside the planes
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
    """Picture of the crop window of `window`, put together from the solutions of its tiles.

    Raises SceneError where the memory does not suffice for it.
    """

    def __init__(self, window: Window) -> None:
        self.window, self.tiles = window, tiles_of(window)
        kind = np.dtype(np.float64 if math.prod(window.full) <= LARGE else np.float32)
        _require_memory(window.full, 3 * kind.itemsize)
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
        """The whole picture.

        least_error : smallest error that is stated, over the brightest pixel
        rounding : by which float32 displaces lines of sight [pixels], 0 where that does not count
        """
        least = least_error * float(self.power.max(initial=0.0))
        for tile in self.tiles:
            here = self._place(tile)
            error = self.error[here]
            if len(self.tiles) > 1:  # a tile knows its own brightest pixel alone
                np.maximum(error, least, out=error, where=self.coverage[here] > 0)
            if rounding:
                error += self._displacement_error(here, rounding)
        levels, findings = tuple(self._levels), tuple(self._findings)
        if len(self.tiles) > 1:
            levels, findings = _added_levels(levels), _common_findings(findings)
        return Solution(self.power, self.error, self.coverage, self._rays, levels, findings=findings)

    def _place(self, tile: Window) -> tuple[slice, slice]:
        """Rows and columns of a tile in the crop window."""
        left, top = (its - own for its, own in zip(tile.crop_offset, self.window.crop_offset, strict=True))
        return slice(top, top + tile.full[0]), slice(left, left + tile.full[1])

    def _displacement_error(self, here: tuple[slice, slice], rounding: float) -> NDArray[np.float64]:
        """Change of the power [W] on a tile if float32 displaces lines of sight by `rounding` [pixels]."""
        around = self.window.around(*(range(side.start, side.stop) for side in here), REACH)
        grid = Grid(around.shape)
        x, y = grid.gradient(grid.flat(around.cut(self.power).astype(np.float64)))
        change = rounding * grid.array(grid.spread_max(dr.sqrt(x * x + y * y)))
        first = here[0].start - around.top, here[1].start - around.left
        return change[tuple(slice(k, k + side.stop - side.start) for k, side in zip(first, here, strict=True))]


def _require_memory(full: tuple[int, int], each: int) -> None:
    """Raise SceneError where planes of `each` bytes a pixel, with the work on a tile or writing, exceed the memory."""
    pixels = math.prod(full)
    needed = pixels * each + max(WORK, pixels * WRITING)
    free = available_memory()
    if pixels > SIDE**2 and free is not None and needed > free:
        height, width = full
        raise SceneError(
            f"fspt_integral: a film of {width} x {height} pixels needs {needed} bytes ({needed / 2**30:.1f} GiB) of "
            f"memory, {free} are free. Give a smaller film, or render it in parts by its crop window."
        )


def _added_levels(levels: Sequence[str]) -> tuple[str, ...]:
    """What each step of the refinement did on all tiles."""
    steps: dict[str, list[str]] = {}
    for text in levels:
        steps.setdefault(text.partition(":")[0], []).append(text)
    return tuple(map(_added, steps.values()))


def _common_findings(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Of each shortcut whether it was taken on any tile."""
    shortcuts: dict[str, list[Finding]] = {}
    for finding in findings:
        shortcuts.setdefault(finding.name, []).append(finding)
    return tuple(
        Finding(name, any(one.taken for one in some), _added([one.why for one in some if one.taken] or [some[0].why]))
        for name, some in shortcuts.items()
    )


def _added(texts: Sequence[str]) -> str:
    """The text, with sums of the whole numbers behind its colon where the texts differ by them alone; or the first."""
    head, colon, tail = texts[0].rpartition(": ")
    if len({COUNT.sub("", text) for text in texts}) > 1 or (len(set(texts)) == 1 and not colon):
        return texts[0]
    counts = np.array([COUNT.findall(text.rpartition(": ")[2]) for text in texts], object).astype(int).sum(axis=0)
    sums = iter(counts.tolist())
    return head + colon + COUNT.sub(lambda _: str(next(sums)), tail)
