"""Numbers of the lens of a scene, without rendering it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..runtime.errors import SceneError
from ..runtime.plugin_types import is_lens
from .scene import loaded

if TYPE_CHECKING:
    import mitsuba as mi


def lens_numbers(
    scene: mi.Scene | str | os.PathLike[str] | Mapping[str, object],
) -> tuple[dict[str, float | int | str], tuple[int, int]]:
    """Numbers of the scene's lens by name, as in an image's metadata, and (h, w) of the image [pixels].

    `scene`: what `render` takes. Of several lenses all must have the same numbers and film, wherever they stand.

    Raises
    ------
    SceneError : the scene cannot be loaded, has no `fspt_lens`, or different ones.
    OpticsError : the lens cannot exist.
    """
    found = []
    sensors = loaded(scene).sensors()
    from ..camera.of_sensor import camera_of

    for sensor in filter(is_lens, sensors):
        camera = camera_of(sensor)
        found.append((camera.numbers(), camera.film.shape))
    if not found:
        raise SceneError("scene: it has no 'fspt_lens'. Give a scene with the lens of the camera.")
    if any(other != found[0] for other in found[1:]):
        raise SceneError(f"scene: its {len(found)} lenses differ. Give a scene with the one lens of the camera.")
    return found[0]
