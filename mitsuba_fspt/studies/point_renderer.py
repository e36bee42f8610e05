"""Renders the points of a sweep; the last loaded scene is used again where only its lens differs."""

from __future__ import annotations

import time
from dataclasses import replace
from threading import Lock

from ..images.formats import Metadata
from ..images.image import Image
from ..rendering.live_scene import LiveScene
from ..rendering.render import render
from ..runtime.backend import ensure_variant, set_threads
from ..runtime.deadline import LEAST_TIME
from ..runtime.errors import FsptError
from .sweep_point import SweepPoint


class PointRenderer:
    """Renders the points of a sweep one at a time and keeps the last scene.

    The images are those of a scene that is loaded for each point, as of `LiveScene.image`.
    """

    def __init__(self, *, threads: int | None = None, quiet: bool = False) -> None:
        """`threads`: number of Dr.Jit's threads (None leaves it unchanged); `quiet`: no warnings of Mitsuba."""
        self._threads, self._quiet = threads, quiet
        self._live: LiveScene | None = None
        self._one_at_a_time = Lock()

    def image(self, point: SweepPoint) -> Image:
        """Image of a point, with `fingerprint` in its metadata.

        Raises what `load` and `render` raise; the message begins with the values of the point's parameters.
        """
        try:
            with self._one_at_a_time:
                settings = dict(point.settings)
                watt = settings.pop("source_power")
                start = time.monotonic()
                scene = self._live_scene(point).scene(point.parameters)
                taken = time.monotonic() - start
                left = None if point.max_time is None else max(point.max_time - taken, LEAST_TIME)
                image = render(scene, max_time=left, **settings)  # type: ignore[arg-type]
            image = image if watt is None else image.scaled(watt)  # type: ignore[arg-type]
        except FsptError as error:
            raise type(error)(f"{point.label}: {error}") from error
        stopped = " stopped" if "stopped_after" in image.metadata else ""  # a later sweep renders it anew
        origin: Metadata = {"scene": f"{point.scene} {point.label}", "fingerprint": point.fingerprint + stopped}
        return replace(image, metadata=image.metadata | origin)

    def image_or_error(self, point: SweepPoint) -> Image | FsptError:
        """`image`, or the FsptError that it raises, so that a sweep can go on with the other points."""
        try:
            return self.image(point)
        except FsptError as error:
            return error

    def _live_scene(self, point: SweepPoint) -> LiveScene:
        """The scene of the point's file and sensor, the last one if it fits."""
        sensor = int(point.settings["sensor"] or 0)
        if self._live is None:
            self._set_up_mitsuba()
        if self._live is None or (self._live.source, self._live.sensor) != (point.path, sensor):
            self._live = None  # memory for one scene, not two
            self._live = LiveScene(point.path, sensor=sensor, any_sensor=True)
        return self._live

    def _set_up_mitsuba(self) -> None:
        """Set a variant, the log level and the number of threads; once, before the first scene."""
        ensure_variant()
        import mitsuba as mi

        if self._quiet:
            mi.set_log_level(mi.LogLevel.Error)
        if self._threads is not None:
            set_threads(self._threads)
