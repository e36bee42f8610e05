"""Smooth surface through the vertices of a triangle mesh, such as that of a body of which the triangles are a sample.

The flow of light along the border (Eq. M.48) has second derivatives, which facets that are a micrometre off the body
change by per cents of J_n.
A point p of a triangle with the corners p_k, the normals n_k there and the barycentric coordinates λ_k moves to

    p + ½ Σ_k λ_k ((p_k - p)·n_k) n_k,

which is on the body up to the third order of the triangle's size (T. Boubekeur, M. Alexa, ACM Trans. Graph. 27, 141
(2008), with ½, which is exact for quadrics). Corners stay, and plane faces, and creases: the normal of a corner is that
of the faces around it whose normals differ from the triangle's by less than 45°: chamfers and octagons stay sharp.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from trimesh.remesh import subdivide_to_size
from trimesh.triangles import points_to_barycentric

from .border_curvature import CREASE
from .border_surface import nearest_triangles

ROUNDING = 1e-6  # of the cosine of 45° between faces whose vertices are rounded, as to float32
Array = NDArray[np.float64]
Index = NDArray[np.int64]


class SmoothSurface:
    """Surface of `faces` (F, 3) with `vertices` (V, 3) [mm]; points near it are found fast if these are `size` [mm]."""

    def __init__(self, vertices: Array, faces: Index, size: float) -> None:
        self._corners = vertices[faces]
        # Triangles of similar size, so that the nearest one is among the few with the nearest centroids.
        fine, parts, self._whole = subdivide_to_size(vertices, faces, size, max_iter=20, return_index=True)
        self._parts = fine[parts]
        edges = np.roll(self._corners, -1, axis=1) - self._corners
        normals = np.cross(edges[:, 0], edges[:, 1])
        self._normals = normals / np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
        # Weights by which normals at the vertices of a sphere are exact (N. Max, J. Graph. Tools 4, 1 (1999)).
        square = np.einsum("fki,fki->fk", edges, edges)
        square = np.maximum(square * np.roll(square, 1, axis=1), np.finfo(float).tiny)
        self._weights = np.linalg.norm(normals, axis=1)[:, None] / square
        self._faces = faces
        # Corners 3 f + k of the faces by vertices, those of vertex v from number start[v] on.
        self._by_vertex = np.argsort(faces.ravel(), kind="stable")
        self._start = np.searchsorted(faces.ravel()[self._by_vertex], np.arange(len(vertices) + 1))

    def nearest(self, points: Array) -> Array:
        """Point of the smooth surface (N, 3) [mm] at the nearest point of a triangle to each of `points` (N, 3)."""
        found, part = nearest_triangles(points, self._parts)
        face, index = np.unique(self._whole[part], return_inverse=True)
        corners, normals = self._corners[face], self._corner_normals(face)
        weights = np.nan_to_num(points_to_barycentric(corners[index], found)).clip(0, 1)
        off = np.einsum("nki,nki->nk", corners[index] - found[:, None], normals[index])
        return np.asarray(found + np.einsum("nk,nk,nki->ni", weights, off, normals[index]) / 2)

    def _corner_normals(self, face: Index) -> Array:
        """Normals at the corners of these faces, (n, 3, 3)."""
        vertex = self._faces[face].ravel()
        start, count = self._start[vertex], self._start[vertex + 1] - self._start[vertex]
        corner = np.repeat(np.arange(len(vertex)), count)
        place = np.arange(len(corner)) - np.repeat(np.cumsum(count) - count - start, count)
        other, which = np.divmod(self._by_vertex[place], 3)
        cosine = np.einsum("pi,pi->p", self._normals[other], self._normals[face[corner // 3]])
        smooth = cosine > math.cos(CREASE) + ROUNDING
        weight = np.where(smooth, self._weights[other, which], 0)
        sums = [np.bincount(corner, weight * self._normals[other, k], 3 * len(face)) for k in range(3)]
        normals = np.stack(sums, axis=1)
        length = np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)
        return np.asarray((normals / length[:, None]).reshape(-1, 3, 3))
