"""Quadrature over a tetrahedron of a field that is steep about some points: the closer parts are, the smaller."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .elements import import_skfem

Array = NDArray[np.float64]

EVEN = 2  # divisions of every cell by which a steep field is integrated
# Largest number of divisions: the smallest parts are 1/4096 of an edge. What a field 1/r² has in such a part is as
# small a share of that in the cell.
MOST = 12
# Largest length of a part over the distance of its middle from the nearest point: J_n is right to 3e-5, with 2 to 4e-4,
# so that its change over a hundredth of an edge is right to 1 %.
WIDE = 1.4
# A tetrahedron's corners and the middles of its edges 01, 02, 03, 12, 13, 23, and the eight that they make.
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
PARTS = np.array(
    [
        [0, 4, 5, 6],
        [4, 1, 7, 8],
        [5, 7, 2, 9],
        [6, 8, 9, 3],
        [4, 5, 6, 8],
        [4, 5, 7, 8],
        [5, 6, 8, 9],
        [5, 7, 8, 9],
    ]
)
WHOLE = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]], np.float64)


def even_rule(degree: int) -> tuple[Array, Array]:
    """Points (3, Q) and weights (Q,) on the reference tetrahedron: a rule of `degree` on each of its 64 equal parts."""
    parts = WHOLE
    for _ in range(EVEN):
        parts = _divided(parts)
    return _rule(parts, degree)


def is_wide(corners: Array, centres: Array, radii: Array) -> NDArray[np.bool_]:
    """(T,) True for cells of these `corners` (T, 4, 3) [mm] whose equal parts are too wide for a field of spheres.

    centres, radii : of the spheres, (K, 3) and (K,) [mm]: inside of one the field is smooth
    """
    parts = corners
    for _ in range(EVEN):
        parts = _divided(parts)
    return np.asarray(_wide(parts, centres, radii).reshape(len(corners), 8**EVEN).any(axis=1))


def graded_rule(corners: Array, centres: Array, radii: Array, degree: int) -> tuple[Array, Array]:
    """Points (3, Q) and weights (Q,) on the reference tetrahedron, for the cell of these `corners` (4, 3) [mm].

    centres, radii : as in `is_wide`;  degree : of the rule on each part
    """
    edges = corners[1:] - corners[0]
    wide, done = WHOLE, list[Array]()
    for _ in range(MOST):
        wide = _divided(wide)
        still = _wide(corners[0] + wide @ edges, centres, radii)
        done.append(wide[~still])
        wide = wide[still]
    return _rule(np.concatenate([*done, wide]), degree)


def _divided(parts: Array) -> Array:
    """(8 T, 4, 3) the eight parts of each tetrahedron (T, 4, 3)."""
    corners = np.concatenate([parts, parts[:, EDGES].mean(axis=2)], axis=1)
    return corners[:, PARTS].reshape(-1, 4, 3)


def _wide(parts: Array, centres: Array, radii: Array) -> NDArray[np.bool_]:
    """(T,) True for parts (T, 4, 3) that are wider than they are far from a sphere's middle, or wide in it."""
    distance = np.maximum(cdist(parts.mean(axis=1), centres), radii).min(axis=1)
    length = np.linalg.norm(parts[:, EDGES[:, 0]] - parts[:, EDGES[:, 1]], axis=2).max(axis=1)
    return np.asarray(length > WIDE * distance)


def _rule(parts: Array, degree: int) -> tuple[Array, Array]:
    """Points and weights of a rule of `degree` on each of the parts (T, 4, 3)."""
    skfem = import_skfem()
    points, weights = skfem.quadrature.get_quadrature(skfem.ElementTetP1(), degree)
    edges = parts[:, 1:] - parts[:, :1]
    places = parts[:, :1] + np.einsum("dq,tde->tqe", points, edges)
    return places.reshape(-1, 3).T, (np.abs(np.linalg.det(edges))[:, None] * weights).ravel()
