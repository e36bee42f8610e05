"""Creases of a triangle mesh: edges where its faces meet at an angle, and borders, where the surface ends.

Around a vertex the creases cut the surface into sectors. J_n has one value at the vertex, but its slope differs from
one sector to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
Index = NDArray[np.int64]
SMOOTH, CREASE, CORNER = 0, 1, 2  # kinds of unknowns: off the creases, on one, where one bends or several meet


@dataclass(frozen=True, eq=False)
class Creases:
    """Creases of the triangles `corners`.

    corners : (F, 3) vertices of the faces;  positions : (F, 3, 3) [mm] of them;  size : number of vertices
    angle : [degree] between the normals of two faces, above which their edge is a crease. Edges of one face, or of more
        than two, are creases at any angle.
    """

    corners: Index
    positions: Array
    size: int
    angle: float

    @cached_property
    def _edges(self) -> tuple[Index, Index, Index]:
        """Half-edges 3 f + k, from corner k of face f to the next: those of smooth edges in one face, those of the
        same edges in the other face, and all on creases.
        """
        ends = np.sort(np.stack([self.corners, np.roll(self.corners, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        order = np.lexsort(ends.T)
        new = np.append(True, (ends[order][1:] != ends[order][:-1]).any(axis=1))
        count = np.bincount(np.cumsum(new) - 1)
        first = np.flatnonzero(new)[count == 2]
        one, other = order[first], order[first + 1]
        vectors = np.cross(self.positions[:, 1] - self.positions[:, 0], self.positions[:, 2] - self.positions[:, 0])
        a, b = vectors[one // 3], vectors[other // 3]
        across = np.einsum("ei,ei->e", a, b)
        turned = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), across)) > self.angle
        smooth = np.zeros(len(order), bool)
        smooth[one[~turned]] = smooth[other[~turned]] = True
        return one[~turned], other[~turned], np.flatnonzero(~smooth)

    @cached_property
    def half_edges(self) -> Index:
        """Half-edges 3 f + k on creases."""
        return self._edges[2]

    @cached_property
    def edges(self) -> Index:
        """(E, 2) vertices of the edges on creases, each edge once."""
        return np.unique(np.sort(np.stack([self._start, self._end], axis=1), axis=1), axis=0)

    @cached_property
    def sectors(self) -> Index:
        """(F, 3) number of the sector around its vertex that each corner of a face is in."""
        one, other, _ = self._edges
        rows, columns = [], []
        for shift in (0, 1):  # the two faces of a smooth edge share the sectors at both of its ends
            rows.append(3 * (one // 3) + (one % 3 + shift) % 3)
            columns.append(3 * (other // 3) + (other % 3 + 1 - shift) % 3)
        entries = np.concatenate(rows), np.concatenate(columns)
        graph = coo_array((np.ones(len(entries[0])), entries), shape=(self.corners.size, self.corners.size))
        return connected_components(graph, directed=False)[1].astype(np.int64).reshape(-1, 3)

    def of_vertices(self) -> tuple[Index, csr_array]:
        """Kind of each vertex (size,), and the lengths [mm] of the edges on creases between them (size, size)."""
        one, other = self.edges.T
        places = np.empty((self.size, 3))
        places[self.corners] = self.positions
        return _kinds(one, other, np.linalg.norm(places[one] - places[other], axis=1), self.size)

    def of_faces(self) -> tuple[Index, csr_array]:
        """Kind of each face (F,), and the ways [mm] between middles of edges, for faces next to each other on a crease.

        These are two faces that begin and end a sector.
        """
        length = np.linalg.norm(self._place(self._next) - self._place(self.half_edges), axis=1)
        faces, sector = np.tile(self.half_edges // 3, 2), self.sectors.ravel()[np.append(self.half_edges, self._next)]
        order = np.argsort(sector, kind="stable")
        faces, sector, half = faces[order], sector[order], np.tile(length / 2, 2)[order]
        pair = np.flatnonzero(sector[1:] == sector[:-1])
        one, other, way = faces[pair], faces[pair + 1], half[pair] + half[pair + 1]
        different = one != other
        kinds, ways = _kinds(one[different], other[different], way[different], len(self.corners))
        several = np.bincount(self.half_edges // 3, minlength=len(self.corners)) > 0
        return np.where(several & (kinds != CREASE), CORNER, kinds), ways

    @property
    def _next(self) -> Index:
        """Corners at the ends of the half-edges on creases."""
        return 3 * (self.half_edges // 3) + (self.half_edges % 3 + 1) % 3

    @property
    def _start(self) -> Index:
        return self.corners.ravel()[self.half_edges]

    @property
    def _end(self) -> Index:
        return self.corners.ravel()[self._next]

    def _place(self, corners: Index) -> Array:
        return self.positions.reshape(-1, 3)[corners]


def _kinds(one: Index, other: Index, lengths: Array, size: int) -> tuple[Index, csr_array]:
    """Kinds by the number of neighbours along creases: a crease ends at one, goes on at two, and branches at more."""
    number = np.bincount(np.append(one, other), minlength=size)
    kinds = np.where(number < 2, SMOOTH, np.where(number == 2, CREASE, CORNER))
    found = coo_array((lengths, (one, other)), shape=(size, size)).tocsr()
    return kinds.astype(np.int64), csr_array(found + found.T)
