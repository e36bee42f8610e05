"""The camera of a scene's sensor: the only place that asks an `fspt_lens` for it."""

from __future__ import annotations

import mitsuba as mi

from ..runtime.errors import SceneError
from ..runtime.plugin_types import is_lens
from .camera import Camera


def camera_of(sensor: mi.Sensor) -> Camera:
    """The camera of a sensor.

    Raises
    ------
    SceneError : the sensor is no `fspt_lens`.
    OpticsError : the last update of its parameters was refused.
    """
    if not is_lens(sensor):
        raise SceneError(
            f"scene: the sensor is a {sensor.class_name()}, power on a pixel needs a lens. Use a sensor of type "
            "'fspt_lens'."
        )
    return sensor.camera
