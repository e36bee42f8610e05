"""Eq. 9 over triangle meshes in float64 NumPy, without tracing a ray.

The lines of sight through one point a of the pupil are a central projection. The vertices are projected through a onto
the virtual detector plane, and the triangles are rasterised onto the sample points of the film, with a depth buffer.
The samples form a grid of k × k points per pixel, which is shifted from one point a to the next, so that pupil points
and samples together cover pixel × pupil. Independently shifted lattices of pupil points give the mean and its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import ReferenceCamera
from .sampled import lattice
from .shapes import Array, unit_disc

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class TriangleMesh:
    """Opaque triangles that emit on their outward side (corners anticlockwise when seen from outside).

    Parameters
    ----------
    vertices : (V, 3) [mm]
    faces : (F, 3) vertex numbers
    exitance : J_n [W/mm²] at the corners of each face, (F, 3), linear between: `J[faces]` for one value a
        vertex, `np.repeat(J[:, None], 3, axis=1)` for one a face

    Raises
    ------
    ValueError : the shape of `exitance` is not that of `faces`.
    """

    vertices: Array
    faces: Indices
    exitance: Array

    def __post_init__(self) -> None:
        if self.exitance.shape != self.faces.shape:
            raise ValueError(
                f"reference mesh: exitance of shape {self.exitance.shape} must have the faces' shape"
                f" {self.faces.shape}. Give its values at the corners."
            )

    def closed(self) -> bool:
        """True if the mesh is the boundary of solid bodies, so that no inward side is visible from outside.

        Every directed edge then occurs once in the opposite direction, and the volume is positive.
        """
        start, end = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        count = len(self.vertices)
        edges = np.sort(start * count + end)
        sealed = np.array_equal(edges, np.sort(end * count + start)) and bool(np.all(np.diff(edges)))
        return sealed and bool(np.linalg.det(self.vertices[self.faces]).sum() > 0)


def load_ply(path: str | Path) -> TriangleMesh:
    """Mesh of a PLY file whose vertices or faces carry the property `exitance_x` [W/mm²].

    Raises ValueError for a file that cannot be read as triangles, ValueError for one without the property.
    """
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        raw = mesh.metadata["_ply_raw"]
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise ValueError(f"{path}: no PLY triangle mesh ({error}). Give a PLY file.") from error
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    for element in ("vertex", "face"):
        data = raw[element]["data"]
        if "exitance_x" in data.dtype.names:
            values = np.asarray(data["exitance_x"], np.float64).ravel()
            corners = values[faces] if element == "vertex" else np.repeat(values[:, None], 3, axis=1)
            return TriangleMesh(vertices, faces, corners)
    raise ValueError(f"{path}: no property 'exitance_x' on vertices or faces. Write J_n [W/mm²] under that name.")


def mesh_truth(
    camera: ReferenceCamera,
    mesh: TriangleMesh,
    levels: Sequence[tuple[int, int]] = ((64, 4), (2048, 4)),
    tolerance: float = 3e-6,
    region: ArrayLike | None = None,
    replicas: int = 8,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Power on each pixel, integrated over its area, and its standard error [W], (height, width) each.

    Parameters
    ----------
    levels : for each level the number of pupil points of one lattice, a power of two, and the number of sample points
        along a pixel's side. A level computes anew the pixels whose own or neighbour's error exceeds `tolerance` × the
        brightest pixel of the region
    region : (height, width) mask of the pixels to compute, None for all; the result is NaN on the others
    replicas : number of independently shifted lattices, ≥ 2; the result is their mean, the error its standard error
    seed : of the shifts

    Raises
    ------
    ValueError : the mesh reaches the lens plane.

    Notes
    -----
    On silhouettes the error falls about as (nodes · samples²)^(−3/4), elsewhere faster. All pixels have the same
    shifts, so that the RMS of the stated error over the film is uncertain, too: by a third with 4 replicas, by a fifth
    with 8. Memory: about 100 bytes for each sample of one node that sees the mesh; compute a large film region by
    region.
    """
    wanted = np.ones((camera.height, camera.width), bool) if region is None else np.array(region, dtype=bool)
    power, error = np.full((2, *wanted.shape), np.nan)
    random = np.random.default_rng(seed)
    view = _View.of(camera, mesh)
    hard = wanted
    for nodes, samples in levels:
        if not hard.any():
            break
        near = view.part(hard)
        runs = np.stack([near.run(lattice(nodes, random.random(4)), samples) for _ in range(replicas)])
        power[hard] = runs.mean(axis=0)[hard]
        error[hard] = (runs.std(axis=0, ddof=1) / np.sqrt(replicas))[hard]
        hard = wanted & _widened(np.nan_to_num(error) > tolerance * np.nanmax(power))
    return power, error


