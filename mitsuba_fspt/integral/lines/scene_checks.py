"""Checks of a scene before Eq. 9 is computed for it.

Float32 resolves its lengths and powers, something may glow, J_n is sane, the camera is outside every closed surface, no
surface lies in another one.
"""

from __future__ import annotations

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera.camera import Camera
from ...emission.elements import elements_of
from ...emission.emitting_surface import EmittingSurface
from ...emission.of_emitter import surfaces_of
from ...jit.mesh_buffers import box_of, triangles
from ...runtime.errors import ExitanceError, SceneError
from .nested_bsdfs import check_textures
from .specular import specular_bsdf

COARSEST = 0.1  # virtual pixels: the largest displacement of a line of sight by float32
# W/mm² and W: outside these ranges float32 cannot represent the sums and the faint parts of an image.
EXITANCES, FAINTEST = (1e-32, 1e32), 1e-36
STRETCH = 1e-4  # relative: the most that float32 may change lengths and right angles by
MATRIX_ROUNDING = 1e-6  # of float32, in sums of products
PROBES = 1 << 10  # surface points of a shape that are tested for a second surface
LIFT = 1e-6  # of the largest coordinate: surfaces closer than this coincide in float32
PARALLEL = 0.999  # cosine of the normals of coincident surfaces; shapes that intersect meet at an angle


def check_scene(scene: mi.Scene, camera: Camera) -> None:
    """Raise SceneError or ExitanceError if no image of the scene can be computed; the message says how to fix it."""
    check_film(camera)
    check_rounding(camera)
    if not scene.emitters():
        raise SceneError("scene: nothing glows. Give a shape an emitter of type 'fspt_surface' with its 'exitance'.")
    for surface in surfaces_of(scene):
        surface.check()
        check_range(surface, camera)
        check_placement(surface.shape)
        with dr.suspend_grad():
            check_alone(scene, surface)
    check_textures(scene)
    check_outside(scene, camera)


def check_film(camera: Camera) -> None:
    """Raise SceneError for a film without pixels."""
    width, height = camera.film.crop_size
    if not (width and height):
        raise SceneError(f"scene: the film has {width} x {height} pixels. Give it at least one.")


def check_rounding(camera: Camera) -> None:
    """Raise SceneError where float32 displaces lines of sight by more than a tenth of a pixel."""
    if camera.rounding <= COARSEST:
        return
    side = camera.virtual_pitch
    raise SceneError(
        f"fspt_lens: single precision places lines of sight to {camera.rounding * side:.2g} mm, a pixel is "
        f"{side:.2g} mm wide on the virtual detector plane and must be at least {1 / COARSEST:g} times that. Give a "
        "larger 'pixel_pitch' or, where the scene lies far from the world's origin, move it there."
    )


def check_surfaces_alone(scene: mi.Scene) -> None:
    """Raise SceneError for an environment emitter: the integral sums the light of surfaces alone."""
    for emitter in scene.emitters():
        if emitter.is_environment():
            raise SceneError(
                f"fspt_integral: emitter {emitter.class_name()} shines from beyond all surfaces, whose light alone is "
                "counted. Leave it out, or render with method path."
            )


def check_range(surface: EmittingSurface, camera: Camera) -> None:
    """Raise ExitanceError where J_n, or the power on a pixel that follows from it, leaves the range of float32."""
    brightest = surface.brightest
    if brightest == 0:  # dark, as an optimiser may begin
        return
    name = f"fspt_surface: 'exitance' of shape '{surface.shape.id()}'"
    if not EXITANCES[0] <= brightest <= EXITANCES[1]:
        raise ExitanceError(
            f"{name} reaches {brightest:.3g} W/mm², single precision needs {EXITANCES[0]:g} … {EXITANCES[1]:g}. Give "
            "J_n on another scale and rescale the image, which is linear in it."
        )
    power = brightest / math.pi * camera.etendue
    if power < FAINTEST:
        raise ExitanceError(
            f"{name} reaches {brightest:.3g} W/mm², of which a pixel gets {power:.1g} W; single precision needs "
            f"{FAINTEST:g}. Give larger pixels, a smaller f_number, or J_n on another scale."
        )


