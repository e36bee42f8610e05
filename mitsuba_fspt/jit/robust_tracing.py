"""Scenes whose ray tracing loses rays at mesh edges, and their cure.

Embree without its robust mode misses some rays that meet an edge or a vertex exactly. A scene cannot be asked which
mode it was built in, so the loss itself is looked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .mesh_buffers import triangles

PROBES = 4096
STEP = 1e-4  # of the distance, from a probed point to its four neighbours in the test
STEPS = (3242174889, 2447445414)  # of the R₂ sequence, in units of 2⁻³²: even over edges and places on them


def robust_scene(scene: mi.Scene, lens: mi.Sensor) -> mi.Scene:
    """`scene` itself, or, where it is seen to lose rays, the same shapes traced robustly (and a warning logged)."""
    lost = lost_rays(scene, lens)
    if not lost:
        return scene
    robust = traced_robustly(scene.shapes())
    if lost_rays(robust, lens) >= lost:  # as of a scene that is robust: a few are lost in any case
        return scene
    mi.Log(
        mi.LogLevel.Warn,
        "fspt_integral: this scene loses rays that meet mesh edges, so its shapes are set up anew. Put <boolean "
        'name="embree_use_robust_intersections" value="true"/> into the scene, or load it with mitsuba_fspt.load.',
    )
    return robust


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


def lost_rays(scene: mi.Scene, lens: mi.Sensor) -> int:
    """How many rays from the lens to points on edges meet nothing although four rays around each meet something."""
    if not mi.variant().startswith("llvm"):
        return 0
    return sum(_lost_rays(scene, lens, shape) for shape in scene.shapes() if shape.is_mesh())


def _lost_rays(scene: mi.Scene, lens: mi.Sensor, mesh: mi.Shape) -> int:
    target, origin = _points_on_edges(mesh), lens.world_transform() @ mi.Point3f(0, 0, 0)
    d = mi.Vector3f(target - origin)
    frame = mi.Frame3f(dr.normalize(d))

    def meets(offset: mi.Vector3f, together: bool = False) -> mi.Bool:
        ray = mi.Ray3f(origin, dr.normalize(d + offset))
        return scene.ray_intersect_preliminary(ray, coherent=together).is_valid()

    around = mi.Bool(True)
    for side in (frame.s, -frame.s, frame.t, -frame.t):
        around &= meets(side * (STEP * dr.norm(d)))
    # Packets have a code of their own, which loses others.
    return sum(int(dr.count(around & ~meets(mi.Vector3f(0), together))[0]) for together in (False, True))


def _points_on_edges(mesh: mi.Shape) -> mi.Point3f:
    """`PROBES` points on edges all over a mesh, several on each where its faces are fewer."""
    positions, faces = triangles(mesh)
    count = max(1, dr.width(faces) // 3)
    number = dr.arange(mi.UInt32, PROBES)
    face = number * max(1, count // PROBES) % count
    edge, place = (mi.Float(number * step) * 2.0**-32 for step in STEPS)
    start = mi.UInt32(3 * edge)
    ends = [dr.gather(mi.UInt32, faces, 3 * face + corner % 3) for corner in (start, start + 1)]
    a, b = (dr.gather(mi.Point3f, positions, end) for end in ends)
    return mi.Point3f(dr.lerp(a, b, place))
