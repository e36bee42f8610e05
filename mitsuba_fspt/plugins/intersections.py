"""Scenes whose ray tracing loses rays at mesh edges, and their cure.

Embree without its robust mode misses some rays that meet an edge or a vertex exactly. A scene cannot be asked which
mode it was built in, so the loss itself is looked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .elements import triangles

PROBES = 4096
STEP = 1e-4  # of the distance, from a probed vertex to its four neighbours in the test


def robust_scene(scene: mi.Scene, lens: mi.Sensor) -> mi.Scene:
    """`scene` itself, or, where it is seen to lose rays, the same shapes traced robustly (and a warning logged)."""
    if not loses_rays(scene, lens):
        return scene
    mi.Log(
        mi.LogLevel.Warn,
        "fspt_integral: this scene loses rays that meet mesh edges, so its shapes are set up anew. Put <boolean "
        'name="embree_use_robust_intersections" value="true"/> into the scene, or load it with mitsuba_fspt.load.',
    )
    return traced_robustly(scene.shapes())


def traced_robustly(shapes: Sequence[mi.Shape], beside: mi.Scene | None = None) -> mi.Scene:
    """A scene of these shapes in Embree's robust mode; `mi.load_dict` would give the shapes other names.

    On CUDA a kernel can trace rays in two scenes only where one of them was set up `beside` the other.
    """
    props = mi.Properties("scene")
    props["embree_use_robust_intersections"] = True
    if beside is not None:
        props["beside"] = beside
    for number, shape in enumerate(shapes):
        props[f"shape_{number}"] = shape
    return mi.Scene(props)


def loses_rays(scene: mi.Scene, lens: mi.Sensor) -> bool:
    """True if a ray from the lens to a mesh vertex meets nothing although four rays around it meet something."""
    if not mi.variant().startswith("llvm"):
        return False
    return any(_loses_rays(scene, lens, shape) for shape in scene.shapes() if shape.is_mesh())


def _loses_rays(scene: mi.Scene, lens: mi.Sensor, mesh: mi.Shape) -> bool:
    positions, _ = triangles(mesh)
    count = dr.width(positions) // 3
    index = dr.arange(mi.UInt32, min(count, PROBES)) * max(1, count // PROBES)
    target = dr.gather(mi.Point3f, positions, index)
    origin = lens.world_transform() @ mi.Point3f(0, 0, 0)
    d = mi.Vector3f(target - origin)
    frame = mi.Frame3f(dr.normalize(d))

    def meets(offset: mi.Vector3f) -> mi.Bool:
        return scene.ray_intersect_preliminary(mi.Ray3f(origin, dr.normalize(d + offset))).is_valid()

    around = mi.Bool(True)
    for side in (frame.s, -frame.s, frame.t, -frame.t):
        around &= meets(side * (STEP * dr.norm(d)))
    return bool(dr.any(around & ~meets(mi.Vector3f(0))))