def check_placement(shape: mi.Shape) -> None:
    """Raise SceneError for a sphere, cylinder or disk that Mitsuba would trace in another pose than its `to_world`."""
    kind = shape.class_name().lower()
    if kind not in ("sphere", "cylinder", "disk"):
        return
    placement = mi.traverse(shape)["to_world"]
    axes, back = (np.array(t.matrix, np.float64).reshape(4, 4)[:3, :3] for t in (placement, placement.inverse()))
    # Mitsuba inverts each step of a transform by rule, a rotation by its transpose, whatever its axis.
    if (np.abs(axes @ back - np.eye(3)) > STRETCH + MATRIX_ROUNDING * (np.abs(axes) @ np.abs(back))).any():
        raise SceneError(
            f"scene: 'to_world' of {kind} '{shape.id()}' is not undone by the inverse that Mitsuba traces with. Give "
            "every rotation an axis of length 1, or a mesh."
        )
    if kind == "disk":
        return
    lengths = np.linalg.norm(axes, axis=0)
    alike = lengths[: 3 if kind == "sphere" else 2]  # a cylinder may have any length
    cosines = axes.T @ axes / np.outer(lengths, lengths) - np.eye(3)
    if np.ptp(alike) > STRETCH * alike.max() or np.abs(cosines).max() > STRETCH:
        # Mitsuba traces a round shape, its parameters describe another one.
        raise SceneError(
            f"scene: 'to_world' of {kind} '{shape.id()}' stretches or shears it, which it cannot follow. Give a "
            "rotation (about an axis of length 1), a translation and one scale, or a mesh."
        )


def check_alone(scene: mi.Scene, surface: EmittingSurface) -> None:
    """Raise SceneError where a second surface coincides with this one: which of them a ray meets is undefined."""
    shape = surface.shape
    doubled = 0
    if shape.is_mesh():
        buffers = triangles(shape)
        # Counted once for each state of the mesh.
        if [b.index for b in buffers] != [b.index for b in surface.single_faces]:
            doubled = _doubled_faces(*buffers)
            surface.single_faces = () if doubled else buffers
    if doubled:
        raise SceneError(
            f"scene: shape '{shape.id()}' has {doubled} faces more than once, its light would count as often. Merge "
            "them, for example with trimesh: mesh.update_faces(mesh.unique_faces())."
        )
    if len(scene.shapes()) < 2:
        return
    elements = elements_of(shape, PROBES)
    count = min(elements.count, PROBES)
    index = dr.arange(mi.UInt32, count) * (elements.count // count)
    si, area = elements.place(index, mi.Point2f(0.5))
    lift = LIFT * dr.max(dr.abs(si.p))
    ray = mi.Ray3f(si.p + lift * si.n, -si.n)
    ray.maxt = 2 * lift
    met = scene.ray_intersect_preliminary(ray, active=area > 0)
    near = met.is_valid() & (met.shape != mi.ShapePtr(shape))
    if not dr.any(near):  # the query below, for the second shape, is slow
        return
    other = met.compute_surface_interaction(ray, active=near)
    shared = near & (dr.dot(other.n, si.n) > PARALLEL)
    if dr.any(shared):
        second = other.shape[int(np.argmax(shared.numpy()))]
        raise SceneError(
            f"scene: shapes '{shape.id()}' and '{second.id()}' lie in the same place in part; which of them is seen "
            "there would be chance. Move them apart or leave one out."
        )


def _doubled_faces(positions: mi.Float, faces: mi.UInt32) -> int:
    """Number of faces with an area that have the same three corners, in any order, as an earlier face."""
    corner = positions.numpy().reshape(-1, 3) + np.float32(0)  # -0 becomes 0
    face = faces.numpy().reshape(-1, 3)
    # A hash of each position; the sum of those of three corners identifies a face, in any order.
    number = np.zeros(len(corner), np.uint64)
    for bits in corner.view(np.uint32).T:
        number = (number ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        number ^= number >> np.uint64(29)
    number *= np.uint64(0xBF58476D1CE4E5B9)
    number ^= number >> np.uint64(32)
    keys = number[face[:, 0]] + number[face[:, 1]] + number[face[:, 2]]
    order = np.argsort(keys)
    again = order[1:][np.diff(keys[order]) == 0]
    a, b, c = (corner[face[again, k]] for k in range(3))
    return int((np.cross(b - a, c - a) != 0).any(axis=1).sum())


def check_outside(scene: mi.Scene, camera: Camera) -> None:
    """Raise SceneError where the lens centre is inside a closed surface: in all directions it sees an inward side."""
    if not box_of(scene.shapes()).contains(mi.ScalarPoint3f(camera.centre)):
        return
    directions = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], np.float32)
    # Turned a little, so that no direction runs along the faces of an axis-aligned box.
    rays = mi.Ray3f(camera.to_world @ mi.Point3f(0, 0, 0), dr.normalize(mi.Vector3f(directions.T + 0.1234)))
    si = scene.ray_intersect(rays)
    opaque = mi.Bool(True)  # False for directions through panes of a chamber
    for shape in scene.shapes():
        if specular_bsdf(shape):
            opaque &= si.shape != mi.ShapePtr(shape)
    if dr.all(si.is_valid() & (dr.dot(si.n, rays.d) > 0) & opaque):
        raise SceneError(
            "fspt_lens: the lens stands inside the phantom, where it sees only dark inner sides. Move it out with "
            "'to_world'."
        )
