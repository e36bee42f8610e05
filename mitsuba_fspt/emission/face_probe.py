"""Face of a mesh at a sampled position. A position sample does not contain it, so a short ray searches for it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..jit.mesh_buffers import new_mesh, triangles
from ..jit.robust_tracing import traced_robustly

REACH = 1e-4  # of the largest coordinate: the ray runs from this distance before the surface to as much behind it
APART = (
    "fspt_surface: on CUDA a kernel that traces rays in this scene cannot search a second scene for faces of a mesh, "
    "and loses light. Load the scene with mitsuba_fspt.load, or render it with mitsuba_fspt.render."
)


class Probe:
    """Search for the faces of a mesh, by rays in a scene of that mesh alone.

    On CUDA a kernel can trace rays in two scenes only if one was built with a reference to the other: `beside`.
    """

    def __init__(self, mesh: mi.Shape, beside: mi.Scene | None = None) -> None:
        if beside is None and mi.variant().startswith("cuda"):
            mi.Log(mi.LogLevel.Warn, APART)
        # A copy: the surface of the mesh holds the probe, so that a reference to the mesh itself would be a cycle.
        self.scene = traced_robustly([_bare_copy(mesh)], beside)

    def at(self, mesh: mi.Shape, ps: mi.PositionSample3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Surface interaction at a position sample of the mesh."""
        reach = REACH * (dr.max(dr.abs(ps.p)) + 1e-3)
        ray = mi.Ray3f(ps.p + reach * ps.n, -ps.n)
        ray.maxt = 2 * reach
        pi = self.scene.ray_intersect_preliminary(ray, active=active)
        hit = pi.is_valid()
        pi.prim_index = dr.select(hit, pi.prim_index, 0)
        si = mesh.compute_surface_interaction(ray, pi, active=hit)
        si.t = dr.select(hit, si.t, dr.inf)
        return si


def _bare_copy(mesh: mi.Shape) -> mi.Mesh:
    """Mesh with the triangles of `mesh` and nothing else."""
    return new_mesh("copy", *triangles(mesh))
