"""Buffers of Mitsuba's meshes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def triangles(shape: mi.Shape) -> tuple[mi.Float, mi.UInt32]:
    """Vertex positions and face indices of a mesh, flat as Mitsuba keeps them."""
    buffers = mi.traverse(shape)
    if "vertex_positions" in buffers:
        # Copies, which share the data: what traverse hands out keeps the shape alive.
        return mi.Float(buffers["vertex_positions"]), mi.UInt32(buffers["faces"])
    # A rectangle is a mesh, too, of which only the place is told.
    corners = mi.Transform4f(buffers["to_world"]) @ mi.Point3f([-1, 1, -1, 1], [-1, -1, 1, 1], 0)
    return dr.ravel(corners), mi.UInt32(1, 2, 0, 1, 3, 2)
