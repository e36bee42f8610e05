"""Shape of the border of a tetrahedral mesh at its vertices: mean curvature, and creases, each over a length.

The integral of the mean curvature over an edge of a polyhedron is half the angle between the normals of its two faces
times its length (Steiner's formula), > 0 where the edge is convex. A vertex has half of each of its edges, and a third
of each of its faces' areas M; their ratio κ is smoothed by (M + ℓ² L) κ' = M κ, L the stiffness of linear elements,
which keeps ∫ κ dS.

What flows along the border ends at a crease, where the border turns at once: the share s of it that is left is 0 there
and 1 far away, (M + ℓ² L) (1 - s) = 0 off the creases, which falls as exp(-d/ℓ) with the distance d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import spsolve

from .tetrahedra import Tetrahedra

Array = NDArray[np.float64]
Index = NDArray[np.int64]
CREASE = math.radians(45)  # angle between the normals of two faces above which their edge is a crease


@dataclass(frozen=True, eq=False)
class BorderShape:
    """Shape of the border at the vertices of a mesh; 0 and 1 off the border.

    curvature : κ, (V,) [1/mm], mean of both principal curvatures, 1/R of a sphere
    along : (V,) share of the flow along the border that is left near creases
    """

    curvature: Array
    along: Array

    @classmethod
    def of(cls, mesh: Tetrahedra, length: float) -> BorderShape:
        """Shape of the border of a mesh.

        length : over which curvature and creases are smoothed [mm]
        """
        border = _Border(mesh)
        return cls(border.curvature(length), 1 - border.near_creases(length))

    @classmethod
    def flat(cls, mesh: Tetrahedra) -> BorderShape:
        """No curvature, and no creases."""
        count = len(mesh.vertices)
        return cls(np.zeros(count), np.ones(count))


class _Border:
    """Triangles of the border, and the edges that two of them share."""

    def __init__(self, mesh: Tetrahedra) -> None:
        self._points, self._faces = mesh.vertices, mesh.border
        corners = self._points[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(normals, axis=1)
        normals /= doubled[:, None]
        self._area = np.bincount(self._faces.ravel(), np.repeat(doubled / 6, 3), len(self._points))
        self._start, self._end, first, second = _edges(self._faces, len(self._points))
        along = self._points[self._end] - self._points[self._start]
        self._size = np.linalg.norm(along, axis=1)
        turn = np.einsum("ed,ed->e", np.cross(normals[first], normals[second]), along) / self._size
        self._angle = np.arctan2(turn, np.einsum("ed,ed->e", normals[first], normals[second]))

    def curvature(self, length: float) -> Array:
        """κ' (V,) [1/mm]."""
        share = self._angle * self._size / 4
        ends = np.concatenate([self._start, self._end])
        total = np.bincount(ends, np.concatenate([share, share]), len(self._points))
        used = np.flatnonzero(self._area > 0)
        curvature = np.zeros(len(self._points))
        curvature[used] = spsolve(self._smoothing(length)[used][:, used], total[used])
        return curvature

    def near_creases(self, length: float) -> Array:
        """1 - s, (V,)."""
        sharp = np.abs(self._angle) > CREASE
        near = np.zeros(len(self._points))
        near[self._start[sharp]] = near[self._end[sharp]] = 1
        free = np.flatnonzero((self._area > 0) & (near == 0))
        if sharp.any() and len(free):
            matrix = self._smoothing(length)[free]
            near[free] = spsolve(csc_array(matrix[:, free]), -(matrix @ near)).clip(0, 1)
        return near

    def _smoothing(self, length: float) -> csc_array:
        """M + ℓ² L, (V, V) [mm²]."""
        return csc_array(diags_array(self._area) + length**2 * self._stiffness)

    @cached_property
    def _stiffness(self) -> coo_array:
        return _stiffness(self._points, self._faces)


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
