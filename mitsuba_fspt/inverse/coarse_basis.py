"""Functions ψ for J_n where the mesh is finer than the images resolve: linear between some of its vertices.

    J_n at a vertex = Σ_k ψ_k c_k,   ψ >= 0,   Σ_k ψ_k = 1,   c_k = J_n at the k-th of the vertices chosen (Eq. M.30)

The vertices chosen, no two of which are neighbours, have all others around them, and three of them that are next to
each other are a triangle, in which the others get their barycentric coordinates. Vertices on a crease lie between such
of the same crease.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array

from .creases import CORNER, CREASE

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def coarser(graph: csr_array, points: Array, kinds: Index | None = None) -> tuple[csr_array, csr_array, Index]:
    """ψ (n, k), the graph of the k vertices chosen, and which ones they are; k is n/2 to n/4.

    graph : (n, n) entries > 0 for neighbours;  points : (n, 3) [mm];  kinds : (n,) see `creases`; None: no crease
    """
    kinds = np.zeros(len(points), np.int64) if kinds is None else kinds
    own, root = _aggregates(graph, points, kinds)
    size, count = len(own), int(root.sum())
    sums = csr_array((np.ones(size), (np.arange(size), own)), shape=(size, count))
    between = csr_array(sums.T @ graph @ sums)
    between = csr_array(between - diags_array(between.diagonal()))
    between.eliminate_zeros()
    chosen = np.flatnonzero(root)
    corners = _triangles(between)
    alone = ~np.isin(own, corners) & ~root  # no triangle of nodes around such a vertex: its J_n is its own unknown
    chosen = np.concatenate([chosen, np.flatnonzero(alone)])
    columns, shares = _coordinates(points, points[chosen], own, corners)
    creased = kinds == CREASE
    shares[creased] *= kinds[chosen][columns[creased]] >= CREASE
    total = shares.sum(axis=1)
    columns[total <= 0, 0], shares[total <= 0, 0] = own[total <= 0], 1.0
    shares /= shares.sum(axis=1, keepdims=True)
    number = np.full(size, -1)
    number[chosen] = np.arange(len(chosen))
    single = number >= 0
    columns[single], shares[single] = number[single, None], (1.0, 0.0, 0.0)
    rows = np.repeat(np.arange(size), 3)
    basis = csr_array((shares.ravel(), (rows, columns.ravel())), shape=(size, len(chosen)))
    basis.eliminate_zeros()
    between.resize((len(chosen), len(chosen)))
    return basis, between, chosen


def neighbours(corners: Index, size: int) -> csr_array:
    """(size, size) the number of triangles `corners` (F, 3) on each edge, 0 elsewhere."""
    one, other = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edges = coo_array((np.ones(len(one)), (one, other)), shape=(size, size)).tocsr()
    both = csr_array(edges + edges.T)
    return csr_array(both - diags_array(both.diagonal()))


def _aggregates(graph: csr_array, points: Array, kinds: Index) -> tuple[Index, NDArray[np.bool_]]:
    """(n,) number of the chosen vertex that each belongs to, the nearest of its neighbours; and which are chosen.

    Chosen are the vertices of the highest random number among their neighbours that still wait (M. Luby, SIAM J.
    Comput. 15, 1036, 1986), those on creases first, and all corners of creases. A vertex on a crease belongs to one on
    a crease.
    """
    size = graph.shape[0]
    rows, columns = np.repeat(np.arange(size), np.diff(graph.indptr)), graph.indices
    number = np.random.default_rng(0).permutation(size) + float(size) * kinds
    takes = kinds[rows] >= kinds[columns]  # the vertex `rows`, once chosen, may have `columns` belong to it
    root, waiting = kinds == CORNER, kinds != CORNER
    waiting[columns[root[rows] & takes]] = False
    while waiting.any():
        highest = np.full(size, -1.0)
        np.maximum.at(highest, rows, np.where(waiting, number, -1.0)[columns])
        new = waiting & (number > highest)
        root |= new
        waiting &= ~new
        waiting[columns[new[rows] & takes]] = False
    own = np.cumsum(root) - 1
    beside = root[columns] & ~root[rows] & (kinds[columns] >= kinds[rows])
    way = np.linalg.norm(points[rows[beside]] - points[columns[beside]], axis=1)
    order = np.lexsort((-way, rows[beside]))  # the last one written is the nearest
    own[rows[beside][order]] = own[columns[beside][order]]
    return own, root


def _triangles(graph: csr_array) -> Index:
    """(t, 3) all three vertices i < j < k of which each two are neighbours."""
    rows, columns = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr)), graph.indices
    up = columns > rows
    one, other = rows[up], columns[up].astype(np.int64)  # edges i < j, sorted by i
    first, after = np.searchsorted(one, other), np.searchsorted(one, other, side="right")  # edges that begin at j
    edge, place = _ranges(first, after)
    third = other[place]
    edges = one * graph.shape[0] + other
    closed = np.isin(one[edge] * graph.shape[0] + third, edges)
    return np.stack([one[edge], other[edge], third], axis=1)[closed]


def _coordinates(points: Array, nodes: Array, own: Index, corners: Index) -> tuple[Index, Array]:
    """(n, 3) nodes and barycentric coordinates >= 0 of the nearest triangle among those at each point's own node."""
    flat = np.argsort(corners.ravel(), kind="stable")
    at = corners.ravel()[flat]
    point, place = _ranges(np.searchsorted(at, own), np.searchsorted(at, own, side="right"))
    corner = corners[flat[place] // 3]
    a, b, c = (nodes[corner[:, k]] for k in range(3))
    u, v, d = b - a, c - a, points[point] - a
    uu, uv, vv, du, dv = (np.einsum("pi,pi->p", *pair) for pair in ((u, u), (u, v), (v, v), (d, u), (d, v)))
    det = np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv + np.finfo(float).tiny)
    second, third = (vv * du - uv * dv) / det, (uu * dv - uv * du) / det
    shares = np.maximum(np.stack([1 - second - third, second, third], axis=1), 0)
    shares /= shares.sum(axis=1, keepdims=True)
    distance = np.linalg.norm(points[point] - np.einsum("pk,pki->pi", shares, nodes[corner]), axis=1)
    best = np.lexsort((-distance, point))  # the last one written is the nearest
    columns, found = np.zeros((len(points), 3), np.int64), np.zeros((len(points), 3))
    columns[point[best]], found[point[best]] = corner[best], shares[best]
    return columns, found


def _ranges(first: Index, after: Index) -> tuple[Index, Index]:
    """For each k the numbers first[k] … after[k] − 1: k repeated, and the numbers."""
    sizes = after - first
    owner = np.repeat(np.arange(len(sizes)), sizes)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(sizes) - sizes, sizes) + np.repeat(first, sizes)
