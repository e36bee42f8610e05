"""Scene in which Eq. 9's lines of sight are traced: the scene itself, or a robust copy if its tracing loses rays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...emission.face_table import shape_number
from ...emission.of_emitter import mark_of
from ...jit.mesh_buffers import box_of, buffers, flat
from ...jit.robust_tracing import robust_scene


@dataclass(frozen=True)
class RobustCopy:
    """Robust copy of a scene that loses rays: of its shapes alone, so that nothing in it refers to the integrator.

    state : marks of the emitters, and numbers and poses of the shapes that it was built from
    geometry : buffers of the shapes. Poses are compared by the indices of these buffers; while the buffers are kept, no
        other one can get the same index
    """

    scene: mi.Scene
    state: tuple[list[object], list[tuple[int, tuple[float, ...]]]]
    geometry: list[list[dr.ArrayBase]]


class TracedScene:
    """Cache of the decision; tested once, and again if the geometry of a copy changes."""

    def __init__(self) -> None:
        self._lossless: list[object] = []  # marks of the emitters of a scene that loses no rays
        self._robust: RobustCopy | None = None

    def of(self, scene: mi.Scene, camera: Camera) -> mi.Scene:
        """`scene`, or a robust copy if it loses rays."""
        marks = [mark_of(emitter) for emitter in scene.emitters()]
        if marks == self._lossless:
            return scene
        shapes, old = scene.shapes(), self._robust
        state = (marks, [(shape_number(shape), pose_of(shape)) for shape in shapes])
        if old is None or old.state != state:
            known = old is not None and old.state[0] == marks
            robust = robust_scene(scene, camera.to_world @ mi.Point3f(0, 0, 0), warn=not known)
            if robust is scene:
                self._lossless, self._robust = marks, None
                return scene
            self._robust = old = RobustCopy(robust, state, [geometry_of(shape) for shape in shapes])
        return old.scene


def geometry_of(shape: mi.Shape) -> list[dr.ArrayBase]:
    """Buffers of a shape's geometry, whose indices are part of its pose: vertices and faces, control points, a grid."""
    if shape.is_mesh():
        return list(buffers(shape))
    own = (flat(value) for name, value in mi.traverse(shape) if "." not in name)
    return [value for value in own if isinstance(value, mi.Float | mi.UInt32)]


def pose_of(shape: mi.Shape) -> tuple[float, ...]:
    """Bounding box of a shape, with the indices of its buffers and the matrix of its `to_world`."""
    own = box_of([shape])
    indices = (buffer.index for buffer in geometry_of(shape))
    pose = (*own.min, *own.max, *indices)
    parameters = mi.traverse(shape)
    if shape.is_mesh() or "to_world" not in parameters:
        return pose
    return (*pose, *np.ravel(parameters["to_world"].matrix).tolist())
