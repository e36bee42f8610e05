"""What a scene must be before anything is traced: something glows, J_n is sane, the camera stands outside."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import SceneError


def check_scene(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Raise SceneError or ExitanceError where the scene cannot give a picture; the message says how to mend it."""
    check_lens(sensor)
    if not scene.emitters():
        raise SceneError("scene: nothing glows. Give a shape an emitter of type 'fspt_surface' with its 'exitance'.")
    for emitter in scene.emitters():
        if type(emitter).__name__ == "FsptSurface":
            emitter.check()
    check_outside(scene, sensor)


def check_lens(sensor: mi.Sensor) -> None:
    """Raise SceneError unless the sensor is an `fspt_lens`."""
    if type(sensor).__name__ != "FsptLens":
        raise SceneError(
            f"scene: the sensor is a {sensor.class_name()}, power on a pixel needs a lens. Use a sensor of type "
            "'fspt_lens'."
        )


def check_outside(scene: mi.Scene, lens: mi.Sensor) -> None:
    """Raise SceneError where the lens centre is inside a closed surface: all around it shows its inward side."""
    directions = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], np.float32)
    # Turned a little, so that no direction runs along the faces of an axis-aligned box.
    rays = mi.Ray3f(lens.world_transform() @ mi.Point3f(0, 0, 0), dr.normalize(mi.Vector3f(directions.T + 0.1234)))
    si = scene.ray_intersect(rays)
    if dr.all(si.is_valid() & (dr.dot(si.n, rays.d) > 0)):
        raise SceneError(
            "fspt_lens: the lens stands inside the phantom, where it sees only dark inner sides. Move it out with "
            "'to_world'."
        )
