"""Damped steps to the least Σ r², r residuals over their σ, by the method of Levenberg and Marquardt.

    (NᵀN + λ 1) s' = Nᵀ r,   N the slopes with columns of length 1,   s = s'/lengths

`SourceFit` and `CalibrationFit` take such steps with the σ of where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
T = TypeVar("T")

SHORTER = 0.7  # of a step that failed, how long the next may be: one nearly as long would fail for the same reason


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Least squares about the present values, in steps times the lengths (p,) of the slopes.

    normal : (p, p) NᵀN;  right : (p,) Nᵀ r
    """

    lengths: Array
    normal: Array
    right: Array

    @classmethod
    def of(cls, slopes: Array, residual: Array) -> LinearFit:
        """From the changes (N, p) of the fitted values and the residuals (N,), measured − fitted, both over σ."""
        lengths = np.linalg.norm(slopes, axis=0)
        normal = slopes.T @ slopes / np.outer(lengths, lengths)
        return cls(lengths, normal, slopes.T @ residual / lengths)

    @property
    def fall(self) -> float:
        """Fall of Σ r² by the step without damping; NaN where a slope is infinite."""
        if not np.isfinite(self.normal).all():
            return np.nan
        return float(self.right @ np.linalg.lstsq(self.normal, self.right)[0])

    def step(self, damping: float) -> tuple[Array, float]:
        """Change (p,) of the values by the step with λ = `damping`, and the fall of Σ r² by it."""
        scaled = np.linalg.solve(self.normal + damping * np.eye(len(self.normal)), self.right)
        return scaled / self.lengths, float(scaled @ (2 * self.right - self.normal @ scaled))

    def damping_of(self, length: float, damping: float) -> float:
        """λ, `damping` times the least power of 10 above 1 for which a step times the lengths is at most that long."""
        while True:
            damping *= 10
            if not np.linalg.norm(self.step(damping)[0] * self.lengths) > length:
                return damping


class DampedSteps:
    """Steps each of which lowers Σ r², with a λ that follows their success.

    end : fall of Σ r² for which no step is tried
    longest : bound of the change of each value by the first step; a later step is at most ten times the one before it
    damping, least : first and least λ
    """

    def __init__(self, end: float, longest: float = np.inf, damping: float = 1e-3, least: float = 1e-9) -> None:
        self._end, self._longest, self._first, self._least = end, longest, damping, least
        self._damping = damping

    def lower(self, linear: LinearFit, attempt: Callable[[Array], T | None]) -> T | None:
        """The result of the first `attempt` at a step (p,) that is not None; after each other one λ is larger.

        None where no step is left: the fall of the next one is at most `end`. λ begins where it is more, if the step
        without damping is: along what the slopes determine weakly, a larger λ leaves nearly nothing of the step.
        """
        while self._damping > self._least and linear.step(self._damping)[1] <= self._end < linear.fall:
            self._damping *= 0.1
        while True:
            step, fall = linear.step(self._damping)
            if not fall > self._end:  # NaN where a slope is infinite
                self._damping = self._first
                return None
            if np.abs(step).max() > self._longest:
                if linear.step(10 * self._damping)[1] > self._end:
                    self._damping *= 10
                    continue
                step *= self._longest / np.abs(step).max()
            if (found := attempt(step)) is not None:
                self._damping = max(0.1 * self._damping, self._least)
                self._longest = max(self._longest, 10 * np.abs(step).max())
                return found
            self._damping = linear.damping_of(SHORTER * float(np.linalg.norm(step * linear.lengths)), self._damping)
