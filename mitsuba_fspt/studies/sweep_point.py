"""The points of a sweep: the values of each, the name of its image and the fingerprint of all that it depends on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from ..rendering.scene import check_parameters, parameter_text
from ..runtime.errors import SceneError
from .sweep_source import SceneSource

Setting = str | int | float | None
LONGEST = 60  # characters of a value in a file name
MOST_BYTES = 250  # of a file name before its suffix: all file systems in use hold 255


@dataclass(frozen=True)
class SweepPoint:
    """One image of a sweep and all that makes it; plain data that travels to other processes.

    scene : the scene file as given
    path : the same from the root, for a process that works in another folder
    parameters : name and value, as in the scene's `<default>`
    lens : names of the lens numbers that a parameter sets, for parameters that do nothing else
    settings : method, rtol, spp, seed as `render` takes them
    geometry : fingerprint of the scene without its lens; equal where one load serves both points
    fingerprint : of the scene's files, the parameters, the settings and the versions
    """

    scene: str
    path: Path
    parameters: dict[str, str]
    lens: dict[str, tuple[str, ...]]
    settings: dict[str, Setting]
    geometry: str
    fingerprint: str

    @property
    def label(self) -> str:
        """The parameters in one line, 'f_number=2.8 view=90'."""
        return " ".join(f"{name}={value}" for name, value in self.parameters.items())

    @property
    def file(self) -> str:
        """Name of the image, 'nylon_cylinder_f_number=2.8_view=90.exr'."""
        values = (f"{name}={_in_a_name(value)}" for name, value in self.parameters.items())
        name = "_".join([self.path.stem, *values])
        return (name if len(os.fsencode(name)) <= MOST_BYTES else _shortened(name)) + ".exr"


def points(scene: Path, values: Mapping[str, object], settings: Mapping[str, Setting]) -> list[SweepPoint]:
    """All combinations of the values over a scene, the last parameter changing fastest.

    Raises
    ------
    SceneError : no parameters, one that the scene has not or without values, a value twice or that is no number
        where the scene wants one, a scene that cannot be read.
    OpticsError : a lens that cannot exist.
    """
    texts = {name: _texts(name, given) for name, given in values.items()}
    if not texts:
        raise SceneError(f"sweep: no parameter to vary over {scene}. Give one, for example -D f_number=2.8,5.6.")
    every = [dict(zip(texts, one, strict=True)) for one in itertools.product(*texts.values())]
    digests: dict[Path, str] = {}
    return [_point(scene, parameters, digests, dict(settings)) for parameters in every]


def _point(
    scene: Path, parameters: dict[str, str], digests: dict[Path, str], settings: dict[str, Setting]
) -> SweepPoint:
    check_parameters(scene, parameters)
    source = SceneSource(scene, parameters, digests)
    source.check()
    lens = source.lens_parameters()
    moving = {name: lens[name] for name in parameters if name in lens}
    standing = {name: value for name, value in parameters.items() if name not in moving}
    versions = [version(name) for name in ("mitsuba-fspt", "mitsuba")]
    geometry = _hash(versions, source.digests(), standing)
    fingerprint = _hash(geometry, {name: parameters[name] for name in moving}, settings)
    path = source.path
    return SweepPoint(str(path), path.absolute(), parameters, moving, settings, geometry, fingerprint)


def _texts(name: str, given: object) -> list[str]:
    """Values of a parameter as the scene file would spell them; one alone need not be in a list."""
    several = isinstance(given, Iterable) and not isinstance(given, (str, bytes)) and getattr(given, "ndim", 1) > 0
    values = list(given) if several else [given]  # type: ignore[call-overload]
    texts = [parameter_text(value).strip() for value in values]
    if not texts or "" in texts:
        raise SceneError(f"sweep: parameter '{name}' has an empty value. Give values between commas: -D {name}=1,2.")
    twice = [text for text in texts if texts.count(text) > 1]
    if twice:
        raise SceneError(f"sweep: parameter '{name}' has the value '{twice[0]}' twice. Leave one out.")
    return texts


def _in_a_name(value: str) -> str:
    """`value`, or where a file name cannot hold it, what it can and a hash that keeps values apart."""
    plain = re.sub(r"[^\w.+-]", "-", value)[:LONGEST]
    return plain if plain == value else f"{plain}-{_short_hash(value)}"


def _shortened(name: str) -> str:
    """The beginning of a name that is too long, and a hash that keeps points apart."""
    beginning = os.fsencode(name)[: MOST_BYTES - 9].decode(errors="ignore")
    return f"{beginning}-{_short_hash(name)}"


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:8]


def _hash(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
