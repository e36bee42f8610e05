"""Quadratic programmes with x >= 0 by the multipliers of the bounds, many right-hand sides with one matrix.

    x = A⁻¹ (r + λ),   x >= 0,   λ >= 0,   λᵀx = 0

Only unknowns at their bound have λ > 0. With the columns of A⁻¹ that belong to them, which all right-hand sides share,
λ follows from a dense problem of their number, in place of sparse ones of all unknowns. The set of them is changed as a
whole until none has λ < 0 and no other unknown is < 0 (block pivoting: J. J. Júdice and F. M. Pires, Comput. Oper. Res.
21, 587, 1994).
"""

from __future__ import annotations

from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csr_array

from .nonnegative import Solve, pivoted

Array = NDArray[np.float64]
Index = NDArray[np.int64]
ROUNDS = 40  # of active sets: they are final after some five; what is not goes on from there in `nonnegative`
MOST = 2**28  # bytes of columns of the inverse, 256 MB: unknowns beyond are left to `nonnegative`


class Minima:
    """Minima for right-hand sides of one matrix, or near them, from an x near them.

    By the unknowns that are 0 in it, where they are at most `columns` and fit into memory; else by the others.
    """

    def __init__(self, matrix: csr_array, solve: Solve, bounded: NDArray[np.bool_], columns: int) -> None:
        self._matrix, self._bounded, self._columns = matrix, bounded, columns
        self._multipliers = Multipliers(solve, bounded)

    def near(self, right: Array, near: Array) -> Array:
        """x (m, k) >= 0 for right-hand sides (m, k); near : (m,)."""
        zeros = int(np.count_nonzero(self._bounded & (near <= 0)))
        if zeros <= self._columns and 16 * zeros * len(near) <= MOST:  # draws have up to twice as many
            return self._multipliers.start(right, near)
        return np.stack([pivoted(self._matrix, column, near, self._bounded) for column in right.T], axis=1)


class Multipliers:
    """Active sets of one matrix A, given by its `solve`; x >= 0 holds where `bounded` (m,) is True."""

    def __init__(self, solve: Solve, bounded: NDArray[np.bool_]) -> None:
        self._solve, self._bounded = solve, bounded
        self._place = np.full(len(bounded), -1, np.int64)  # of each unknown among the columns
        self._columns = np.empty((len(bounded), 0), order="F")
        self._count = 0
        self._lock = Lock()

    def start(self, right: Array, near: Array) -> Array:
        """x (m, k) >= 0 for right-hand sides (m, k): the minimum, or near it where active sets did not become final.

        near : (m,), whose values <= 0 are the first active set
        """
        free, first = self._solve(right), np.flatnonzero(self._bounded & (near <= 0))
        return np.stack([self._one(column, first) for column in free.T], axis=1)

    def _one(self, free: Array, first: Index) -> Array:
        """x (m,) from the minimum without bounds `free`, beginning with the unknowns `first` at their bound."""
        x, at_bound = free, first
        slack = 1e-12 * float(np.abs(free).max())
        for _ in range(ROUNDS):
            at_bound = np.union1d(at_bound, np.flatnonzero(self._bounded & (x < -slack)))
            if (columns := self._inverse(at_bound)) is None:
                break
            try:
                multipliers = cho_solve(cho_factor(columns[at_bound], lower=True), -free[at_bound])
            except LinAlgError:  # numerically singular
                break
            x = free + columns @ multipliers
            x[at_bound] = 0  # exactly, not to rounding
            held = multipliers >= 0
            if held.all() and not (self._bounded & (x < -slack)).any():
                break
            at_bound = at_bound[held]
        return np.where(self._bounded, np.maximum(x, 0), x)

    def _inverse(self, unknowns: Index) -> Array | None:
        """Columns of A⁻¹ of these unknowns, (m, n); None where they would take more than `MOST` bytes."""
        with self._lock:
            missing = unknowns[self._place[unknowns] < 0]
            if 8 * len(self._place) * (self._count + len(missing)) > MOST:
                return None
            if len(missing):
                unit = np.zeros((len(self._place), len(missing)))
                unit[missing, np.arange(len(missing))] = 1
                self._place[missing] = self._count + np.arange(len(missing))
                self._append(self._solve(unit))
            return self._columns[:, self._place[unknowns]]

    def _append(self, found: Array) -> None:
        """Keep columns; room for them doubles."""
        count = self._count + found.shape[1]
        if count > self._columns.shape[1]:
            larger = np.empty((len(self._place), max(count, 2 * self._columns.shape[1])), order="F")
            larger[:, : self._count] = self._columns[:, : self._count]
            self._columns = larger
        self._columns[:, self._count : count] = found
        self._count = count
