"""Readers of surface meshes with their fields: `.npz`, OBJ, OFF, and the formats of trimesh (STL, GLB, ...)."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import BackendError, FluxError, one_line
from ..length_unit import GLTF
from ..surface_mesh import merge
from .raw import Field, RawMesh, scalars
from .stated_units import LENGTH_UNIT, UP, length_of_name
from .table import read_npz, require_file

if TYPE_CHECKING:
    import trimesh

# Names that trimesh gives to the units of 3MF, of COLLADA, and of STEP, which it converts to m. Others, such as inch,
# are refused. A COLLADA file in metres may be one that states none.
UNITS = {"millimeter": "mm", "millimeters": "mm", "centimeter": "cm", "meter": "m", "meters": "m"}
UNITS |= {"0.001 * meters": "mm", "0.01 * meters": "cm"}
STATED_BY, METRES_IF_UNSTATED = ("3mf", "dae", "zae", "step", "stp"), ("dae", "zae")
PARTS = "fspt_parts"  # key of trimesh's metadata
# Formats that trimesh reads itself; it would pass any other on to meshio.
KINDS = ("stl", "off", "glb", "gltf", "3mf", "dae", "zae", "3dxml", "xaml", "ctm", "step", "stp")


def read_arrays(path: Path) -> RawMesh:
    """Mesh of a `.npz` with `vertices` (V, 3), `faces` (F, 3) or `tetrahedra` (T, 4) from 0, and fields of any name.

    `nodes` counts as `vertices`, and the names may have a suffix, as in `vertices_mm`, which states the unit.
    """
    arrays = read_npz(path)
    name = _named(arrays, ("vertices", "nodes"), path)
    points, cells = arrays[name], arrays[_named(arrays, ("faces", "tetrahedra"), path)]
    fields = tuple(
        Field(name, values, None)
        for name, values in arrays.items()
        if values.dtype.kind in "fiu" and values.shape in (points.shape[:1], cells.shape[:1])
    )
    length = length_of_name(name)
    stated = {} if length is None else {LENGTH_UNIT: length}
    return RawMesh(points.astype(np.float64), cells, path.name, fields, stated=stated)


def _named(arrays: dict[str, NDArray], words: tuple[str, ...], path: Path) -> str:
    """Name of the one array of two axes whose name is one of `words`, or starts with one and an underscore."""
    fitting = [n for n, a in arrays.items() if a.ndim == 2 and any(n == w or n.startswith(f"{w}_") for w in words)]
    if len(fitting) != 1:
        listed = ", ".join(f"'{name}' {array.shape}" for name, array in arrays.items())
        raise FluxError(f"'{path}' must have one array named {' or '.join(words)}, of two axes. It has {listed}.")
    return fitting[0]


def read_obj(path: Path) -> RawMesh:
    """Vertices and triangles of an OBJ in the order of its lines, on which a separate file of values relies.

    Normals, texture coordinates and materials are ignored: loaders that use them split and sort the vertices.
    """
    try:
        text = path.read_bytes()
    except OSError as cause:
        raise FluxError(f"'{path}' cannot be read: {cause.strerror}. Check the name.") from cause
    vertices = re.findall(rb"^[ \t]*v[ \t]+([^\r\n]*)", text, re.MULTILINE)
    faces = re.sub(rb"/\S*", b"", b"\n".join(re.findall(rb"^[ \t]*f[ \t]+([^\r\n]*)", text, re.MULTILINE)))
    if not vertices or not faces:
        raise FluxError(f"'{path}' has no vertices or no faces. Give an OBJ with lines v and f.")
    try:
        points = np.loadtxt([line.decode("ascii") for line in vertices], ndmin=2, usecols=(0, 1, 2))
        cells = np.loadtxt(faces.decode("ascii").split("\n"), ndmin=2, dtype=np.int64)
    except ValueError as cause:  # not a number, or faces with different numbers of corners
        raise FluxError(f"'{path}' is not an OBJ of triangles: {one_line(cause)}. Triangulate it first.") from cause
    if cells.shape[1] != 3 or cells.min() < 1:
        fault = f"{cells.shape[1]} corners a face" if cells.shape[1] != 3 else "relative vertex numbers"
        raise FluxError(f"'{path}' has {fault}. Save it with triangles and vertices numbered from 1.")
    return RawMesh(points, cells - 1, path.name)


def read_off(path: Path) -> RawMesh:
    """Vertices and triangles of an OFF file in its order; trimesh loads a file with colours or polygons."""
    return _plain_off(path) or read_trimesh(path)


def _plain_off(path: Path) -> RawMesh | None:
    """Mesh of an OFF file that holds only points and triangles, else None; trimesh reads such a file far slower."""
    try:
        text = re.sub(rb"#[^\r\n]*", b"", path.read_bytes()).lstrip()
    except OSError as cause:
        raise FluxError(f"'{path}' cannot be read: {cause.strerror}. Check the name.") from cause
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's warning at a word that is no number
            numbers = np.fromstring(text[3:], sep=" ")
    except (DeprecationWarning, ValueError):
        return None
    if not re.match(rb"OFF\s", text) or len(numbers) < 3:
        return None
    points, triangles = (int(n) if 0 < n < len(numbers) else 0 for n in numbers[:2])
    if not triangles or len(numbers) != 3 + 3 * points + 4 * triangles:
        return None
    cells = numbers[3 + 3 * points :].reshape(-1, 4)
    if not np.array_equal(cells, np.floor(cells)) or (cells[:, 0] != 3).any() or not np.isfinite(cells).all():
        return None
    return RawMesh(numbers[3 : 3 + 3 * points].reshape(-1, 3), cells[:, 1:].astype(np.int64), path.name)


def read_trimesh(path: Path) -> RawMesh:
    """Mesh loaded by trimesh, unchanged in order, with its scalar fields on vertices and faces.

    Equal corners of an STL are merged; its faces keep their order.

    Raises
    ------
    FluxError : trimesh does not support the format, cannot read the file, or finds no triangles in it.
    BackendError : the format needs a package that is not installed.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in KINDS:
        raise FluxError(
            f"'{path}': no reader for '.{kind}'. Known: .ply .stl .obj .off .glb .npz .vtu .vtk .msh .xdmf "
            ".mesh .inp, node_ID.dat (MMC), .node (NIRFAST). Convert it, or choose one by --format."
        )
    loaded = load_triangles(path, kind)
    points, cells = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    if kind == "stl":
        points, cells = merge(points, cells)
        return RawMesh(points, cells, path.name, point_order=False)
    length = _stated_length(kind, loaded.units)
    stated = {} if length is None else {LENGTH_UNIT: length}
    stated |= {UP: "y"} if path.suffix.lower() in GLTF else {}
    return RawMesh(points, cells, path.name, _fields(loaded), parts=loaded.metadata[PARTS], stated=stated)


