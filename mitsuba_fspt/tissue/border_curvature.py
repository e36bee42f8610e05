"""Mean curvature of the border of a tetrahedral mesh at its vertices, smoothed over a length.

The integral of the mean curvature over an edge of a polyhedron is half the angle between the normals of its two faces
times its length (Steiner's formula), > 0 where the edge is convex. A vertex has half of each of its edges, and a third
of each of its faces' areas M; their ratio κ is smoothed by (M + ℓ² L) κ' = M κ, L the stiffness of linear elements,
which keeps ∫ κ dS.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import spsolve

from .tetrahedra import Tetrahedra

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def mean_curvature(mesh: Tetrahedra, length: float) -> Array:
    """κ [1/mm] at the vertices of the mesh, (V,), 0 off the border: mean of both principal curvatures, 1/R of a sphere.

    length : of the smoothing [mm]
    """
    faces = mesh.border
    points, count = mesh.vertices, len(mesh.vertices)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    normals /= doubled[:, None]
    area = np.bincount(faces.ravel(), np.repeat(doubled / 6, 3), count)
    start, end, first, second = _edges(faces, count)
    along = points[end] - points[start]
    size = np.linalg.norm(along, axis=1)
    turn = np.einsum("ed,ed->e", np.cross(normals[first], normals[second]), along) / size
    angle = np.arctan2(turn, np.einsum("ed,ed->e", normals[first], normals[second]))
    share = angle * size / 4
    total = np.bincount(np.concatenate([start, end]), np.concatenate([share, share]), count)
    used = np.flatnonzero(area > 0)
    matrix = csc_array(diags_array(area) + length**2 * _stiffness(points, faces))[used][:, used]
    curvature = np.zeros(count)
    curvature[used] = spsolve(csc_array(matrix), total[used])
    return curvature


def _edges(faces: Index, count: int) -> tuple[Index, Index, Index, Index]:
    """Edges that two faces share, in the sense of the first one: start and end vertex, first and second face."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    forward = np.argsort(start * count + end)
    key, reverse = (start * count + end)[forward], end * count + start
    at = np.minimum(np.searchsorted(key, reverse), len(key) - 1)
    shared = (key[at] == reverse) & (start < end)
    return start[shared], end[shared], face[shared], face[forward[at[shared]]]


def _stiffness(points: Array, faces: Index) -> coo_array:
    """∫ ∇φ_i·∇φ_j dS of linear elements on the faces, (V, V): half the cotangents of the angles opposite to edges."""
    rows, columns, values = [], [], []
    for k in range(3):
        i, j, apex = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3], faces[:, k]
        a, b = points[i] - points[apex], points[j] - points[apex]
        cotangent = np.einsum("fd,fd->f", a, b) / np.linalg.norm(np.cross(a, b), axis=1) / 2
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        values += [-cotangent, -cotangent, cotangent, cotangent]
    shape = len(points), len(points)
    return coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
