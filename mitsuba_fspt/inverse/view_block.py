"""Block of rows of the transport matrix (Eq. M.20) that belongs to one view: its columns and its computation."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..integral.quadrature import Quadrature
from ..integral.rows.sparse_rows import SparseRows
from ..runtime.errors import SceneError, TransportError, named

if TYPE_CHECKING:
    import mitsuba as mi

    from ..emission.emitting_surface import EmittingSurface


ON = ("vertex", "face")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Part:
    """Columns of one glowing mesh: id of its shape, their number, and the digest of the mesh in its own frame."""

    name: str
    count: int
    digest: str
    law: str
    areas: Array


def glowing_meshes(scene: mi.Scene) -> list[EmittingSurface]:
    """The emitting surfaces of a scene, all of them meshes whose radiance is linear in J_n.

    Raises
    ------
    TransportError : nothing glows, an emitter is no `fspt_surface`, its shape no mesh, J_n a bitmap, or the exit law
        depends on more than J_n; the message names the way out.
    """
    if not scene.emitters():
        raise TransportError("transport: nothing glows. Give a mesh an emitter of type 'fspt_surface'.")
    from ..emission.of_emitter import surface_of

    found = []
    for emitter in scene.emitters():
        surface = surface_of(emitter)
        if surface is None:
            raise TransportError(
                f"transport: emitter {emitter.class_name()} is no fspt_surface, whose J_n the matrix takes. Leave it "
                "out."
            )
        shape = surface.shape
        if not shape.is_mesh():
            raise TransportError(
                f"transport: shape '{shape.id()}' is a {shape.class_name().lower()}, J_n needs the vertices or faces "
                "of a mesh. Give a PLY, for example of trimesh.creation."
            )
        if surface.exitance.class_name().startswith("Bitmap"):
            raise TransportError(
                f"transport: 'exitance' of shape '{shape.id()}' is a bitmap, the columns are vertices or faces. Give "
                "J_n as a mesh attribute or a number."
            )
        if not surface.law.linear:
            raise TransportError(
                f"transport: emission '{surface.law.name}' of shape '{shape.id()}' depends on the fluence, not on J_n "
                "alone. Give 'lambert' or 'fresnel'."
            )
        found.append(surface)
    return found


def parts_of(scene: mi.Scene, on: str) -> list[Part]:
    """The columns of each glowing mesh of a scene, in the order of its emitters."""
    from ..jit.mesh_buffers import triangles
    from ..rendering.provenance import digest_of

    found = []
    for surface in glowing_meshes(scene):
        mesh = surface.shape
        positions, faces = (buffer.numpy() for buffer in triangles(mesh))
        vertices, corners = positions.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
        a, b, c = (vertices[corners[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if on == "vertex":
            area = np.bincount(corners.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))
        found.append(Part(mesh.id(), len(area), digest_of(mesh.emitter(), mesh), str(surface.law), area))
    return found


def block_of(
    scene: mi.Scene,
    lens: mi.Sensor,
    on: str,
    rtol: float,
    progress: Callable[[float], None] | None = None,
    *,
    most_bytes: int | None = None,
) -> SparseRows:
    """Rows of one view of a scene, whatever J_n it has.

    Raises
    ------
    TransportError : as `glowing_meshes`, or the memory does not suffice.
    SceneError, OpticsError, ExitanceError : as `render`.
    """
    import drjit as dr

    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_checks import check_rounding
    from ..integral.rows.view_rows import view_rows
    from ..jit.recording import recording
    from ..rendering.render import integrator_of

    surfaces, camera = glowing_meshes(scene), camera_of(lens)
    with ExitStack() as stack:
        for surface in surfaces:
            stack.enter_context(surface.shining(1.0))
        with named("fspt_integral"):
            quadrature = Quadrature(rtol=rtol)
        integrator: Any = integrator_of(scene, "integral")
        check_rounding(camera)
        with recording(), dr.suspend_grad():
            return view_rows(
                scene,
                camera,
                lambda: integrator.solve(scene, lens, quadrature),
                [on] * len(surfaces),
                quadrature,
                progress,
                most_bytes,
            )


def light_left_out_of(scene: mi.Scene, lens: mi.Sensor, rtol: float) -> tuple[float, str] | None:
    """Share of the power for J = 1 that Eq. 9 leaves out of a view, and a line about it; None below `rtol`."""
    from ..rendering.render import integrator_of

    with ExitStack() as stack:
        for surface in glowing_meshes(scene):
            stack.enter_context(surface.shining(1.0))
        integrator: Any = integrator_of(scene, "integral")
        found = integrator.light_left_out(scene, lens, Quadrature(rtol=rtol))
    warning = found.warning(rtol) if found else None
    return (found.share, warning) if warning else None


def required_on(on: object) -> str:
    """`on` as one of `ON`; TransportError for anything else."""
    if on not in ON:
        raise TransportError(f"transport: 'on' must be 'vertex' or 'face', got {on!r}.")
    return str(on)


def required_rtol(rtol: object) -> float:
    """`rtol` as a float in the range of `Quadrature`; TransportError for anything else."""
    try:
        return Quadrature(rtol=rtol).rtol  # type: ignore[arg-type]
    except SceneError as error:
        raise TransportError(f"transport: {error}") from error
