"""Refined border of a tetrahedral mesh: each boundary facet is cut into equal triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def refined_border(grid: Any, cuts: int) -> tuple[Array, Index]:
    """Points (P, 3) [mm] and triangles (F cuts², 3), outward, of the boundary facets of a scikit-fem mesh.

    `cuts` >= 1: the number of parts of each edge. Points of a curved facet lie on the curve. The surface is closed if
    the mesh's border is.
    """
    facets = grid.boundary_facets()
    lattice = np.array([(i, j) for i in range(cuts + 1) for j in range(cuts + 1 - i)])
    points = grid.mapping().G(lattice.T / cuts, find=facets)
    number = _lattice_numbers(grid, facets, lattice, cuts)
    _, first, index = np.unique(number.ravel(), return_index=True, return_inverse=True)
    points = np.asarray(points).reshape(3, -1).T[first]
    triangles = index.reshape(number.shape)[:, _cut(lattice, cuts)]
    # The cell's vertex opposite to the facet lies on the inner side.
    corners = grid.facets[:, facets]
    opposite = grid.t[:, grid.f2t[0, facets]].sum(axis=0) - corners.sum(axis=0)
    a, b, c = (grid.p[:, corner].T for corner in corners)
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), grid.p[:, opposite].T - a) > 0
    triangles[inward] = triangles[inward][:, :, ::-1]
    return points, triangles.reshape(-1, 3)


def nearest_points(points: Array, triangles: Array) -> Array:
    """Nearest point on `triangles` (F, 3 corners, 3) to each of `points` (N, 3), shape (N, 3), all [mm]."""
    return nearest_triangles(points, triangles)[0]


def nearest_triangles(points: Array, triangles: Array) -> tuple[Array, Index]:
    """Nearest point (N, 3) on `triangles` (F, 3, 3) [mm] to each of `points` (N, 3) [mm], and its triangle (N,).

    The result is exact if the nearest triangle is among the eight with the nearest centroids, as is the case for
    triangles of similar size.
    """
    from scipy.spatial import cKDTree
    from trimesh.triangles import closest_point

    candidates = cKDTree(triangles.mean(axis=1)).query(points, k=min(8, len(triangles)))[1].reshape(len(points), -1)
    each = np.repeat(points, candidates.shape[1], axis=0)
    found = closest_point(triangles[candidates.ravel()], each).reshape(*candidates.shape, 3)
    best, row = np.argmin(np.linalg.norm(found - points[:, None], axis=2), axis=1), np.arange(len(points))
    return found[row, best], candidates[row, best]


def _lattice_numbers(grid: Any, facets: Index, lattice: Index, cuts: int) -> Index:
    """Number of every lattice point of every facet, shape (F, L); a point shared by facets has one number.

    A corner has the number of the mesh's vertex; points of an edge follow from the edge's number and are counted from
    its lower vertex: facets list their vertices, and edges theirs, in ascending order.
    """
    i, j = lattice.T
    k = cuts - i - j
    inner = cuts - 1
    edges_start = grid.nvertices
    inside_start = edges_start + len(grid.edges[0]) * inner
    number = np.empty((len(facets), len(lattice)), dtype=np.int64)
    corners, edges = grid.facets[:, facets].astype(np.int64), grid.f2e[:, facets].astype(np.int64)
    for corner, here in enumerate((k == cuts, i == cuts, j == cuts)):
        number[:, here] = corners[corner][:, None]
    # Edges of a facet run from vertex 0 to 1, 1 to 2 and 0 to 2.
    on_edge = (
        ((j == 0) & (i > 0) & (k > 0), i),
        ((k == 0) & (i > 0) & (j > 0), j),
        ((i == 0) & (j > 0) & (k > 0), j),
    )
    for edge, (here, step) in enumerate(on_edge):
        number[:, here] = edges_start + edges[edge][:, None] * inner + step[here] - 1
    inside = (i > 0) & (j > 0) & (k > 0)
    count = np.count_nonzero(inside)
    number[:, inside] = inside_start + np.arange(len(facets))[:, None] * count + np.arange(count)
    return number


def _cut(lattice: Index, cuts: int) -> Index:
    """The cuts² triangles of a facet as rows of indices of lattice points, all oriented like (0, 1, 2)."""
    number = {tuple(p): n for n, p in enumerate(lattice.tolist())}
    up = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in number if i + j < cuts]
    down = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in number if i + j < cuts - 1]
    return np.array(up + down)
