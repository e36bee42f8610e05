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
    FluxError : a face belongs to more than two tetrahedra, or each to one, as of quadrangles.
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
    if len(on_boundary) == len(faces) > 4:
        raise FluxError(
            f"tetrahedra: no two of the {len(tetrahedra)} share a face, as if their four corners were those of "
            "quadrangles. Split quadrangles into two triangles each, or join the nodes of the tetrahedra."
        )
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
    """Closure and orientation of a surface; corners at equal positions count as one.

    A million faces take about half a second.
    """
    faces = _bounding(points, faces)
    if not len(faces):
        return Closure(False, 0, None, 0)
    if not _without_rim(faces):
        _, count, forward = _edges(faces, len(points))
        watertight = bool((count % 2 == 0).all())
        # On a closed surface as many faces traverse an edge in one direction as in the other.
        twisted = int(np.count_nonzero(np.abs(2 * forward - count) > count % 2))
        if not watertight or twisted:
            return Closure(watertight, twisted, None, 0)
    inside_out, pieces = _inside_out(points, faces)
    return Closure(True, 0, inside_out, pieces)


def repeated(points: Points, faces: Indices) -> int:
    """Number of faces that repeat another one, with the same corners and the same outward side."""
    keys = _keys(_bounding(points, faces))
    return len(keys) - len(np.unique(keys))


def require_joined(points: Points, faces: Indices, where: str) -> None:
    """Raise FluxError, which begins with `where`, if border `faces` of tetrahedra lie on each other, face to face.

    Parts that touch there have nodes of their own, so that no light would pass between them.
    """
    faces = _bounding(points, faces)
    if count := len(np.intersect1d(_keys(faces), _keys(faces[:, ::-1]))):
        raise FluxError(
            f"{where}: {count // 2} border faces of tetrahedra lie on others, where parts touch whose nodes are not "
            "joined. Merge nodes at equal positions, for example by 'Coherence Mesh' in Gmsh."
        )


def _keys(faces: Indices) -> NDArray[np.uint64]:
    """Pseudo-random number of 64 bits for each face, the same for the same corners in the same sense of rotation."""
    first = faces.argmin(axis=1)[:, None]
    corners = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1).astype(np.uint64)
    key = np.zeros(len(faces), np.uint64)
    for corner in corners.T:
        key = _mixed(key + corner + np.uint64(1))
    return key


def turned_share(points: Points, faces: Indices) -> float:
    """Share of the area whose faces point to the wrong side, 0 … 1, on a surface with inconsistent orientations.

    Faces are turned over until neighbours agree, across edges of two faces. A connected piece that is then closed has
    its outward side where its volume is positive, without regard to cavities; of an open piece the larger area is
    right.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = _bounding(points, faces)
    order, count, _ = _edges(faces, len(points))
    first = (np.cumsum(count) - count)[count == 2]
    one, other = order[first], order[first + 1]  # places in faces.ravel() where the edge begins
    start = faces.ravel()
    same = start[one] == start[other]  # both traverse the edge in the same direction: one of them is turned
    one, other, number = one // 3, other // 3, len(faces)
    # Node f stands for face f as it is, node f + F for the face turned over; what goes together is connected.
    rows, columns = np.r_[one, one + number], np.r_[other + number * same, other + number * ~same]
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * number, 2 * number))
    label = connected_components(graph, directed=False)[1].reshape(2, number)
    piece, sign = label.min(axis=0), np.where(label[0] <= label[1], 1.0, -1.0)
    normals = face_normals(points, faces)
    areas = np.linalg.norm(normals, axis=1)
    middle = points[start].mean(axis=0)
    heights = np.einsum("ij,ij->i", normals, points[faces[:, 0]] - middle)
    rims = np.zeros(label.max() + 1, bool)
    rims[piece[order[np.repeat(count % 2 == 1, count)] // 3]] = True
    weights = np.where(rims[piece], areas, heights)
    sign *= np.where(np.bincount(piece, sign * weights)[piece] < 0, -1, 1)
    return float(areas[sign < 0].sum() / areas.sum())


def _bounding(points: Points, faces: Indices) -> Indices:
    """The faces with corners at equal positions merged, without those that are a line or a point."""
    points = np.ascontiguousarray(points + 0.0)  # -0 becomes 0
    place = np.zeros(len(points), np.uint64)
    for bits in points.view(np.uint64 if points.dtype == np.float64 else np.uint32).T:
        place = _mixed(place ^ bits)
    # Two positions share a number of 64 bits by a chance of 1e-7 on a million points.
    _, first, number = np.unique(place, return_index=True, return_inverse=True)
    if len(first) < len(points):
        faces = first[number.ravel()][faces]
    faces = faces.astype(np.int32)  # half the memory to read
    a, b, c = faces.T
    apart = (a != b) & (b != c) & (c != a)
    return faces if apart.all() else faces[apart]


def _mixed(number: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Pseudo-random 64-bit number for each number; different numbers have different ones."""
    for factor in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB):
        number = (number ^ (number >> np.uint64(31))) * np.uint64(factor)
    return number ^ (number >> np.uint64(29))


