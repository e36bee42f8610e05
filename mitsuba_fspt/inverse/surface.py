"""The surface that the columns of a transport matrix stand for: its mesh, and its Laplace-Beltrami operator."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array

from ..phantom.surface_mesh import face_areas, merge
from ..rendering.provenance import own_frame, same_mesh, scale_of, scene_digest
from ..rendering.scene import load
from ..rendering.scene_xml import is_text
from ..runtime.errors import InversionError, SceneError
from .coarse_basis import coarser, neighbours
from .creases import CREASE, Creases

if TYPE_CHECKING:
    import mitsuba as mi

    from .transport_matrix import TransportMatrix

Array = NDArray[np.float64]
SLIVER = 1e-6  # least sine of an angle: a triangle flatter than that counts as if it had this one
LEAST = 500  # unknowns that are not made fewer
CREASE_ANGLE = 45.0  # degrees
AREA_TOLERANCE = 1e-3  # relative: float32 positions may change an area of the mesh by so much


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of all glowing meshes of a transport matrix, one after the other, in the order of its columns.

    vertices : (V, 3) [mm], in the frame of their file: before `to_world`;  faces : (F, 3), indices of vertices
    parts : shape id → slice of columns;  on : 'vertex' or 'face', what a column is
    number : (n,) the point of each column: coincident vertices of one mesh are one point
    basis : (points, m) the functions ψ of the m unknowns at the points (Eq. M.30); None: each point is an unknown
    scales : shape id → length in the scene [mm] of a length of 1 in the file, where that is not 1
    crease_angle : [degree] between the normals of two faces, above which J_n is not smoothed across their edge
    kinds, chosen : (m,) of the unknowns, their kind, see `creases`, and their point; None where they are the points
    nodes : with J_n on faces and a basis: the surface on vertices that has the same unknowns
    """

    vertices: Array
    faces: NDArray[np.int64]
    parts: Mapping[str, slice]
    on: str
    number: NDArray[np.int64]
    basis: csr_array | None = None
    scales: Mapping[str, float] = field(default_factory=dict)
    crease_angle: float = CREASE_ANGLE
    kinds: NDArray[np.int64] | None = None
    chosen: NDArray[np.int64] | None = None
    nodes: Surface | None = None

    @classmethod
    def of(cls, matrix: TransportMatrix, scene: object = None) -> Surface:
        """Surface of a matrix, from `scene` or, where that is None, from the scene that the matrix was made from.

        Parameters
        ----------
        matrix : transport matrix
        scene : Mitsuba scene, name of a scene file, text or dictionary, with the same meshes up to a rigid motion; or
            a Surface that was made so

        Raises
        ------
        InversionError : the scene cannot be found any more, or its meshes are not those of the matrix.
        """
        from ..jit.mesh_buffers import triangles

        if isinstance(scene, Surface):
            scene._require_areas(matrix.areas)
            return scene
        loaded = _scene_of(matrix, scene)
        vertices, faces, number, scales = [], [], [], {}
        first = unknowns = 0
        for emitter in loaded.emitters():
            shape = emitter.get_shape()
            positions, corners = (buffer.numpy() for buffer in triangles(shape))
            points = own_frame(loaded, shape, positions.reshape(-1, 3).astype(np.float64))
            if not np.isclose(scale := scale_of(loaded, shape), 1, rtol=1e-6):
                scales[shape.id()] = scale
            corner = corners.reshape(-1, 3).astype(np.int64)
            own = np.arange(len(corner)) if matrix.on == "face" else _joined(points)
            vertices.append(points)
            faces.append(corner + first)
            number.append(own + unknowns)
            first, unknowns = first + len(points), unknowns + int(own.max()) + 1
        mesh = np.concatenate(vertices), np.concatenate(faces)
        found = cls(*mesh, matrix.parts, matrix.on, np.concatenate(number), scales=scales)
        found._require_areas(matrix.areas)
        return found

    @property
    def unknowns(self) -> int:
        """Number m of unknowns."""
        return self.points if self.basis is None else int(self.basis.shape[1])

    @cached_property
    def points(self) -> int:
        """Number of points."""
        return int(self.number.max()) + 1

    @cached_property
    def spread(self) -> csr_array:
        """(n, m): J_n of the columns from the unknowns; rows sum to 1."""
        n = len(self.number)
        joined = csr_array((np.ones(n), (np.arange(n), self.number)), shape=(n, self.points))
        return joined if self.basis is None else csr_array(joined @ self.basis)

    @cached_property
    def from_vertices(self) -> csr_array:
        """(n, V): J_n of the columns from its values at `vertices`; on a face the mean of its corners."""
        if self.on == "vertex":
            return csr_array(diags_array(np.ones(len(self.vertices))))
        entries = np.full(self.faces.size, 1 / 3), (np.repeat(np.arange(len(self.faces)), 3), self.faces.ravel())
        return csr_array(entries, shape=(len(self.faces), len(self.vertices)))

    @cached_property
    def point_areas(self) -> Array:
        """(points,) ∫ φ dS of each point [mm²], the lumped mass of the mesh."""
        area = face_areas(self.vertices, self.faces)
        if self.on == "face":
            return area
        return np.bincount(self._corners.ravel(), np.repeat(area / 3, 3), self.points).astype(np.float64)

    @cached_property
    def areas(self) -> Array:
        """(m,) ∫ ψ dS of each unknown [mm²], the lumped mass."""
        return self.point_areas if self.basis is None else np.asarray(self.basis.T @ self.point_areas)

    @cached_property
    def stiffness(self) -> csr_array:
        """(m, m) of −Δ: ∫ ∇ψ_i · ∇ψ_j dS for vertices (Eq. M.22); over faces, lengths of edges over distances."""
        if self.nodes is not None:
            return self.nodes.stiffness
        return self._on_unknowns(self._of_faces() if self.on == "face" else self._of_vertices())

    @cached_property
    def roughness(self) -> tuple[csr_array, Array]:
        """Operator R (m, m) and measure μ (m,) of −Δ J_n = R J_n/μ at the unknowns (Eq. M.33).

        Off the creases R is the stiffness and μ the area [mm²]. On a crease they are those of the second derivative
        along it, times the length [mm] of the crease that belongs to the unknown, so that μ is an area, too. Where
        creases meet or bend away there is none: rows of 0.
        """
        if self.nodes is not None:
            return self.nodes.roughness
        kinds, ways = self._kinds_and_ways
        if self.kinds is not None:
            kinds = self.kinds
        on, off = (kinds == CREASE).astype(float), (kinds < CREASE).astype(float)
        inverse = ways.copy()
        inverse.data = 1 / np.maximum(inverse.data, np.finfo(float).tiny)
        along = self._on_unknowns(csr_array(diags_array(inverse.sum(axis=1)) - inverse))
        length = np.asarray(ways.sum(axis=1)) / 2
        length = length if self.basis is None else np.asarray(self.basis.T @ length)
        mass = np.where(self.areas > 0, self.areas, self.areas.max())
        operator = diags_array(off) @ self.stiffness + diags_array(on * length) @ along
        operator.eliminate_zeros()
        return csr_array(operator), np.where(kinds == CREASE, length**2, mass)

    def _on_unknowns(self, operator: csr_array) -> csr_array:
        """The operator (points, points) on the unknowns, (m, m)."""
        return operator if self.basis is None else csr_array(self.basis.T @ operator @ self.basis)

    @cached_property
    def creases(self) -> Creases:
        """Creases of the meshes."""
        if self.on == "vertex":
            corners, size = self._corners, self.points
        else:
            places, corners = merge(self.vertices, self.faces)
            size = len(places)
        return Creases(corners, self.vertices[self.faces], size, self.crease_angle)

    @cached_property
    def _kinds_and_ways(self) -> tuple[NDArray[np.int64], csr_array]:
        """Kind of each point (points,), and ways [mm] between neighbours along creases (points, points)."""
        return self.creases.of_faces() if self.on == "face" else self.creases.of_vertices()

    def coarser(self) -> list[Surface]:
        """This surface, and the same with fewer and fewer unknowns, a half to a quarter each time, to some hundred.

        Of J_n on faces the second has its unknowns on the vertices, whose mean is that of a face.
        """
        if self.on == "face":
            places, corners = merge(self.vertices, self.faces)
            number = np.empty(len(self.vertices), np.int64)
            number[self.faces] = corners
            whole = replace(self, on="vertex", number=number)
            entries = np.full(corners.size, 1 / 3), (np.repeat(np.arange(len(corners)), 3), corners.ravel())
            mean = csr_array(entries, shape=(len(corners), len(places)))
            levels = whole.coarser()
            bases = [mean if one.basis is None else csr_array(mean @ one.basis) for one in levels]
            return [self, *(replace(self, basis=b, nodes=one) for b, one in zip(bases, levels, strict=True))]
        found, kinds = [self], self._kinds_and_ways[0]
        places = np.empty((self.points, 3))
        places[self.number] = self.vertices
        graph = neighbours(self._corners, len(places))
        while len(places) > LEAST:
            basis, graph, chosen = coarser(graph, places, kinds)
            if len(chosen) > 0.7 * len(places):  # pieces of few vertices, which stay as they are
                break
            places, kinds, last = places[chosen], kinds[chosen], found[-1]
            whole = basis if last.basis is None else csr_array(last.basis @ basis)
            points = chosen if last.chosen is None else last.chosen[chosen]
            found.append(replace(self, basis=whole, kinds=kinds, chosen=points))
        return found

    def carried(self, x: Array, coarse: Surface) -> Array:
        """(m,) the unknowns of this surface from those of a coarser one of the same list of `coarser`."""
        if self.on == "face" and self.basis is None:
            return x if coarse.basis is None else np.asarray(coarse.basis @ x)
        fine, source = self.nodes or self, coarse.nodes or coarse
        values = x if source.basis is None else np.asarray(source.basis @ x)
        return values if fine.chosen is None else values[fine.chosen]

    @property
    def _corners(self) -> NDArray[np.int64]:
        """(F, 3) points of the corners of each face, on vertices."""
        return self.number[self.faces]

    def _of_vertices(self) -> csr_array:
        """Cotangents of the angles opposite to each edge, halved (Eq. M.22)."""
        points = self.vertices[self.faces]
        rows, columns, values = [], [], []
        for k in range(3):
            one, other = points[:, (k + 1) % 3] - points[:, k], points[:, (k + 2) % 3] - points[:, k]
            sine = np.linalg.norm(np.cross(one, other), axis=1)
            lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
            floor = np.maximum(SLIVER * lengths, np.finfo(float).tiny)
            rows.append(self._corners[:, (k + 1) % 3])
            columns.append(self._corners[:, (k + 2) % 3])
            values.append(0.5 * np.einsum("fi,fi->f", one, other) / np.maximum(sine, floor))
        return _laplacian(np.concatenate(rows), np.concatenate(columns), np.concatenate(values), self.points)

    def _of_faces(self) -> csr_array:
        """For the two faces of an edge: its length over the way from centre to centre by the middle of the edge."""
        _, corners = merge(self.vertices, self.faces)
        points = self.vertices[self.faces]
        centre = points.mean(axis=1)
        edges = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        ends = np.concatenate([points[:, [k, (k + 1) % 3]] for k in range(3)])
        owner = np.tile(np.arange(len(corners)), 3)
        order = np.lexsort(edges.T)
        same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
        one, other = order[:-1][same], order[1:][same]
        middle, length = ends[one].mean(axis=1), np.linalg.norm(ends[one, 1] - ends[one, 0], axis=1)
        way = sum(np.linalg.norm(centre[owner[k]] - middle, axis=1) for k in (one, other))
        return _laplacian(owner[one], owner[other], length / np.maximum(way, 1e-30), self.points)

    def _require_areas(self, areas: Array) -> None:
        """Raise InversionError where the areas of the columns differ from those that the matrix was made with."""
        true, own = self.point_areas, np.bincount(self.number, areas, self.points)
        if len(areas) != len(self.number) or np.abs(own - true).max() > AREA_TOLERANCE * true.max():
            raise InversionError(
                "invert: the meshes of the scene have other areas than those of the matrix. Give 'scene', the scene "
                "that the matrix was made from, or make the matrix again."
            )


