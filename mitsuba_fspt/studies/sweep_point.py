"""The points of a sweep: parameter values, name of the image, and a fingerprint of all that the image depends on."""

from __future__ import annotations

import hashlib
import itertools
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ..rendering.parameters import texts_of
from ..rendering.scene_source import SceneSource
from ..runtime.deadline import LEAST_TIME
from ..runtime.errors import SceneError

Setting = str | int | float | None
MAX_CHARACTERS = 60  # of a value in a file name
MAX_BYTES = 250  # of a file name without its suffix; file systems allow 255 with it


@dataclass(frozen=True)
class SweepPoint:
    """One image of a sweep and all that determines it; plain data that can be sent to other processes.

    scene : the scene file as given
    path : its absolute path, for a process that works in another folder
    parameters : name and value, as in the scene's `<default>`
    settings : method, rtol, spp, seed, sensor as `render` takes them, and source_power [W]
    geometry : hash of the scene without its lens; points of equal `geometry` can use the same loaded scene
    fingerprint : hash of the scene's files, the parameters, the settings and the versions
    suffix : of the image's file, which chooses its format
    max_time : for the rendering [s]; None: no limit. An image that was stopped has another fingerprint
    """

    scene: str
    path: Path
    parameters: dict[str, str]
    settings: dict[str, Setting]
    geometry: str
    fingerprint: str
    suffix: str = ".exr"
    max_time: float | None = None

    def within(self, seconds: float) -> SweepPoint:
        """The same point with so much time [s] for its rendering, or the least that may be given."""
        return replace(self, max_time=max(seconds, LEAST_TIME))

    @property
    def label(self) -> str:
        """The parameters in one line, 'f_number=2.8 view=90'."""
        return " ".join(f"{name}={value}" for name, value in self.parameters.items())

    @property
    def file(self) -> str:
        """Name of the image, 'nylon_cylinder_f_number=2.8_view=90.exr'."""
        values = (f"{name}={_in_a_name(value)}" for name, value in self.parameters.items())
        name = "_".join([self.path.stem, *values])
        return (name if len(os.fsencode(name)) <= MAX_BYTES else _shortened(name)) + self.suffix


def points(
    scene: Path, values: Mapping[str, object], settings: Mapping[str, Setting], suffix: str = ".exr"
) -> list[SweepPoint]:
    """One point for every combination of the values, the last parameter changing fastest.

    Raises
    ------
    SceneError : no parameters, a parameter that the scene does not have or that has no values, a value given twice, a
        value that is no number where the scene needs one, a scene that cannot be read.
    OpticsError : a lens that cannot exist.
    """
    texts = {name: texts_of(name, given, "sweep") for name, given in values.items()}
    if not texts:
        raise SceneError(f"sweep: no parameter to vary over {scene}. Give one, for example -D f_number=2.8,5.6.")
    every = [dict(zip(texts, one, strict=True)) for one in itertools.product(*texts.values())]
    digests: dict[Path, str] = {}
    return [point_of(scene, parameters, digests, dict(settings), suffix) for parameters in every]


def point_of(
    scene: Path,
    parameters: dict[str, str],
    digests: dict[Path, str],
    settings: dict[str, Setting],
    suffix: str = ".exr",
) -> SweepPoint:
    """The point of these parameters, checked; `digests` are shared by the points, see `SceneSource`."""
    source = SceneSource.of(scene, parameters, digests)
    source.check_numbers()
    geometry, fingerprint = source.geometry(), source.fingerprint(settings)
    return SweepPoint(str(scene), scene.absolute(), parameters, settings, geometry, fingerprint, suffix)


def _in_a_name(value: str) -> str:
    """`value` for a file name; characters that it cannot hold are replaced, and a hash keeps such values distinct."""
    plain = re.sub(r"[^\w.+-]", "-", value)[:MAX_CHARACTERS]
    return plain if plain == value else f"{plain}-{_short_hash(value)}"


def _shortened(name: str) -> str:
    """The beginning of a name that is too long, and a hash that keeps the names of points distinct."""
    beginning = os.fsencode(name)[: MAX_BYTES - 9].decode(errors="ignore")
    return f"{beginning}-{_short_hash(name)}"


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:8]
