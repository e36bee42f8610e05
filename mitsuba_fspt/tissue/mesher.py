"""Tetrahedra from files: a tetrahedral mesh as stored, or a closed surface filled by the mesher fTetWild.

Border triangles of either stand for a smooth surface through their vertices (`smooth_surface`).
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from ..phantom.formats import read_mesh
from ..phantom.formats.stated_units import LENGTH_UNIT, require_length_unit
from ..phantom.length_unit import millimetres, own_unit, unit_warning
from ..phantom.surface_mesh import boundary, closure, require_joined
from ..runtime.errors import BackendError, FluxError
from .smooth_surface import SmoothSurface
from .tetrahedra import Tetrahedra, require_few

LOG = logging.getLogger("mitsuba_fspt")
OPTION = 'length_unit = "{}"'  # of the phantom file
ENVELOPE = 20  # edge over the largest distance between mesher's border and surface; later the border is moved onto it
ROUNDS = 5  # of moving vertices back whose move has flattened or inverted a cell
CRUSHED = 0.3  # least ratio of a cell's signed volumes after and before the move
Array = NDArray[np.float64]
Index = NDArray[np.int64]


def read_tetrahedra(
    path: str | os.PathLike[str], edge: float, length_unit: str | None = None, labels: str | None = None
) -> Tetrahedra:
    """Tetrahedra of a file; if it holds a closed surface, tetrahedra with edges of about `edge` [mm] that fill it.

    length_unit : 'mm', 'cm' or 'm'; None: m of a glTF file (.glb, .gltf), else mm. A size that is unusual for a phantom
        is told in a line on stderr.
    labels : name of the file's field of whole numbers, one per tetrahedron, used unchanged as the mesh's regions

    Any format of `fspt flux import` can be read.

    Raises
    ------
    FluxError : the file cannot be read, states another unit, its surface is open, or it lacks the field of labels.
    BackendError : a package to read or to mesh it is missing.
    """
    unit = own_unit(path) if length_unit is None else length_unit
    scale = millimetres(unit, "geometry")
    raw = read_mesh(path, None, None, "auto")
    require_length_unit(f"geometry: {raw.source}", raw.stated.get(LENGTH_UNIT), unit, OPTION)
    points = raw.points * scale
    diagonal = float(np.linalg.norm(np.ptp(points[raw.cells].reshape(-1, 3), axis=0)))
    if warning := unit_warning(diagonal, unit, OPTION):
        LOG.warning("fspt: geometry: %s: %s", raw.source, warning)
    if raw.cells.shape[1] == 3:
        if labels is not None:
            raise FluxError(
                f"geometry: '{path}' is a surface, it has no labels '{labels}' of tetrahedra. Leave them out."
            )
        return tetrahedralize(points, raw.cells, edge)
    require_joined(points, boundary(points, raw.cells)[0], f"geometry: {raw.source}")
    if labels is None:
        return _with_smooth_border(Tetrahedra(points, raw.cells).without_unused())
    found = [f for f in raw.fields if f.name == labels and f.values.shape == (len(raw.cells),)]
    if not found:
        names = ", ".join(f"'{f.name}'" for f in raw.fields) or "none"
        raise FluxError(
            f"geometry: '{path}' has no field '{labels}' with one value a tetrahedron. Fields it has: {names}."
        )
    values = found[0].values
    if not (values == np.round(values)).all():
        raise FluxError(f"geometry: the labels '{labels}' of '{path}' must be whole numbers. Name another field.")
    return _with_smooth_border(Tetrahedra(points, raw.cells, values.astype(np.int64)).without_unused())


def _with_smooth_border(mesh: Tetrahedra) -> Tetrahedra:
    """The same mesh, whose `snap` moves points onto the smooth surface through the vertices of its border."""
    return replace(mesh, snap=_SmoothBorder(mesh))


class _SmoothBorder:
    """Smooth surface through the vertices of a mesh's border, made when the first points are moved onto it."""

    def __init__(self, mesh: Tetrahedra) -> None:
        self._mesh = mesh

    @cached_property
    def _surface(self) -> SmoothSurface:
        """Of triangles of the border's own size: the cells inside may be much larger."""
        faces = self._mesh.border
        corners = self._mesh.vertices[faces]
        size = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
        return SmoothSurface(self._mesh.vertices, faces, size)

    def __call__(self, points: Array) -> Array:
        """Points (N, 3) [mm] moved onto the surface."""
        return self._surface.nearest(points)


def tetrahedralize(vertices: Array, faces: Index, edge: float) -> Tetrahedra:
    """Tetrahedra with edges of about `edge` [mm] in a closed surface, `vertices` (V, 3) [mm], `faces` (F, 3).

    Meshed by fTetWild; the border's vertices are moved onto the smooth surface through `vertices` (`smooth_surface`).
    The mesh differs a little from run to run.

    Raises
    ------
    FluxError : the surface is open, the edge is out of range, or there are no or more than 5 million tetrahedra.
    BackendError : pytetwild is not installed.
    """
    if not closure(vertices, faces).watertight:
        raise FluxError(
            f"geometry: the surface of {len(faces)} faces is not closed, so nothing is inside. Close its holes first."
        )
    try:
        import pytetwild
    except ImportError as cause:
        raise BackendError(
            f"flux solve: a mesher is needed to fill a surface ({cause}). pip install "
            "'mitsuba-fspt[mesher]', or give a tetrahedral mesh."
        ) from cause
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not 0 < edge <= diagonal:
        raise FluxError(
            f"geometry: the mesh edge must be > 0 and at most the size {diagonal:.3g} mm, got {edge:g}. Give mm."
        )
    volume = abs(float(np.linalg.det(vertices[faces]).sum())) / 6
    require_few(6 * math.sqrt(2) * volume, edge)  # regular tetrahedra
    with _in_temporary_folder():  # the mesher leaves a file in the current folder
        points, cells = pytetwild.tetrahedralize(
            np.ascontiguousarray(vertices, dtype=np.float64),
            np.ascontiguousarray(faces, dtype=np.int32),
            edge_length_fac=edge / diagonal,
            epsilon=edge / ENVELOPE / diagonal,
        )
    if len(cells) == 0:
        raise FluxError(f"geometry: the mesher filled the surface of {len(faces)} faces with nothing. Is it closed?")
    return _on_surface(Tetrahedra(points, cells), vertices, faces)


@contextmanager
def _in_temporary_folder() -> Iterator[None]:
    """Context manager that makes a temporary folder the current one."""
    here = os.getcwd()
    with TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(here)


def _on_surface(mesh: Tetrahedra, vertices: Array, faces: Index) -> Tetrahedra:
    """Mesh with its border vertices moved onto the surface; `snap` of the result moves other points there."""
    snap = SmoothSurface(vertices, faces, mesh.edge / 2).nearest
    border = np.unique(boundary(mesh.vertices, mesh.cells)[0])
    moved = mesh.vertices.copy()
    moved[border] = snap(moved[border])
    for _ in range(ROUNDS):
        # A flat cell can be inverted; its vertices return to their old positions.
        crushed = _determinants(moved, mesh.cells) / _determinants(mesh.vertices, mesh.cells) < CRUSHED
        kept = np.unique(mesh.cells[crushed])
        moved[kept] = mesh.vertices[kept]
    return Tetrahedra(moved, mesh.cells, snap=snap)


def _determinants(vertices: Array, cells: Index) -> Array:
    """Six times the signed volume of each cell [mm³]."""
    corners = vertices[cells]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))
