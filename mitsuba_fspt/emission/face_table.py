"""Table of all faces of a scene of meshes, read where a line of sight ends.

Mitsuba's surface interaction loads the corners of the face, computes the point between them again and calls shape,
emitter and texture through pointers. If J_n is linear on every face and the radiance equal in all outward directions,
the radiance at the three corners and the normal suffice: eight numbers, half a cache line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.mesh_buffers import buffers, face_count
from .elements import elements_of
from .of_emitter import edition_of, surface_of


@dataclass(frozen=True)
class FaceTable:
    """All faces of a scene's meshes; shapes that are no mesh and do not emit have dark faces.

    first : index in the table of the first face of each shape, by the shape's number
    table : eight numbers per face: the least radiance at its corners, the excess over it at each corner [W/mm²/sr],
        the normal, 0
    sources : buffers of the meshes. `editions_of` compares their Dr.Jit indices; while they are kept, no other buffer
        can get the same index
    """

    first: mi.UInt32
    table: mi.Float
    sources: tuple[Any, ...]

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape]) -> FaceTable | None:
        """Table of the faces of these shapes; None if an emitter is no mesh, J_n not linear or the law another."""
        first: dict[int, int] = {}
        tables, begin = [], 0
        for shape in shapes:
            if shape.is_mesh():
                radiance = _radiance_at_corners(shape)
                if radiance is None:
                    return None
                tables.append(_table(shape, radiance))
            else:
                tables.append(dr.zeros(mi.Float, 8 * max(1, shape.primitive_count())))
            first[shape_number(shape)] = begin
            begin += dr.width(tables[-1]) // 8
        starts = mi.UInt32([first.get(number, 0) for number in range(max(first, default=0) + 1)])
        table = dr.concat(tables)
        dr.eval(starts, table)
        return cls(starts, table, tuple(buffers(shape) for shape in shapes if shape.is_mesh()))

    def radiance(self, pi: mi.PreliminaryIntersection3f, direction: mi.Vector3f) -> mi.Float:
        """Radiance [W/mm²/sr] towards the origin of a ray with `direction` that meets a face; 0 on the inward side."""
        met = pi.is_valid()
        face = dr.gather(mi.UInt32, self.first, _number(pi.shape), met) + pi.prim_index
        least, normal = (dr.gather(mi.Vector4f, self.table, 2 * face + half, met) for half in (0, 1))
        u, v = pi.prim_uv.x, pi.prim_uv.y
        radiance = least.x + dr.maximum(1 - u - v, 0) * least.y + u * least.z + v * least.w
        towards = normal.x * direction.x + normal.y * direction.y + normal.z * direction.z
        return dr.select(met & (towards < 0), radiance, 0)


def editions_of(shapes: Sequence[mi.Shape]) -> list[tuple[Any, ...]] | None:
    """Key of the data that `FaceTable.of` depends on, for a checked scene; None unless every emitter is a mesh."""
    if not all(shape.is_mesh() or shape.emitter() is None for shape in shapes):
        return None
    return [_edition(shape) for shape in shapes]


def _edition(mesh: mi.Shape) -> tuple[Any, ...]:
    """Key of one mesh: shape, indices of its buffers, emitter and edition of J_n. For other shapes: the shape alone."""
    if not mesh.is_mesh():
        return (shape_number(mesh),)
    return shape_number(mesh), *(buffer.index for buffer in buffers(mesh)), *edition_of(mesh.emitter())


def _number(shape: mi.ShapePtr) -> mi.UInt32:
    """Dr.Jit's number of each shape."""
    return dr.reinterpret_array(mi.UInt32, shape)


def shape_number(shape: mi.Shape) -> int:
    """Dr.Jit's number of a shape among all existing shapes, as intersection records contain it."""
    return int(_number(mi.ShapePtr(shape))[0])


def _radiance_at_corners(mesh: mi.Shape) -> tuple[mi.Float, ...] | None:
    """Radiance [W/mm²/sr] at the three corners of every face, 0 without an emitter; None as in `FaceTable.of`."""
    emitter = mesh.emitter()
    if emitter is None:
        return (dr.zeros(mi.Float, face_count(mesh)),) * 3
    surface = surface_of(emitter)
    return surface.radiance_at_corners() if surface else None


def _table(mesh: mi.Shape, radiance: tuple[mi.Float, ...]) -> mi.Float:
    """Eight numbers for each face of a mesh, see `FaceTable`."""
    elements = elements_of(mesh, minimum=1)
    si, _ = elements.place(dr.arange(mi.UInt32, elements.count), mi.Point2f(*elements.middle))
    # On a sliver the normal or J_n may be NaN: the face is dark.
    sound = dr.all(dr.isfinite(si.n)) & dr.all(dr.isfinite(mi.Vector3f(*radiance)))
    # Excess over the least corner: equal corners give an equal radiance between them, and a dim corner beside a bright
    # one keeps its digits.
    least = dr.minimum(dr.minimum(radiance[0], radiance[1]), radiance[2])
    columns = [least, *(corner - least for corner in radiance), si.n.x, si.n.y, si.n.z, mi.Float(0)]
    table = dr.empty(mi.Float, 8 * elements.count)
    index = 8 * dr.arange(mi.UInt32, elements.count)
    for k, column in enumerate(columns):
        dr.scatter(table, dr.select(sound, column, 0), index + k)
    return table
