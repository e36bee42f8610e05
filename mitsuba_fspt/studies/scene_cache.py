"""The cache of a sweep: a phantom that stays while only the lens before it changes."""

from __future__ import annotations

from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING

from ..images.image import Image
from ..rendering.render import render
from ..rendering.scene import load
from ..runtime.backend import ensure_variant
from ..runtime.errors import FsptError
from .sweep_point import SweepPoint

if TYPE_CHECKING:
    import mitsuba as mi


class SceneCache:
    """Renders points one at a time and keeps the last scene; bits as from a scene loaded anew."""

    def __init__(self, *, threads: int | None = None, quiet: bool = False) -> None:
        """`threads` for Dr.Jit (None leaves them as they are); `quiet` for a process that only renders."""
        self._threads, self._quiet = threads, quiet
        self._scene: mi.Scene | None = None
        self._geometry = ""
        self._one_at_a_time = Lock()
        self.loads = 0

    def image(self, point: SweepPoint) -> Image:
        """Image of a point, `fingerprint` in its metadata; raises as `load` and `render` do, the point named first."""
        try:
            with self._one_at_a_time:
                image = render(self._set_up(point), **point.settings)  # type: ignore[arg-type]
        except FsptError as error:
            raise type(error)(f"{point.label}: {error}") from error
        told = {"scene": f"{point.scene} {point.label}", "fingerprint": point.fingerprint}
        return replace(image, metadata=image.metadata | told)

    def image_or_error(self, point: SweepPoint) -> Image | FsptError:
        """`image`, or what it raises: the other points can be rendered all the same."""
        try:
            return self.image(point)
        except FsptError as error:
            return error

    def _set_up(self, point: SweepPoint) -> mi.Scene:
        scene = self._scene if self._geometry == point.geometry else None
        self._scene = None  # should the set-up fail, nothing half changed is kept
        if scene is not None:
            _set_lens(scene, point)
        else:
            if self.loads == 0:
                self._settle()
            scene = load(point.path, **point.parameters)
            self.loads += 1
        self._scene, self._geometry = scene, point.geometry
        return scene

    def _settle(self) -> None:
        ensure_variant()
        import drjit as dr
        import mitsuba as mi

        if self._quiet:
            mi.set_log_level(mi.LogLevel.Error)
        if self._threads is not None:
            dr.set_thread_count(self._threads)


def _set_lens(scene: mi.Scene, point: SweepPoint) -> None:
    import mitsuba as mi

    numbers = mi.traverse(scene.sensors()[0])
    for parameter, names in point.lens.items():
        for name in names:
            numbers[name] = float(point.parameters[parameter])
    numbers.update()
