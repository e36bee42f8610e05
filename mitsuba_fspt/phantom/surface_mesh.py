"""Triangle surfaces in space: areas, the boundary of tetrahedra, and whether a surface is closed and outward.

Pure NumPy on `points` of shape (V, 3), `faces` of shape (F, 3) and `tetrahedra` of shape (T, 4), indices from
0. The outward side of a face is the one from which its corners run anticlockwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FluxError

Points = NDArray[np.float64]
Indices = NDArray[np.int64]

# Local faces of a tetrahedron in the order of MMC and of iso2mesh's rowmajor `faceneighbors`, each with the
# corner opposite to it.
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
TETRAHEDRON_OPPOSITE = np.array([3, 2, 1, 0])


def face_normals(points: Points, faces: Indices) -> Points:
    """Vector area of each face, shape (F, 3): outward, its length the area [unit of `points`, squared]."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def face_areas(points: Points, faces: Indices) -> NDArray[np.float64]:
    """Area of each face, shape (F,), >= 0 [length unit of `points`, squared]."""
    return np.linalg.norm(face_normals(points, faces), axis=1)


def boundary(points: Points, tetrahedra: Indices) -> tuple[Indices, Indices]:
    """Faces (F, 3) that belong to one tetrahedron only, outward, and that tetrahedron's number (F,).

    They come tetrahedron by tetrahedron, within one in the order (1,2,3) (1,2,4) (1,3,4) (2,3,4). The corner
    opposite to a face tells which side is outward; the order of a tetrahedron's own corners has no say in it.

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
    """The same faces, in the same order, on points that are all different; none are merged that differ.

    A format without shared corners (STL) repeats a corner for each of its faces.
    """
    order = np.lexsort(points.T)
    ordered = points[order]
    new = np.ones(len(points), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(points), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return ordered[new], number[faces]


def compact(points: Points, faces: Indices) -> tuple[Points, Indices, Indices]:
    """Only the points that the faces use, in order: (points, renumbered faces, numbers of those points)."""
    used = np.zeros(len(points), dtype=bool)
    used[faces.ravel()] = True
    kept = np.flatnonzero(used)
    number = np.cumsum(used) - 1
    return points[kept], number[faces], kept


@dataclass(frozen=True)
class Closure:
    """How a surface closes.

    watertight : every edge has a face on either side
    twisted : number of edges that both their faces walk in the same direction; 0 on a surface with two sides
    inside_out : number of closed pieces that are inside out; None unless watertight and not twisted. A piece
        that shows towards its own middle is right where it is the wall of a cavity in another piece.
    pieces : number of connected pieces; 0 where `inside_out` is None
    """

    watertight: bool
    twisted: int
    inside_out: int | None
    pieces: int

    @property
    def outward(self) -> bool | None:
        """Whether every face shows outward; None where an open surface leaves that undecided."""
        if self.twisted:
            return False
        return None if self.inside_out is None else self.inside_out == 0


def closure(points: Points, faces: Indices) -> Closure:
    """Whether the surface is closed and shows outward; corners at the same place count as one."""
    points, faces = merge(points, faces)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[distinct]  # a face that is a line or a point bounds nothing
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge, count = np.unique(low * len(points) + high, return_inverse=True, return_counts=True)
    forward = np.bincount(edge.ravel(), weights=start < end, minlength=len(count))
    watertight = bool(len(count)) and bool((count % 2 == 0).all())
    # As many faces walk an edge one way as the other; the one face at a rim has no partner.
    twisted = int(np.count_nonzero(np.abs(2 * forward - count) > count % 2))
    if not watertight or twisted:
        return Closure(watertight, twisted, None, 0)
    inside_out, pieces = _inside_out(points, faces)
    return Closure(True, 0, inside_out, pieces)


def _inside_out(points: Points, faces: Indices) -> tuple[int, int]:
    """Number of pieces of a closed surface that are inside out, and of all pieces."""
    label = _pieces(len(points), faces)[faces[:, 0]]
    _, first, piece = np.unique(label, return_index=True, return_inverse=True)
    corners, normals = points[faces], face_normals(points, faces)
    # About a corner of the piece: far from the origin the volume would cancel.
    heights = corners[:, 0] - corners[first, 0][piece]
    volumes = np.bincount(piece, weights=np.einsum("ij,ij->i", normals, heights)) / 3
    areas = np.bincount(piece, weights=np.linalg.norm(normals, axis=1))
    # A sheet with a face on either side has no volume, only rounding, and is right as it is.
    hollow = np.flatnonzero(volumes < -1e-9 * areas**1.5)  # few: cavities and mistakes
    if len(hollow) == 0:
        return 0, len(first)
    lowest, highest = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    wrong = 0
    for number in hollow:
        # A point of no particular place on the piece: the line upwards meets no edge of an aligned mesh.
        point = np.array([0.5377, 0.2719, 0.1904]) @ corners[first[number]]
        near = ((lowest <= point[:2]) & (highest >= point[:2])).all(axis=1) & (piece != number)
        wrong += _crossings_above(point, corners[near]) <= 0
    return wrong, len(first)


def _crossings_above(point: Points, corners: NDArray[np.float64]) -> int:
    """Faces met on the way up from `point`, outward ones minus inward ones: 1 inside a body, 0 outside."""
    x, y, z = np.moveaxis(corners - point, 2, 0)
    side = x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)  # twice the area of (origin, corner, next)
    up, down = (side > 0).all(axis=1), (side < 0).all(axis=1)
    height = np.einsum("ij,ij->i", np.roll(side, -1, axis=1), z)  # barycentric, times the sign of the face
    return int(np.count_nonzero(up & (height > 0)) - np.count_nonzero(down & (height < 0)))


def _pieces(count: int, faces: Indices) -> Indices:
    """For each of `count` points the smallest number of a point that the faces connect it with."""
    label = np.arange(count)
    while True:
        before = label.copy()
        lowest = label[faces].min(axis=1).repeat(3)
        np.minimum.at(label, before[faces.ravel()], lowest)  # hook whole trees, not single points
        np.minimum.at(label, faces.ravel(), lowest)
        label = label[label]
        if np.array_equal(label, before):
            return label


def _multiplicity(triples: Indices, count: int) -> Indices:
    """How often each row of `triples` (sorted in the row, numbers below `count`) occurs among all rows."""
    pair = triples[:, 0] * count + triples[:, 1]
    if count > 2**21:  # three such numbers no longer fit in 63 bits: number the pairs first
        _, pair = np.unique(pair, return_inverse=True)
    _, inverse, counts = np.unique(pair * count + triples[:, 2], return_inverse=True, return_counts=True)
    return counts[inverse.ravel()]
