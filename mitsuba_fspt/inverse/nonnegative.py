"""Quadratic programmes with x >= 0, many right-hand sides at once: projected Newton steps by conjugate gradients.

    minimise  ½ xᵀ A x − rᵀ x   subject to   x >= 0,   A sparse, symmetric, positive definite

Each step solves for the free unknowns (x > 0, or a gradient that leads inside) by conjugate gradients, preconditioned
by a factor of all of A, and is projected onto x >= 0 with a line search (D. P. Bertsekas, SIAM J. Control Optim. 20,
221, 1982). It ends where the decrement gᵀ A⁻¹ g of the free gradient g is below a bound. In units of A that bounds the
error of any weighted sum: |c·(x − x*)|² <= (cᵀ A⁻¹ c) (gᵀ A⁻¹ g).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Solve = Callable[[Array], Array]
FEW = 2e-3  # share of the unknowns on the wrong side, at which Newton steps take less time than turns of block pivoting
PATIENCE = 3  # turns of block pivoting without fewer unknowns on the wrong side, after which Newton steps go on


@dataclass(frozen=True)
class Accuracy:
    """Bounds of the solver.

    decrement : gᵀ A⁻¹ g at which it ends; 1e-6 leaves any weighted sum within 1e-3 of its standard deviation
    steps : most Newton steps; what is left after them is in `Solution.decrement`
    inner : share of the residual that conjugate gradients leave in a step: small, since steps cost more than iterations
    iterations : most iterations of conjugate gradients in a step
    halvings : of a step that does not lower the objective, before a step along the preconditioned gradient
    """

    decrement: float = 1e-6
    steps: int = 60
    inner: float = 1e-2
    iterations: int = 60
    halvings: int = 12


@dataclass(frozen=True, eq=False)
class Solution:
    """x (m, k), and for each column the decrement that is left (k,) and the number of steps."""

    x: Array
    decrement: Array
    steps: int


def factor(matrix: csr_array) -> Solve:
    """Function that solves `matrix` x = r for r (m,) or (m, k), by a sparse LU factor.

    Pivots stay on the diagonal: others, which a positive definite matrix does not need, would fill the factor.
    """
    options = {"SymmetricMode": True}
    return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve


def pivoted(matrix: csr_array, right: Array, near: Array, bounded: NDArray[np.bool_]) -> Array:
    """Minimum (m,) for one right-hand side (m,), or near it, by block pivoting from the unknowns that are 0 in `near`.

    Each turn factorises the part of `matrix` that belongs to the unknowns off their bound: worth it where many are 0.
    """
    at_bound, left, waited = bounded & (near <= 0), len(near) + 1, 0
    best = np.where(bounded, np.maximum(near, 0), near)
    while waited < PATIENCE:
        x, free = np.zeros(len(near)), np.flatnonzero(~at_bound)
        if len(free):
            x[free] = factor(csr_array(matrix[free][:, free]))(right[free])
        gradient = matrix @ x - right
        below = bounded & (x < -1e-12 * np.abs(x).max())
        released = at_bound & (gradient < -1e-12 * np.abs(right).max())
        wrong = int(below.sum() + released.sum())
        best, left, waited = (x, wrong, 0) if wrong < left else (best, left, waited + 1)
        if wrong <= FEW * len(near):
            break
        at_bound = (at_bound & ~released) | below
    return np.where(bounded, np.maximum(best, 0), best)


def minimise(
    matrix: csr_array, right: Array, start: Array, bounded: NDArray[np.bool_], solve: Solve, accuracy: Accuracy
) -> Solution:
    """Minimum for every column of `right` (m, k), from `start` (m, k); x >= 0 holds where `bounded` (m,) is True."""
    least = np.where(bounded, 0.0, -np.inf)[:, None]
    x = np.maximum(start, least)
    left = np.full(right.shape[1], np.inf)
    todo = np.arange(right.shape[1])
    steps = 0
    while len(todo) and steps < accuracy.steps:
        now, r = x[:, todo], right[:, todo]
        gradient = matrix @ now - r
        free = (now > least) | (gradient < 0)
        residual = np.where(free, -gradient, 0)
        first = np.where(free, solve(residual), 0)
        left[todo] = np.einsum("mk,mk->k", residual, first)
        going = left[todo] > accuracy.decrement
        if not going.any():
            break
        todo, now, r, free = todo[going], now[:, going], r[:, going], free[:, going]
        step = _conjugate_gradients(matrix, residual[:, going], first[:, going], free, solve, accuracy)
        x[:, todo] = _searched(matrix, r, now, least, step, first[:, going], accuracy)
        steps += 1
    return Solution(x, left, steps)


def _conjugate_gradients(
    matrix: csr_array, residual: Array, first: Array, free: NDArray[np.bool_], solve: Solve, accuracy: Accuracy
) -> Array:
    """Step (m, k) of the free unknowns: matrix · step = residual there, step = 0 elsewhere."""
    step, direction, residual = np.zeros_like(residual), first.copy(), residual.copy()
    norm = np.einsum("mk,mk->k", residual, first)
    goal = accuracy.inner**2 * norm
    for _ in range(accuracy.iterations):
        image = np.where(free, matrix @ direction, 0)
        length = _ratio(norm, np.einsum("mk,mk->k", direction, image))
        step += length * direction
        residual -= length * image
        z = np.where(free, solve(residual), 0)
        norm, before = np.einsum("mk,mk->k", residual, z), norm
        if (norm <= goal).all():
            break
        direction = z + _ratio(norm, before) * direction
    return step


def _searched(
    matrix: csr_array, right: Array, now: Array, least: Array, step: Array, descent: Array, accuracy: Accuracy
) -> Array:
    """`now` moved along the step, projected, halved where the objective does not fall; else along `descent`."""

    def objective(x: Array) -> Array:
        return np.einsum("mk,mk->k", x, 0.5 * (matrix @ x) - right)

    before, best = objective(now), now.copy()
    waiting = np.ones(now.shape[1], bool)
    for along in (step, descent):
        length = 1.0
        for _ in range(accuracy.halvings):
            tried = np.maximum(now + length * along, least)
            better = waiting & (objective(tried) < before)
            best[:, better] = tried[:, better]
            waiting &= ~better
            if not waiting.any():
                return best
            length /= 2
    return best


def _ratio(one: Array, other: Array) -> Array:
    return np.divide(one, other, out=np.zeros_like(one), where=other > 0)
