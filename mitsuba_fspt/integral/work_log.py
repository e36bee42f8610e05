"""Lines of sight and seconds that each step of Eq. 9's integration takes, and lines of sight of each pixel."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import drjit as dr
import numpy as np
from numpy.typing import NDArray


@dataclass
class WorkLog:
    """Record of the steps of one image; while it is kept, each step runs to its end before the next.

    pixel_pitch : of the film [mm]; blocks of pixels, whose pitch is larger, are not in `lines`
    steps : name of a step -> pixels, lines of sight and seconds, those of equal names added up
    lines : place (x, y) of the first pixel on the film -> lines of sight of the pixels (h, w) of a part of the image
    """

    pixel_pitch: float
    steps: dict[str, tuple[int, int, float]] = field(default_factory=dict)
    lines: dict[tuple[float, float], NDArray[np.float64]] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def add(self, name: str, pixels: int, lines: int) -> None:
        """Record a step that ends now."""
        dr.sync_thread()
        now = time.perf_counter()
        before = self.steps.get(name, (0, 0, 0.0))
        self.steps[name] = (before[0] + pixels, before[1] + lines, before[2] + now - self.last)
        self.last = now

    def add_lines(self, place: tuple[float, float], lines: NDArray[np.float64]) -> None:
        """Record lines of sight of the pixels (h, w) of a part of the image."""
        self.lines[place] = self.lines.get(place, 0.0) + lines

    def dearest(self, count: int) -> list[tuple[int, int, int]]:
        """Column and row on the film, and lines of sight, of the pixels that take most of them."""
        found = []
        for (x, y), lines in self.lines.items():
            most = np.argsort(-lines.ravel(), kind="stable")[:count]
            row, column = np.divmod(most, lines.shape[1])
            found += [(int(x) + int(c), int(y) + int(r), round(lines[r, c])) for r, c in zip(row, column, strict=True)]
        return sorted((one for one in found if one[2] > 0), key=lambda one: -one[2])[:count]