def _stated_length(kind: str, units: str | None) -> str | None:
    """Unit of length that a file states, from trimesh's name of it; None for a file that states none."""
    if kind not in STATED_BY or not units or (kind in METRES_IF_UNSTATED and units == "meters"):
        return None
    return UNITS.get(units, units)


def load_triangles(path: Path, kind: str, **options: Any) -> trimesh.Trimesh:
    """trimesh's mesh of a file, its vertices and faces unprocessed; `PARTS` of its metadata: meshes it is joined from.

    Raises
    ------
    FluxError : the file cannot be read, or has no faces.
    BackendError : its format needs a package that is not installed.
    """
    import trimesh  # deferred: takes longer to load than most meshes

    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # NumPy's at a corner that is no number
            scene = trimesh.load_scene(path, process=False, **options)
            mesh = scene.to_mesh()
            parts = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
            mesh.metadata[PARTS] = sum(isinstance(part, trimesh.Trimesh) for part in parts)  # others: points, paths
        count = len(mesh.faces)
    except OSError as cause:
        raise FluxError(f"'{path}' cannot be read: {cause.strerror or one_line(cause)}. Check the name.") from cause
    except ImportError as cause:
        raise BackendError(
            f"'{path}' as .{kind} needs a package that is not installed: {one_line(cause)}. Install it by pip, or save "
            "the mesh anew, as .ply."
        ) from cause
    except Exception as cause:  # a damaged file makes trimesh's loaders raise anything
        raise FluxError(f"'{path}' cannot be read as .{kind}: {one_line(cause)}. Is the file damaged?") from cause
    if count == 0:
        raise FluxError(f"'{path}' holds no triangles, only points or lines. Give a surface mesh.")
    return mesh


def _fields(mesh: trimesh.Trimesh) -> tuple[Field, ...]:
    """Scalar attributes on vertices and faces."""
    on_vertices = [Field(name, np.asarray(v), "vertex") for name, v in mesh.vertex_attributes.items()]
    on_faces = [Field(name, np.asarray(v), "cell") for name, v in mesh.face_attributes.items()]
    return scalars(on_vertices + on_faces)