def _laplacian(rows: NDArray[np.int64], columns: NDArray[np.int64], values: Array, size: int) -> csr_array:
    """Symmetric matrix with −`values` beside the diagonal and rows that sum to 0."""
    beside = coo_array((values, (rows, columns)), shape=(size, size)).tocsr()
    beside = beside + beside.T
    return csr_array(diags_array(np.asarray(beside.sum(axis=1)).ravel()) - beside)


def _joined(points: Array) -> NDArray[np.int64]:
    """(V,) number of each vertex, the same for vertices at the same position."""
    _, number = np.unique(points, axis=0, return_inverse=True)
    return number.ravel().astype(np.int64)


def _scene_of(matrix: TransportMatrix, scene: object) -> mi.Scene:
    """Scene with the meshes of the matrix, as its defaults place them."""
    name = str(matrix.metadata["scene"])
    digest = str(matrix.metadata["mesh_digest"])
    if scene is not None:
        whole: Any = load(scene) if isinstance(scene, (str, os.PathLike, Mapping)) else scene
        if not hasattr(whole, "emitters"):
            raise InversionError(
                f"invert: 'scene' must be a scene, the name of its file, its text or a dictionary, got "
                f"{type(scene).__name__}. Leave it out where the scene of the matrix has not moved."
            )
        if not same_mesh(scene_digest(whole), digest):
            raise InversionError(
                "invert: 'scene' has other meshes than the matrix. Give the scene that the matrix was made from."
            )
        return whole
    if is_text(name) or not Path(name).is_file():
        raise InversionError(
            f"invert: the meshes of the matrix stood in the scene '{name}', which cannot be read again. Give it as "
            "'scene', a file or a loaded scene."
        )
    given: list[dict[str, Any]] = [{}, {k: v for k, v in matrix.views[0].items() if k != "sensor"}]
    for parameters in given:  # the scene's own placement where its defaults show the same mesh
        try:
            whole = load(name, **parameters)
        except SceneError as error:
            raise InversionError(f"invert: the matrix was made from a scene that fails: {error}") from error
        if same_mesh(scene_digest(whole), digest):
            return whole
    raise InversionError(
        f"invert: the meshes of '{name}' have changed since the matrix was made. Make it again with 'fspt matrix'."
    )
