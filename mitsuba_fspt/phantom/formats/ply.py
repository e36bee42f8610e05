"""PLY: read with its scalar properties and comments, written as Mitsuba reads it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...runtime.atomic_files import atomic_path
from ...runtime.errors import FluxError
from ..surface_mesh import Indices, Points
from .raw import Field, RawMesh, scalars
from .surface_files import load_triangles

# Properties that are geometry or colour.
NOT_VALUES = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
TEXTURE = {"s", "t", "u", "v"}


def read_ply(path: Path) -> tuple[RawMesh, dict[str, str]]:
    """A PLY's triangles with their scalar properties, in the file's order, and its comments by first word.

    Raises
    ------
    FluxError : the file cannot be read, ends early, or holds no triangles.
    """
    # Texture coordinates would make trimesh split the vertices.
    mesh = load_triangles(path, "ply", fix_texture=False, skip_materials=True)
    elements = mesh.metadata.get("_ply_raw", {})
    for element, count in (("vertex", len(mesh.vertices)), ("face", len(mesh.faces))):
        told = elements.get(element, {}).get("length", 0)
        if count < told:  # polygons may be more triangles
            raise FluxError(
                f"'{path}' ends early: its header tells of {told} {element} lines, there are {count}. Mend it."
            )
    _require_corners(elements.get("face", {}).get("data", {}), path)
    fields = []
    for on, element in (("vertex", "vertex"), ("cell", "face")):
        data = elements.get(element, {}).get("data", {})
        names = (data.dtype.names or ()) if isinstance(data, np.ndarray) else data
        values = {name: np.asarray(data[name]) for name in names if name not in NOT_VALUES}
        # trimesh splits polygons of more than three corners: then values on faces no longer fit.
        fitting = len(mesh.vertices if on == "vertex" else mesh.faces)
        fields += [Field(name, v, on, name in TEXTURE) for name, v in values.items() if len(v) == fitting]
    points, cells = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return RawMesh(points, cells, path.name, scalars(fields)), _comments(path)


def _require_corners(faces: Any, path: Path) -> None:
    """Refuse faces that trimesh drops or misreads; of their lines it keeps an array (binary) or columns (text)."""
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

    Mitsuba makes mesh attributes of properties that end in an underscore and a letter or digit: `exitance_x`
    becomes `vertex_exitance` or `face_exitance`; a plain `exitance` it passes over.

    Raises
    ------
    FluxError : the suffix is not .ply, or the file cannot be written; nothing is left behind then.
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
