"""Buffers of Mitsuba's meshes. Only this file uses their names and shapes, which change in Mitsuba 3.10.

Mitsuba 3.9 has flat arrays `vertex_positions` (3 V,), `vertex_normals` (3 V,), `faces` (3 F,) and attributes (d V,),
and fills a mesh after its construction. Mitsuba 3.10 has tensors `positions` (P, 3), `normals`, `faces` (F, 3) and
attributes (V, d); vertices may share positions, so that `geometric_faces()` has the indices of positions, and a mesh is
made from its data. Both are told apart by what the objects have, not by the version. 3.10 was not released when this
was written: the tests imitate it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

POSITIONS, NORMALS = ("vertex_positions", "positions"), ("vertex_normals", "normals")  # of `mi.traverse`: 3.9, 3.10
FACES = "faces"


def flat(values: Any) -> Any:
    """Values of an array, or of a tensor row by row, as a flat array; gradients are kept."""
    return values.array if dr.is_tensor_v(values) else values


def shaped_like(old: Any, values: Any) -> Any:
    """Values, flat, as an array or tensor of the type of `old`, which has as many numbers in a row."""
    if dr.is_tensor_v(old):
        width = old.shape[1]
        return type(old)(type(old.array)(values), shape=(len(values) // width, width))
    return type(old)(values)


def motions_of(parameters: Any, prefix: str = "") -> dict[str, float]:
    """Names of vertex positions and normals among a mesh's parameters, with their fourth homogeneous coordinate."""
    kinds = [(name, 1.0) for name in POSITIONS] + [(name, 0.0) for name in NORMALS]
    return {f"{prefix}{name}": fourth for name, fourth in kinds if f"{prefix}{name}" in parameters}


def face_count(mesh: mi.Shape) -> int:
    """Number of faces of a mesh."""
    return mesh.face_count()


def is_shaded_smoothly(mesh: mi.Shape) -> bool:
    """True if BSDFs see a normal that varies over the faces of a mesh; that of a `cube` does not."""
    return mesh.class_name() != "Cube" and bool(mesh.has_vertex_normals())


def shading_normals(mesh: mi.Shape) -> NDArray[np.float64]:
    """Normals (V, 3) at the vertices of a mesh; none, (0, 3), for one without."""
    parameters = mi.traverse(mesh)
    found = [flat(parameters[name]).numpy() for name in NORMALS if name in parameters]
    return np.reshape(found[0] if found else [], (-1, 3)).astype(np.float64)


def buffers(mesh: mi.Shape) -> tuple[mi.Float, mi.UInt32]:
    """Vertex positions (3 V,) [mm] and face indices (3 F,) of a mesh.

    They are copies that share the data, since the arrays that a mesh returns would keep the mesh alive.
    """
    if hasattr(mesh, "vertex_positions_buffer"):
        return mi.Float(mesh.vertex_positions_buffer()), mi.UInt32(mesh.faces_buffer())
    return _of_parameters(mesh, mi.traverse(mesh))


def _of_parameters(mesh: mi.Shape, parameters: Any) -> tuple[mi.Float, mi.UInt32]:
    """`buffers` from the parameters of a mesh, in either version of Mitsuba."""
    (positions,) = (parameters[name] for name in POSITIONS if name in parameters)
    faces = mesh.geometric_faces() if hasattr(mesh, "geometric_faces") else parameters[FACES]
    return mi.Float(flat(positions)), mi.UInt32(flat(faces))


def triangles(shape: mi.Shape) -> tuple[mi.Float, mi.UInt32]:
    """Vertex positions (3 V,) [mm] and face indices (3 F,) of a mesh or of a rectangle.

    Mitsuba traces a rectangle as a mesh, but without such buffers.
    """
    parameters = mi.traverse(shape)
    if any(name in parameters for name in POSITIONS):
        return _of_parameters(shape, parameters)
    corners = mi.Transform4f(parameters["to_world"]) @ mi.Point3f([-1, 1, -1, 1], [-1, -1, 1, 1], 0)
    return dr.ravel(corners), mi.UInt32(1, 2, 0, 1, 3, 2)


def corners_of_faces(mesh: mi.Shape) -> NDArray[np.float64]:
    """Corners of the faces of a mesh or of a rectangle, (F, 3, 3) [mm]."""
    positions, faces = triangles(mesh)
    return positions.numpy().reshape(-1, 3).astype(np.float64)[faces.numpy().reshape(-1, 3)]


def box_of(shapes: Iterable[mi.Shape]) -> mi.ScalarBoundingBox3f:
    """Bounding box of shapes [mm]; of vertices where Mitsuba gives none, as of rectangles that it has merged."""
    box = mi.ScalarBoundingBox3f()
    for shape in shapes:
        own = shape.bbox()
        if not own.valid() and shape.is_mesh():
            points = triangles(shape)[0].numpy().reshape(-1, 3)
            own = mi.ScalarBoundingBox3f(points.min(axis=0), points.max(axis=0))
        box.expand(own)
    return box


def new_mesh(name: str, positions: Any, faces: Any, props: mi.Properties | None = None) -> mi.Mesh:
    """Mesh of these vertex positions (3 V,) [mm] and face indices (3 F,), flat, with further properties."""
    props = mi.Properties() if props is None else props
    positions, faces = mi.Float(positions), mi.UInt32(faces)
    if hasattr(mi.Mesh, "geometric_faces"):
        tensors = {
            "faces": mi.TensorXu(faces, (len(faces) // 3, 3)),
            "positions": mi.TensorXf(positions, (len(positions) // 3, 3)),
        }
        return mi.Mesh(name, **tensors, props=props)
    mesh = mi.Mesh(name, dr.width(positions) // 3, dr.width(faces) // 3, props=props)
    parameters = mi.traverse(mesh)
    parameters[POSITIONS[0]], parameters[FACES] = positions, faces
    parameters.update()
    return mesh


def add_attribute(mesh: mi.Mesh, name: str, values: Any) -> None:
    """Give a mesh an attribute of one number for each vertex or face."""
    if hasattr(mesh, "geometric_faces"):
        mesh.add_attribute(name, mi.TensorXf(mi.Float(values), (len(values), 1)))
    else:
        mesh.add_attribute(name, 1, mi.Float(values))
