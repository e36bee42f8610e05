"""Bodies that hide nothing of themselves: what leaves a convex one outwards never meets it again."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .elements import elements_of, triangles

ROUND = ("Sphere", "Disk", "Cylinder")  # shapes that are convex if their normals point outwards
PROBES = 1 << 8


def hides_nothing(scene: mi.Scene) -> bool:
    """True of one convex body alone, whose outward side no line of sight to it crosses anything before."""
    shapes = scene.shapes()
    if len(shapes) != 1:
        return False
    shape = shapes[0]
    return _mesh_is_convex(shape) if shape.is_mesh() else _is_round(shape)


def _mesh_is_convex(mesh: mi.Shape) -> bool:
    """Closed, in one piece, turned outwards and nowhere bent inwards."""
    import trimesh

    positions, faces = (buffer.numpy().reshape(-1, 3) for buffer in triangles(mesh))
    body = trimesh.Trimesh(positions, faces)
    return bool(body.is_watertight and body.is_winding_consistent and body.is_convex and body.volume > 0) and (
        body.body_count == 1
    )


def _is_round(shape: mi.Shape) -> bool:
    if shape.class_name() not in ROUND:
        return False
    elements = elements_of(shape, PROBES)
    si, _ = elements.place(dr.arange(mi.UInt32, elements.count), mi.Point2f(0.5))
    return bool(dr.all(dr.dot(si.n, si.p - mi.Point3f(shape.bbox().center())) >= 0))
