"""A sparse factor of H + w Q (Eq. M.23), kept for the matrices of later rounds, which are near it.

Where σ² and w of a matrix A differ from those of the factor's F by shares of at most ε, so does xᵀA x from xᵀF x for
every x: a step x ← x + F⁻¹ (r − A x) then leaves about ε of the error of x. A factor of 45,000
unknowns takes as long as 200 solutions by it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .nonnegative import Solve, factor

Array = NDArray[np.float64]
NEAR = 0.05  # largest ε for which a factor is kept: three steps leave 6e-6 of the error
LEFT = 1e-5  # of the error of a solution; what is left in a minimum is measured by its decrement


class KeptFactor:
    """The factor that was made last."""

    def __init__(self) -> None:
        self._solve: Solve | None = None
        self._sigma, self._weight = np.empty(0), np.nan
        self._of: tuple[object, ...] = ()

    def solve(
        self, matrix: csr_array, sigma: Array, weight: float, of: tuple[object, ...], exact: bool = False
    ) -> Solve:
        """What solves `matrix`, H + w Q for `sigma` (N,) and `weight`, with the kept factor if it is near.

        of : the objects that T and Q are made of;  exact : without steps, by its own factor
        """
        far = self._distance(sigma, weight, of)
        if self._solve is None or not far <= (0.0 if exact else NEAR):  # NaN where a variance is infinite
            self._solve, far = factor(matrix), 0.0
            self._sigma, self._weight, self._of = sigma, weight, of
        return partial(_corrected, matrix, self._solve, far) if far else self._solve

    def _distance(self, sigma: Array, weight: float, of: tuple[object, ...]) -> float:
        """ε of a matrix; infinite for one of other T or Q."""
        if len(of) != len(self._of) or any(one is not other for one, other in zip(of, self._of, strict=True)):
            return np.inf
        with np.errstate(invalid="ignore"):
            changed = float(np.abs((self._sigma / sigma) ** 2 - 1).max())
        if weight == self._weight:
            return changed
        return max(changed, abs(weight / self._weight - 1)) if self._weight else np.inf


def _corrected(matrix: csr_array, solve: Solve, far: float, right: Array) -> Array:
    """Solution for `right` (m,) or (m, k) by the factor of a matrix that is `far` from this one."""
    x, left = solve(right), far
    while left > LEFT:
        x, left = x + solve(right - matrix @ x), left * far
    return x
