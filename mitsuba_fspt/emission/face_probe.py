"""The face of a mesh that a sampled position lies on: a position sample does not say, a short ray finds it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..jit.mesh_buffers import set_triangles, triangles
from ..jit.robust_tracing import traced_robustly
from ..runtime.plugin_types import is_surface

REACH = 1e-4  # of the largest coordinate: how far before the surface the ray starts, and how far behind it ends
APART = (
    "fspt_surface: on CUDA a kernel that traces rays in the scene cannot look for faces of a mesh beside it, and loses "
    "light. Load the scene with mitsuba_fspt.load, or render it with mitsuba_fspt.render."
)


class Probe:
    """Looks for faces of a mesh; on CUDA in kernels that trace rays in a scene only if it was set up `beside` that."""

    def __init__(self, mesh: mi.Shape, beside: mi.Scene | None = None) -> None:
        if beside is None and mi.variant().startswith("cuda"):
            mi.Log(mi.LogLevel.Warn, APART)
        # The mesh itself, whose emitter holds the probe, must not be kept.
        self.scene = traced_robustly([_bare_copy(mesh)], beside)

    def at(self, mesh: mi.Shape, ps: mi.PositionSample3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The full surface record at a position sample of the mesh."""
        reach = REACH * (dr.max(dr.abs(ps.p)) + 1e-3)
        ray = mi.Ray3f(ps.p + reach * ps.n, -ps.n)
        ray.maxt = 2 * reach
        pi = self.scene.ray_intersect_preliminary(ray, active=active)
        hit = pi.is_valid()
        pi.prim_index = dr.select(hit, pi.prim_index, 0)
        si = mesh.compute_surface_interaction(ray, pi, active=hit)
        si.t = dr.select(hit, si.t, dr.inf)
        return si


def probe_beside(scene: mi.Scene) -> None:
    """Let light leave meshes of a scene in the kernels that trace rays in it; needed on CUDA alone."""
    if not mi.variant().startswith("cuda"):
        return
    for emitter in scene.emitters():
        if is_surface(emitter):
            emitter.trace_beside(scene)


def _bare_copy(mesh: mi.Shape) -> mi.Mesh:
    """The triangles of a mesh and nothing else of it."""
    positions, faces = triangles(mesh)
    return set_triangles(mi.Mesh("copy", dr.width(positions) // 3, dr.width(faces) // 3), positions, faces)
