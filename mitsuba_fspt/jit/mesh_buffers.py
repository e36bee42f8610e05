"""Buffers of Mitsuba's meshes. Only this file uses their names, which change in Mitsuba 3.10."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi

POSITIONS, FACES = "vertex_positions", "faces"  # of `mi.traverse`


def face_count(mesh: mi.Shape) -> int:
    """Number of faces of a mesh."""
    return mesh.face_count()


def buffers(mesh: mi.Shape) -> tuple[mi.Float, mi.UInt32]:
    """Vertex positions (3 V,) [mm] and face indices (3 F,) of a mesh.

    They are copies that share the data, since the arrays that a mesh returns would keep the mesh alive.
    """
    return mi.Float(mesh.vertex_positions_buffer()), mi.UInt32(mesh.faces_buffer())


def triangles(shape: mi.Shape) -> tuple[mi.Float, mi.UInt32]:
    """Vertex positions (3 V,) [mm] and face indices (3 F,) of a mesh or of a rectangle.

    Mitsuba traces a rectangle as a mesh, but without such buffers.
    """
    parameters = mi.traverse(shape)
    if POSITIONS in parameters:
        return mi.Float(parameters[POSITIONS]), mi.UInt32(parameters[FACES])
    corners = mi.Transform4f(parameters["to_world"]) @ mi.Point3f([-1, 1, -1, 1], [-1, -1, 1, 1], 0)
    return dr.ravel(corners), mi.UInt32(1, 2, 0, 1, 3, 2)


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


def set_triangles(mesh: mi.Mesh, positions: Any, faces: Any) -> mi.Mesh:
    """`mesh` itself, updated to these vertex positions (3 V,) [mm] and face indices (3 F,)."""
    parameters = mi.traverse(mesh)
    parameters[POSITIONS], parameters[FACES] = positions, faces
    parameters.update()
    return mesh
