"""Geometry of triangle surfaces: areas, the boundary of tetrahedra, closure and orientation.

Pure NumPy on `points` of shape (V, 3), `faces` of shape (F, 3) and `tetrahedra` of shape (T, 4), indices from
0. The outward side of a face is the one from which its corners run counterclockwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FluxError

Points = NDArray[np.float64]
Indices = NDArray[np.int64]

# Local faces of a tetrahedron in the order of MMC and of iso2mesh's rowmajor `faceneighbors`, and the corner opposite
# to each.
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
TETRAHEDRON_OPPOSITE = np.array([3, 2, 1, 0])


def face_normals(points: Points, faces: Indices) -> Points:
    """Vector area of each face, shape (F, 3) [square of the length unit of `points`]: outward normal times area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def face_areas(points: Points, faces: Indices) -> NDArray[np.float64]:
    """Area of each face, shape (F,), >= 0 [square of the length unit of `points`]."""
    return np.linalg.norm(face_normals(points, faces), axis=1)


def boundary(points: Points, tetrahedra: Indices) -> tuple[Indices, Indices]:
    """Boundary faces (F, 3) of the tetrahedra, outward, and the index of the tetrahedron of each (F,).

    A boundary face belongs to one tetrahedron only. Faces are sorted by tetrahedron, within one in the order (1,2,3)
    (1,2,4) (1,3,4) (2,3,4). The corner opposite to a face defines its outward side; the order of a tetrahedron's
    corners has no effect.

    Raises
    ------
    FluxError : a face belongs to more than two tetrahedra.
    """
    faces = tetrahedra[:, TETRAHEDRON_FACES].reshape(-1, 3)
    shared_by = _multiplicity(np.sort(faces, axis=1), len(points))
    if shared_by.max() > 2:
        first = faces[np.argmax(shared_by)] + 1
        raise FluxError(
            f"tetrahedra: {shared_by.max()} of them share the face of nodes {first.tolist()} (counted from "
            "1), a face has at most two. Remove duplicate elements."
        )
    on_boundary = np.flatnonzero(shared_by == 1)
    owner = on_boundary // 4
    faces = faces[on_boundary]
    opposite = points[tetrahedra[owner, TETRAHEDRON_OPPOSITE[on_boundary % 4]]]
    inward = np.einsum("ij,ij->i", face_normals(points, faces), opposite - points[faces[:, 0]]) > 0
    faces[inward] = faces[inward, ::-1]
    return faces, owner


