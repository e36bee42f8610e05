"""PLY files: read with scalar properties and comments, written in the layout that Mitsuba reads."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...runtime.atomic_files import atomic_path
from ...runtime.errors import FluxError
from ...runtime.ply_file import require_ply, require_whole
from ..surface_mesh import Indices, Points
from .raw import Field, RawMesh, scalars
from .stated_units import LENGTH_UNIT, LENGTHS, QUANTITY, VALUE_UNIT
from .surface_files import load_triangles

# Properties of geometry and colour.
NOT_VALUES = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
TEXTURE = {"s", "t", "u", "v"}
GROUPED = re.compile(r"(\w+)_[x01]")  # of a scalar that Mitsuba reads as a mesh attribute


def read_ply(path: Path) -> tuple[RawMesh, dict[str, str]]:
    """Triangles of a PLY with their scalar properties, in the file's order, and its comments by first word.

    Raises
    ------
    FluxError : the file cannot be read, ends early, or holds no triangles.
    """
    require_ply(path, FluxError)
    require_whole(path, FluxError)
    # Texture coordinates would make trimesh split the vertices.
    mesh = load_triangles(path, "ply", fix_texture=False, skip_materials=True)
    elements = mesh.metadata.get("_ply_raw", {})
    for element, count in (("vertex", len(mesh.vertices)), ("face", len(mesh.faces))):
        declared = elements.get(element, {}).get("length", 0)
        if count < declared:  # more is right: a polygon gives several triangles
            raise FluxError(
                f"'{path}' ends early: its header tells of {declared} {element} lines, there are {count}. Fix it."
            )
    _require_corners(elements.get("face", {}).get("data", {}), path)
    fields = []
    for on, element in (("vertex", "vertex"), ("cell", "face")):
        data = elements.get(element, {}).get("data", {})
        names = (data.dtype.names or ()) if isinstance(data, np.ndarray) else data
        values = {name: np.asarray(data[name]) for name in names if name not in NOT_VALUES}
        # trimesh splits polygons of more than three corners; values on faces then do not fit.
        fitting = len(mesh.vertices if on == "vertex" else mesh.faces)
        fields += [Field(name, v, on, name in TEXTURE) for name, v in values.items() if len(v) == fitting]
    points, cells = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    comments = _comments(path)
    stated = {key: comments[key] for key in (VALUE_UNIT, QUANTITY) if key in comments}
    if (length := comments.get(LENGTH_UNIT)) in LENGTHS:
        stated[LENGTH_UNIT] = str(length)
    return RawMesh(points, cells, path.name, scalars(fields), stated=stated), comments


def attribute_name(name: str) -> str:
    """Name of the attribute that Mitsuba makes of a property, 'jn' of 'jn_x'; '' if Mitsuba ignores the property."""
    grouped = GROUPED.fullmatch(name)
    return grouped[1] if grouped else ""


def _require_corners(faces: Any, path: Path) -> None:
    """Raise FluxError for face lines that trimesh would drop or misread: polygons in binary form, fewer than 3 corners.

    faces : as trimesh has read them, an array of records (binary) or columns of the lines (text)
    """
    binary = isinstance(faces, np.ndarray)
    names = (faces.dtype.names or ()) if binary else faces
    for name in {"vertex_indices", "vertex_index"} & set(names):
        corners = faces[name]["f0"] if binary else np.array([np.size(line) for line in faces[name]])
        if binary and np.ptp(corners):
            raise FluxError(
                f"'{path}' has faces of different numbers of corners, in binary form. Triangulate it first."
            )
        if corners.min() < 3:
            raise FluxError(f"'{path}' has faces of {corners.min()} corners, a face has 3 or more. Remove them.")


def _comments(path: Path) -> dict[str, str]:
    """Comments of the header by their first word."""
    comments = {}
    with path.open("rb") as file:
        for line in file:
            word, _, text = line.decode("utf-8", "replace").strip().partition(" ")
            if word == "end_header":
                break
            if word == "comment":
                key, _, value = text.partition(" ")
                comments[key] = value
    return comments


def write_ply(
    path: Path,
    vertices: Points,
    faces: Indices,
    attributes: Mapping[str, NDArray[np.float64]],
    per: str,
    comments: Mapping[str, str],
) -> None:
    """Write triangles with scalar properties on each 'vertex' or 'face' (`per`) as a binary PLY of doubles.

    Mitsuba reads a property whose name ends in an underscore and a letter or digit as a mesh attribute: `exitance_x`
    becomes `vertex_exitance` or `face_exitance`. It ignores a plain `exitance`.

    Raises
    ------
    FluxError : the suffix is not .ply, or the file cannot be written; no partial file remains.
    """
    if path.suffix.lower() != ".ply":
        raise FluxError(f"output file '{path}' must end in .ply. Give a name such as phantom.ply.")
    scalars = [(name, "<f8") for name in attributes]
    points = np.empty(len(vertices), [(axis, "<f8") for axis in "xyz"] + scalars * (per == "vertex"))
    triangles = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", (3,))] + scalars * (per == "face"))
    for k, axis in enumerate("xyz"):
        points[axis] = vertices[:, k]
    triangles["count"], triangles["corners"] = 3, faces
    for name, values in attributes.items():
        (points if per == "vertex" else triangles)[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {key} {' '.join(text.split())}" for key, text in comments.items()]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property double {name}" for name in points.dtype.names or ()]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [f"property double {name}" for name in (triangles.dtype.names or ())[2:]]
    header += ["end_header", ""]
    with atomic_path(path, FluxError) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("utf-8", "backslashreplace"))
        file.write(points.tobytes())
        file.write(triangles.tobytes())
