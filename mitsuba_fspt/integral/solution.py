"""The image of P (Eq. 9) that the deterministic integral returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .shortcuts import Finding


@dataclass(frozen=True)
class Solution:
    """Image of the crop window, arrays (h, w): power [W], estimated absolute error [W], coverage in [0, 1].

    rays : lines of sight of all pixels together, in the EXR header `nodes`
    levels : name, pixels and lines of sight of each step of the refinement, as text
    where : pixels on which a partial solution is complete
    findings : which shortcuts were taken, and why
    """

    power: NDArray[np.float64]
    error: NDArray[np.float64]
    coverage: NDArray[np.float64]
    rays: int
    levels: tuple[str, ...] = field(default=())
    where: NDArray[np.bool_] = field(default_factory=lambda: np.ones((), bool))
    findings: tuple[Finding, ...] = field(default=())

    def beyond(self, rtol: float) -> tuple[int, float]:
        """Number of pixels whose error is above `rtol` times the brightest pixel; the largest error over that pixel."""
        peak = self.power.max(initial=0.0)
        if not peak > 0:
            return 0, 0.0
        return int(np.count_nonzero(self.error > rtol * peak)), float(self.error.max() / peak)

    def darkened(self, shares: NDArray[np.float64]) -> Solution:
        """The image behind a vignetting that leaves each pixel a share (h, w) of its power (Eq. M.45)."""
        return replace(self, power=self.power * shares, error=self.error * shares)

    def plus(self, rest: Solution) -> Solution:
        """The image with the light of a `rest` added; coverage and findings are those of this one."""
        return replace(
            self,
            power=self.power + rest.power,
            error=self.error + rest.error,
            rays=self.rays + rest.rays,
            levels=self.levels + tuple(f"other courses, {level}" for level in rest.levels),
        )

    def completed_by(self, rest: Solution) -> Solution:
        """This partial solution on its own pixels, unless `rest` states a smaller error there; `rest` elsewhere."""
        better = self.where & (self.error <= rest.error)
        return Solution(
            np.where(better, self.power, rest.power),
            np.where(better, self.error, rest.error),
            np.where(self.where, self.coverage, rest.coverage),
            self.rays + rest.rays,
            self.levels + rest.levels,
            findings=self.findings + rest.findings,
        )
