"""Detection of scenes whose ray tracing loses rays at mesh edges, and robust copies of them.

Without its robust mode Embree misses some rays that meet an edge or a vertex exactly. A scene does not report in which
mode it was built, so the loss is detected by test rays.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .mesh_buffers import triangles

PROBES = 4096  # points on the edges of each mesh
STEP = 1e-4  # distance between a tested point and its four neighbours, over the distance from the lens
STEPS = (3242174889, 2447445414)  # of the R₂ sequence, in units of 2⁻³²: uniform over edges and positions on them


def robust_scene(scene: mi.Scene, centre: mi.Point3f, warn: bool = True) -> mi.Scene:
    """`scene` itself, or, if it loses rays, a scene of the same shapes in Embree's robust mode, by default with a
    warning.
    """
    lost = lost_rays(scene, centre)
    if not lost:
        return scene
    robust = traced_robustly(scene.shapes())
    if lost_rays(robust, centre) >= lost:  # `scene` was robust: a few rays are lost in any case
        return scene
    if warn:
        mi.Log(
            mi.LogLevel.Warn,
            "fspt_integral: this scene loses rays that meet mesh edges, so its shapes are set up anew. Put <boolean "
            'name="embree_use_robust_intersections" value="true"/> into the scene, or load it with mitsuba_fspt.load.',
        )
    return robust


def traced_robustly(shapes: Sequence[mi.Shape], beside: mi.Scene | None = None) -> mi.Scene:
    """Scene of these shapes in Embree's robust mode; `mi.load_dict` would give the shapes other names.

    On CUDA a kernel can trace rays in two scenes only if one of them was built `beside` the other.
    """
    props = mi.Properties("scene")
    props["embree_use_robust_intersections"] = True
    if beside is not None:
        props["beside"] = beside
    for number, shape in enumerate(shapes):
        props[f"shape_{number}"] = shape
    return mi.Scene(props)


def lost_rays(scene: mi.Scene, centre: mi.Point3f) -> int:
    """Number of rays from the lens's `centre` to points on edges that meet no shape while four rays around each do."""
    if not mi.variant().startswith("llvm"):
        return 0
    return sum(_lost_rays(scene, centre, shape) for shape in scene.shapes() if shape.is_mesh())


def _lost_rays(scene: mi.Scene, centre: mi.Point3f, mesh: mi.Shape) -> int:
    """Number of rays lost at the edges of one mesh."""
    target, origin = _points_on_edges(mesh), centre
    d = mi.Vector3f(target - origin)
    frame = mi.Frame3f(dr.normalize(d))

    def meets(offset: mi.Vector3f, together: bool = False) -> mi.Bool:
        ray = mi.Ray3f(origin, dr.normalize(d + offset))
        return scene.ray_intersect_preliminary(ray, coherent=together).is_valid()

    around = mi.Bool(True)
    for side in (frame.s, -frame.s, frame.t, -frame.t):
        around &= meets(side * (STEP * dr.norm(d)))
    # Embree traces packets of rays by different code, which loses different rays.
    return sum(int(dr.count(around & ~meets(mi.Vector3f(0), together))[0]) for together in (False, True))


def _points_on_edges(mesh: mi.Shape) -> mi.Point3f:
    """`PROBES` points on edges all over a mesh, several per face if it has fewer faces."""
    positions, faces = triangles(mesh)
    count = max(1, dr.width(faces) // 3)
    number = dr.arange(mi.UInt32, PROBES)
    face = number * max(1, count // PROBES) % count
    edge, position = (mi.Float(number * step) * 2.0**-32 for step in STEPS)
    start = mi.UInt32(3 * edge)
    ends = [dr.gather(mi.UInt32, faces, 3 * face + corner % 3) for corner in (start, start + 1)]
    a, b = (dr.gather(mi.Point3f, positions, end) for end in ends)
    return mi.Point3f(dr.lerp(a, b, position))