@dataclass(frozen=True)
class _View:
    """Faces in the camera frame: `corners` (xyz, corner, F), `exitance` (corner, F); `closed` as in the mesh."""

    camera: ReferenceCamera
    corners: Array
    exitance: Array
    closed: bool

    @classmethod
    def of(cls, camera: ReferenceCamera, mesh: TriangleMesh) -> _View:
        corners = np.ascontiguousarray(camera.from_world(mesh.vertices)[mesh.faces].T)
        nearest = corners[2].min()
        if not nearest > 0:
            raise ValueError(
                f"reference mesh: reaches z = {nearest:g} mm, must stay in front of the lens plane z = 0."
                " Move the camera back."
            )
        return cls(camera, corners, np.ascontiguousarray(mesh.exitance.T), mesh.closed())

    def film(self, pupil: Array) -> Array:
        """Corners seen from a point of the pupil, in pixels from the film's upper left, (xy, corner, F)."""
        x, y, z = self.corners
        shrink = self.camera.focus_distance / z
        virtual = np.stack([pupil[0] + (x - pupil[0]) * shrink, pupil[1] + (y - pupil[1]) * shrink])
        middle = np.array([self.camera.width / 2, self.camera.height / 2])
        return middle[:, None, None] - virtual / self.camera.pixel_side

    def part(self, region: Mask) -> _View:
        """The faces that are visible from some point of the pupil in some pixel of the region."""
        blur = np.abs(1 - self.camera.focus_distance / self.corners[2])
        blur = blur * self.camera.pupil_radius / self.camera.pixel_side
        film, size = self.film(np.zeros(2)), np.array(region.shape[::-1])[:, None]
        low = np.clip(np.floor((film - blur).min(axis=1)), 0, size).astype(int)
        high = np.clip(np.floor((film + blur).max(axis=1)) + 1, low, size).astype(int)
        # Summed-area table: the number of the region's pixels in any rectangle by four look-ups.
        table = np.pad(region.cumsum(axis=0, dtype=int).cumsum(axis=1), ((1, 0), (1, 0)))
        (left, top), (right, bottom) = low, high
        met = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left] > 0
        return _View(self.camera, self.corners[..., met], self.exitance[:, met], self.closed)

    def run(self, nodes: Array, samples: int) -> Array:
        """Power on each pixel [W] by one lattice of (pupil, grid shift) nodes: (n, 4) in the unit cube."""
        camera = self.camera
        pupil, shift = camera.pupil_radius * unit_disc(nodes[:, :2]), nodes[:, 2:]
        total: Array = np.zeros(camera.height * camera.width)
        depth = np.zeros(total.size * samples**2)
        # A node takes operations on some 10⁵ array elements, so that the overhead of this loop is negligible.
        for a, s in zip(pupil, shift, strict=True):
            total += self.radiate(a, s, samples, depth)
        return camera.scale / (len(nodes) * samples**2) * total.reshape(camera.height, camera.width)

    def radiate(self, pupil: Array, shift: Array, samples: int, depth: Array) -> Array:
        """Σ J_n cos⁴θ [W/mm²] over the samples of each pixel, seen from one pupil point, shape (height·width,).

        Samples lie at (m + shift)/samples within a pixel, m = 0 … samples − 1 along both sides. `depth` is a buffer
        with one entry per sample, all 0 before and after.
        """
        camera = self.camera
        film = self.film(pupil) * samples - shift[:, None, None]  # puts the samples at the integers
        turn = _turn(film)
        drawn = np.flatnonzero(turn < 0 if self.closed else turn)
        film, turn = film[..., drawn], turn[drawn]
        face, row, column = _scan(film, samples * camera.width, samples * camera.height)
        # By perspective 1/z and J_n/z are linear on the film, J_n itself is not.
        inverse = 1 / self.corners[2][:, drawn]
        near = _linear(_planes(film, turn, inverse), face, row, column)
        first = _nearest(row * (samples * camera.width) + column, near, depth)
        if not self.closed:
            first = first[turn[face[first]] < 0]
        face, row, column = face[first], row[first], column[first]
        flux = _planes(film, turn, inverse * self.exitance[:, drawn])
        seen = _linear(flux, face, row, column) / near[first]
        x = (camera.width / 2 - (column + shift[0]) / samples) * camera.pixel_side - pupil[0]
        y = (camera.height / 2 - (row + shift[1]) / samples) * camera.pixel_side - pupil[1]
        cos2 = camera.focus_distance**2 / (x * x + y * y + camera.focus_distance**2)
        pixel = (row // samples) * camera.width + column // samples
        return np.bincount(pixel, seen * cos2**2, minlength=camera.width * camera.height).astype(np.float64)


def _nearest(sample: Indices, near: Array, depth: Array) -> Indices:
    """Indices of the points (sample number, 1/z) that are the nearest of their sample, one for each sample met."""
    np.maximum.at(depth, sample, near)
    first = np.flatnonzero(near == depth[sample])
    # If two are equal to the bit, only the later one is kept, so that no sample counts twice.
    place = sample[first]
    depth[place] = first
    first = first[depth[place] == first]
    depth[place] = 0
    return first


def _scan(film: Array, width: int, height: int) -> tuple[Indices, Indices, Indices]:
    """(face, row, column) of every integer point of the film inside a triangle of `film`, (xy, corner, F).

    Neighbouring triangles compute their common edge from the same numbers in the same order, so that no point is lost
    or counted twice.
    """
    x, y = np.take_along_axis(film, np.argsort(film[1], axis=0)[None], axis=1)
    face, row = _ranges(y[0], y[2], height)
    upper = row < y[1, face]
    # Each row runs between the long edge 0-2 and one of the short edges 0-1 and 1-2.
    ends = []
    for low, high in ((0, 2), (np.where(upper, 0, 1), np.where(upper, 1, 2))):
        x0, y0, x1, y1 = x[low, face], y[low, face], x[high, face], y[high, face]
        ends.append(x0 + (row - y0) * ((x1 - x0) / (y1 - y0)))
    span, column = _ranges(np.minimum(*ends), np.maximum(*ends), width)
    return face[span], row[span], column


def _ranges(low: Array, high: Array, size: int) -> tuple[Indices, Indices]:
    """(interval, integer) for all integers of [0, size) in each half-open interval low ≤ integer < high."""
    first = np.clip(np.ceil(low), 0, size).astype(np.int64)
    last = np.clip(np.ceil(high), 0, size).astype(np.int64)
    count = last - first
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - (np.cumsum(count) - count - first)[owner]


def _turn(film: Array) -> Array:
    """Twice the signed area of each triangle, (F,); negative where the outward side is visible."""
    (x0, x1, x2), (y0, y1, y2) = film
    return (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)


def _planes(film: Array, turn: Array, values: Array) -> Array:
    """Linear functions with these corner values: value at the film's origin, slopes along x and y, (3, F)."""
    (x0, x1, x2), (y0, y1, y2) = film
    value, rise, climb = values[0], values[1] - values[0], values[2] - values[0]
    along_x = (rise * (y2 - y0) - climb * (y1 - y0)) / turn
    along_y = (climb * (x1 - x0) - rise * (x2 - x0)) / turn
    return np.stack([value - along_x * x0 - along_y * y0, along_x, along_y])


def _linear(planes: Array, face: Indices, row: Indices, column: Indices) -> Array:
    """Their values at integer points."""
    return planes[0, face] + planes[1, face] * column + planes[2, face] * row


def _widened(mask: Mask) -> Mask:
    """The mask with the neighbours of its pixels, which may have an undetected error of the same kind."""
    height, width = mask.shape
    padded = np.pad(mask, 1)
    return np.any([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
