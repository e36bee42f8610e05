"""Faults of the meshes that glow: inconsistent orientations, surfaces inside out, and a size unusual for a phantom.

Eq. 9 lacks the light of such faces: a face emits on its outward side alone.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...emission.emitting_surface import EmittingSurface
from ...emission.of_emitter import surfaces_of
from ...jit.mesh_buffers import box_of, triangles
from ...phantom.length_unit import MILLIMETRES, is_usual, likelier_unit
from ...phantom.surface_mesh import Closure, closure, turned_share

FROM_FILES = ("PLYMesh", "OBJMesh", "SerializedMesh")  # meshes that may be in another unit than the scene


def mesh_faults(scene: mi.Scene, camera: Camera) -> list[str]:
    """One line for each glowing mesh with faces that point to the wrong side, and one for an unusual size of all."""
    meshes = [surface for surface in surfaces_of(scene) if surface.shape.is_mesh()]
    found = [winding_fault(surface, camera) for surface in meshes]
    if read := [surface.shape for surface in meshes if surface.shape.class_name() in FROM_FILES]:
        found.append(size_fault(float(np.linalg.norm(np.array(box_of(read).extents(), np.float64)))))
    return [text for text in found if text]


def size_fault(diagonal: float) -> str | None:
    """The line for a bounding box of all that glows with a diagonal [mm] unusual for a phantom, and a likelier unit."""
    if is_usual(diagonal):
        return None
    found = f"what glows is {diagonal:.3g} mm from corner to corner, unusual for a phantom: one unit of length is 1 mm"
    unit = likelier_unit(diagonal)
    if unit is None:
        return found
    factor = MILLIMETRES[unit]
    return f"{found}. If its mesh is in {unit}, scale it by {factor:g} in 'to_world': {factor * diagonal:.3g} mm"


def winding_fault(surface: EmittingSurface, camera: Camera) -> str | None:
    """The fault in the orientation of a mesh, None without one; found once for each state of the mesh."""
    mesh = surface.shape
    buffers = triangles(mesh)
    if not surface.winding or [b.index for b in buffers] != [b.index for b in surface.winding[0]]:
        surface.winding = buffers, *_winding(mesh, *(b.numpy().reshape(-1, 3) for b in buffers))
    _, shape, share = surface.winding
    name = f"mesh '{mesh.id()}'"
    if shape.twisted:
        return (
            f"{name}: on {shape.twisted} edges the two faces point to opposite sides; {100 * share:.2g} % of its area "
            "points inward, where it is dark from outside. Repair it, for example by trimesh.repair.fix_winding"
        )
    # A lens inside may take an image of the walls of a cavity.
    if not shape.inside_out or mesh.bbox().contains(mi.ScalarPoint3f(camera.centre)):
        return None
    if shape.inside_out == shape.pieces:
        return (
            f"{name} is a closed surface that is inside out: its light stays inside. Turn its faces over, for example "
            "by fspt flux import --flip, or give the shape 'flip_normals' = true"
        )
    return (
        f"{name}: {shape.inside_out} of its {shape.pieces} closed pieces are inside out, their light stays inside. "
        "Turn those over in the mesh"
    )


def _winding(mesh: mi.Mesh, positions: np.ndarray, faces: np.ndarray) -> tuple[Closure, float]:
    """Closure of a mesh as it glows, and the share of its area that points to the wrong side if that is mixed."""
    faces = faces[:, ::-1] if mesh.has_flipped_normals() else faces
    shape = closure(positions, faces)
    return shape, turned_share(positions, faces) if shape.twisted else 0.0