def merge(points: Points, faces: Indices) -> tuple[Points, Indices]:
    """Points without duplicates (P, 3), and the same faces in the same order with the new indices (F, 3).

    Only points with equal coordinates are merged. An STL file repeats a corner for each of its faces.
    """
    order = np.lexsort(points.T)
    ordered = points[order]
    new = np.ones(len(points), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(points), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return ordered[new], number[faces]


def compact(points: Points, faces: Indices) -> tuple[Points, Indices, Indices]:
    """Points that the faces use, in order, the renumbered faces, and the old indices of those points."""
    used = np.zeros(len(points), dtype=bool)
    used[faces.ravel()] = True
    kept = np.flatnonzero(used)
    number = np.cumsum(used) - 1
    return points[kept], number[faces], kept


@dataclass(frozen=True)
class Closure:
    """Closure and orientation of a surface.

    watertight : every edge has a face on either side
    twisted : number of edges whose two faces are oriented oppositely; 0 if all orientations are consistent
    inside_out : number of connected pieces whose faces point to the wrong side; None unless watertight and not
        twisted. Faces that point to the interior of their piece are right if the piece bounds a cavity in another one.
    pieces : number of connected pieces; 0 if `inside_out` is None
    """

    watertight: bool
    twisted: int
    inside_out: int | None
    pieces: int

    @property
    def outward(self) -> bool | None:
        """True if every face points outward; None if the surface is open, which leaves that undecided."""
        if self.twisted:
            return False
        return None if self.inside_out is None else self.inside_out == 0


def closure(points: Points, faces: Indices) -> Closure:
    """Closure and orientation of a surface; corners at equal positions count as one."""
    points, faces = merge(points, faces)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[distinct]  # a face that is a line or a point bounds no volume
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge, count = np.unique(low * len(points) + high, return_inverse=True, return_counts=True)
    forward = np.bincount(edge.ravel(), weights=start < end, minlength=len(count))
    watertight = bool(len(count)) and bool((count % 2 == 0).all())
    # On a closed surface as many faces traverse an edge in one direction as in the other.
    twisted = int(np.count_nonzero(np.abs(2 * forward - count) > count % 2))
    if not watertight or twisted:
        return Closure(watertight, twisted, None, 0)
    inside_out, pieces = _inside_out(points, faces)
    return Closure(True, 0, inside_out, pieces)


def _inside_out(points: Points, faces: Indices) -> tuple[int, int]:
    """Number of pieces of a closed surface whose faces point to the wrong side, and number of all pieces."""
    label = _pieces(len(points), faces)[faces[:, 0]]
    _, first, piece = np.unique(label, return_index=True, return_inverse=True)
    corners, normals = points[faces], face_normals(points, faces)
    # Positions relative to a corner of the piece: far from the origin the terms of the volume would cancel.
    heights = corners[:, 0] - corners[first, 0][piece]
    volumes = np.bincount(piece, weights=np.einsum("ij,ij->i", normals, heights)) / 3
    areas = np.bincount(piece, weights=np.linalg.norm(normals, axis=1))
    # A sheet with a face on either side has no volume, only rounding error, and counts as right.
    hollow = np.flatnonzero(volumes < -1e-9 * areas**1.5)  # few: cavities and inverted pieces
    if len(hollow) == 0:
        return 0, len(first)
    lowest, highest = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    wrong = 0
    for number in hollow:
        # A point of the piece whose upward line does not meet the edges of an axis-aligned mesh.
        point = np.array([0.5377, 0.2719, 0.1904]) @ corners[first[number]]
        near = ((lowest <= point[:2]) & (highest >= point[:2])).all(axis=1) & (piece != number)
        wrong += _crossings_above(point, corners[near]) <= 0
    return wrong, len(first)


def _crossings_above(point: Points, corners: NDArray[np.float64]) -> int:
    """Number of faces above `point` along +z, outward ones minus inward ones: 1 inside an object, 0 outside."""
    x, y, z = np.moveaxis(corners - point, 2, 0)
    side = x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)  # twice the area of (origin, corner, next)
    up, down = (side > 0).all(axis=1), (side < 0).all(axis=1)
    height = np.einsum("ij,ij->i", np.roll(side, -1, axis=1), z)  # barycentric, times the sign of the face
    return int(np.count_nonzero(up & (height > 0)) - np.count_nonzero(down & (height < 0)))


def _pieces(count: int, faces: Indices) -> Indices:
    """Smallest index of a point that faces connect with each of `count` points, shape (count,)."""
    label = np.arange(count)
    while True:
        before = label.copy()
        lowest = label[faces].min(axis=1).repeat(3)
        np.minimum.at(label, before[faces.ravel()], lowest)  # relabel all points with the same label at once
        np.minimum.at(label, faces.ravel(), lowest)
        label = label[label]
        if np.array_equal(label, before):
            return label


def _multiplicity(triples: Indices, count: int) -> Indices:
    """Number of occurrences of each row of `triples` (N, 3) among all rows; rows are sorted, entries below `count`."""
    pair = triples[:, 0] * count + triples[:, 1]
    if count > 2**21:  # three such numbers no longer fit in 63 bits: number the pairs first
        _, pair = np.unique(pair, return_inverse=True)
    _, inverse, counts = np.unique(pair * count + triples[:, 2], return_inverse=True, return_counts=True)
    return counts[inverse.ravel()]
