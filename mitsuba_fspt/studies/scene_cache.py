"""The scene cache of a sweep: the last loaded scene is used again where only numbers of its lens differ."""

from __future__ import annotations

import time
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING

from ..images.image import Image
from ..rendering.provenance import remember_defaults
from ..rendering.render import render
from ..rendering.scene import load
from ..runtime.backend import ensure_variant, set_threads
from ..runtime.deadline import LEAST_TIME
from ..runtime.errors import FsptError
from .sweep_point import SweepPoint

if TYPE_CHECKING:
    import mitsuba as mi


class SceneCache:
    """Renders the points of a sweep one at a time and keeps the last scene.

    The images are equal to the bit to those of a scene that is loaded for each point. `loads` counts the scenes that
    were loaded.
    """

    def __init__(self, *, threads: int | None = None, quiet: bool = False) -> None:
        """`threads`: number of Dr.Jit's threads (None leaves it unchanged); `quiet`: no warnings of Mitsuba."""
        self._threads, self._quiet = threads, quiet
        self._scene: mi.Scene | None = None
        self._geometry = ""
        self._one_at_a_time = Lock()
        self.loads = 0

    def image(self, point: SweepPoint) -> Image:
        """Image of a point, with `fingerprint` in its metadata.

        Raises what `load` and `render` raise; the message begins with the values of the point's parameters.
        """
        try:
            with self._one_at_a_time:
                settings = dict(point.settings)
                watt = settings.pop("source_power")
                start = time.monotonic()
                scene = self._set_up(point)
                taken = time.monotonic() - start
                left = None if point.max_time is None else max(point.max_time - taken, LEAST_TIME)
                image = render(scene, max_time=left, **settings)  # type: ignore[arg-type]
            image = image if watt is None else image.scaled(watt)  # type: ignore[arg-type]
        except FsptError as error:
            raise type(error)(f"{point.label}: {error}") from error
        stopped = " stopped" if "stopped_after" in image.metadata else ""  # a later sweep renders it anew
        origin = {"scene": f"{point.scene} {point.label}", "fingerprint": point.fingerprint + stopped}
        return replace(image, metadata=image.metadata | origin)

    def image_or_error(self, point: SweepPoint) -> Image | FsptError:
        """`image`, or the FsptError that it raises, so that a sweep can go on with the other points."""
        try:
            return self.image(point)
        except FsptError as error:
            return error

    def _set_up(self, point: SweepPoint) -> mi.Scene:
        """The scene of a point, loaded or with its lens changed."""
        scene = self._scene if self._geometry == point.geometry else None
        self._scene = None  # if the set-up fails, no partly changed scene is kept
        if scene is not None:
            _set_lens(scene, point)
        else:
            if self.loads == 0:
                self._set_up_mitsuba()
            scene = load(point.path, **point.parameters)
            self.loads += 1
        self._scene, self._geometry = scene, point.geometry
        return scene

    def _set_up_mitsuba(self) -> None:
        """Set a variant, the log level and the number of threads; once, before the first scene."""
        ensure_variant()
        import mitsuba as mi

        if self._quiet:
            mi.set_log_level(mi.LogLevel.Error)
        if self._threads is not None:
            set_threads(self._threads)


def _set_lens(scene: mi.Scene, point: SweepPoint) -> None:
    """Set the numbers of the scene's lens to those of the point."""
    import mitsuba as mi

    numbers = mi.traverse(scene.sensors()[0])
    for parameter, names in point.lens.items():
        for name in names:
            numbers[name] = float(point.parameters[parameter])
    numbers.update()
    remember_defaults(scene, point.parameters)
