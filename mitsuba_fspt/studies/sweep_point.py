"""The points of a sweep: parameter values, name of the image, and a fingerprint of all that the image depends on.

`SceneSource` reads from the scene's XML which files it names, and which parameters set only numbers of the lens.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ..optics.thin_lens import Lens, number_names
from ..optics.transmittance import NUMBERS as LIGHT
from ..rendering.scene import check_parameters, parameter_text
from ..rendering.scene_rules import REFERENCE, check_values, is_number
from ..rendering.scene_xml import read_xml
from ..runtime.deadline import LEAST_TIME
from ..runtime.errors import SceneError, named
from ..runtime.versions import version

Setting = str | int | float | None
MAX_CHARACTERS = 60  # of a value in a file name
MAX_BYTES = 250  # of a file name without its suffix; file systems allow 255 with it


@dataclass(frozen=True)
class SweepPoint:
    """One image of a sweep and all that determines it; plain data that can be sent to other processes.

    scene : the scene file as given
    path : its absolute path, for a process that works in another folder
    parameters : name and value, as in the scene's `<default>`
    lens : names of the lens numbers that a parameter sets, for parameters that set nothing else
    settings : method, rtol, spp, seed, sensor as `render` takes them, and source_power [W]
    geometry : hash of the scene without its lens; points of equal `geometry` can use the same loaded scene
    fingerprint : hash of the scene's files, the parameters, the settings and the versions
    suffix : of the image's file, which chooses its format
    max_time : for the rendering [s]; None: no limit. An image that was stopped has another fingerprint
    """

    scene: str
    path: Path
    parameters: dict[str, str]
    lens: dict[str, tuple[str, ...]]
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
    """The point of these parameters, checked; `digests` as of `SceneSource`."""
    check_parameters(scene, parameters)
    source = SceneSource(scene, parameters, digests)
    source.check()
    all_lens = source.lens_parameters()
    lens = {name: all_lens[name] for name in parameters if name in all_lens}
    others = {name: value for name, value in parameters.items() if name not in lens}
    versions = [version(name) for name in ("mitsuba-fspt", "mitsuba")]
    geometry = _hash(versions, source.digests(), others)
    fingerprint = _hash(geometry, {name: parameters[name] for name in lens}, settings)
    path = source.path
    return SweepPoint(str(path), path.absolute(), parameters, lens, settings, geometry, fingerprint, suffix)


def texts_of(name: str, given: object, verb: str) -> list[str]:
    """Values of a parameter as text in a scene file; `given` is a list of them or one value.

    Raises SceneError, in the name of `verb`, for no value, an empty one or one given twice.
    """
    several = isinstance(given, Iterable) and not isinstance(given, (str, bytes)) and getattr(given, "ndim", 1) > 0
    values = list(given) if several else [given]  # type: ignore[call-overload]
    texts = [parameter_text(value).strip() for value in values]
    if not texts or "" in texts:
        raise SceneError(f"{verb}: parameter '{name}' has an empty value. Give values between commas: -D {name}=1,2.")
    twice = [text for text in texts if texts.count(text) > 1]
    if twice:
        raise SceneError(f"{verb}: parameter '{name}' has the value '{twice[0]}' twice. Leave one out.")
    return texts


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


def _hash(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


class SceneSource:
    """The XML of a scene file and of the files that it includes, read once with these values of its parameters.

    path : the scene file
    parameters : values by name, as text
    digests : SHA-256 by file; new ones are added, so that sources that share this dictionary read a file once

    Raises
    ------
    SceneError : the file or one that it includes cannot be read or is not valid XML.
    """

    def __init__(
        self, path: Path, parameters: Mapping[str, str] | None = None, digests: dict[Path, str] | None = None
    ) -> None:
        self.path = path
        self._parameters = parameters or {}
        self._xml = read_xml(path, self._parameters)
        self._nodes = self._xml.nodes
        sensors = [node for node in self._nodes if node.tag == "sensor"]
        # The elements inside <sensor type="fspt_lens">; none if the scene has further sensors.
        self._lens = list(sensors[0]) if [node.get("type") for node in sensors] == ["fspt_lens"] else []
        self._digests = {} if digests is None else digests

    def lens_parameters(self) -> dict[str, tuple[str, ...]]:
        """Names of the lens numbers that a parameter sets, for the parameters that set nothing else in the scene."""
        found: dict[str, tuple[str, ...]] = {}
        lens_nodes = []
        for node in self._lens:
            reference = REFERENCE.fullmatch(node.get("value", ""))
            if reference and node.tag == "float" and node.get("name") in (*number_names(), "pixel_pitch", *LIGHT):
                found[reference[1]] = (*found.get(reference[1], ()), node.get("name", ""))
                lens_nodes.append(node)
        elsewhere = " ".join(text for node in self._nodes if node not in lens_nodes for text in node.attrib.values())
        return {name: numbers for name, numbers in found.items() if f"${name}" not in elsewhere}

    def check(self) -> None:
        """Raise SceneError for a value that is no number where one is needed, OpticsError for an impossible lens."""
        check_values(self.path, self._xml)
        self._check_lens()

    def _check_lens(self) -> None:
        """Raise OpticsError for a lens that cannot exist, before any point is rendered.

        Numbers that the XML does not give as plain text are checked later, when the scene is loaded.
        """
        given = {node.get("name", ""): self._xml.fill_in(node.get("value", "")) for node in self._lens}
        numbers = {name: text for name, text in given.items() if name in number_names()}
        plain = all(map(is_number, numbers.values())) and "include" not in {node.tag for node in self._lens}
        if plain and {"focal_length", "f_number"} <= set(numbers):
            model = given.get("model", "diaphragm")
            with named("fspt_lens"):
                Lens.focused(model=model, **{name: float(text) for name, text in numbers.items()})  # type: ignore[arg-type]

    def digests(self) -> list[tuple[str, str]]:
        """Name and SHA-256 of the scene file, of what it includes and of every file that its attributes name.

        Names are relative to the scene's folder, so that a scene copied with its data has the same digests.
        """
        return sorted({(os.path.relpath(file, self.path.parent), self._digest(file)) for file in self._xml.sources()})

    def _digest(self, file: Path) -> str:
        if file not in self._digests:
            self._digests[file] = _sha256(file)
        return self._digests[file]


def _sha256(file: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