def _without_rim(faces: Indices) -> bool:
    """True if as many faces traverse every edge in one direction as in the other.

    Each edge has a random number of 64 bits, which is added in one direction and subtracted in the other: the sum is 0,
    or by a chance of 2⁻⁶⁴ for another surface.
    """
    total = 0
    for start, end in zip(faces.T, np.roll(faces, -1, axis=1).T, strict=True):
        low, high = np.minimum(start, end), np.maximum(start, end)
        edge = _mixed((low.astype(np.uint64) << np.uint64(32)) + high.astype(np.uint64))
        forward = start < end
        total += int(edge[forward].sum()) - int(edge[~forward].sum())
    return total % 2**64 == 0


def _edges(faces: Indices, number: int) -> tuple[Indices, Indices, Indices]:
    """The edges of faces whose corners are below `number`.

    Returns the places in `faces.ravel()` at which they begin, edge by edge (3 F,), and of each edge the number of faces
    and of those that traverse it from the lower corner to the higher one.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end).astype(np.int64) * number + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    key = key[order]
    begins = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if key.size else order
    count = np.diff(np.r_[begins, key.size])
    forward = np.add.reduceat((start < end)[order].astype(np.int64), begins) if key.size else count
    return order, count, forward


def _inside_out(points: Points, faces: Indices) -> tuple[int, int]:
    """Number of pieces of a closed surface whose faces point to the wrong side, and number of all pieces."""
    piece, first = _pieces(len(points), faces)
    # Positions relative to a corner of the piece: far from the origin the terms of the volume would cancel.
    origin = points[faces[first, 0]].astype(np.float64)
    a, b, c = (points[corner] - (origin[piece] if len(first) > 1 else origin) for corner in faces.T)
    normals = np.cross(b - a, c - a) / 2
    volumes = np.bincount(piece, weights=np.einsum("ij,ij->i", normals, a)) / 3
    areas = np.bincount(piece, weights=np.sqrt(np.einsum("ij,ij->i", normals, normals)))
    # A sheet with a face on either side has no volume, only rounding error, and counts as right.
    hollow = np.flatnonzero(volumes < -1e-9 * areas**1.5)  # few: cavities and inverted pieces
    if len(hollow) == 0:
        return 0, len(first)
    corners = points[faces].astype(np.float64)
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


def _pieces(count: int, faces: Indices) -> tuple[Indices, Indices]:
    """Number of the connected piece of each face (F,), and the first face of each piece."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    # A graph of the faces, which come first, and of `count` points: each face is connected with its corners.
    total = len(faces)
    ends = np.minimum(3 * np.arange(total + count + 1), 3 * total).astype(np.int32)
    corners = np.int32(total) + faces.ravel()
    graph = csr_array((np.ones(3 * total), corners, ends), shape=(total + count, total + count))
    piece = connected_components(graph, directed=False)[1][:total].astype(np.int64)
    first = np.full(piece.max() + 1, total)
    np.minimum.at(first, piece, np.arange(total))
    used = first < total  # points without faces are pieces, too
    return (np.cumsum(used) - 1)[piece], first[used]


def _multiplicity(triples: Indices, count: int) -> Indices:
    """Number of occurrences of each row of `triples` (N, 3) among all rows; rows are sorted, entries below `count`."""
    pair = triples[:, 0] * count + triples[:, 1]
    if count > 2**21:  # three such numbers no longer fit in 63 bits: number the pairs first
        _, pair = np.unique(pair, return_inverse=True)
    _, inverse, counts = np.unique(pair * count + triples[:, 2], return_inverse=True, return_counts=True)
    return counts[inverse.ravel()]
