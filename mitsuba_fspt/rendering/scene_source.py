"""Source of a scene: a file, XML text or a dictionary, read once with the values of its parameters, and checked.

It gives the files that the scene names, with their digests, and the parameters that set only numbers of the lens.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

from ..optics.thin_lens import Lens, number_names
from ..optics.transmittance import NUMBERS as LIGHT
from ..runtime.errors import SceneError, named
from ..runtime.versions import version
from .parameters import parameter_texts
from .scene_rules import REFERENCE, check_text, check_values, is_number
from .scene_xml import TEXT, SceneXml, is_text, read_text, read_xml

OF_THE_PARSER = ("config", "filename", "string")  # names of arguments of Mitsuba's parser


@dataclass(frozen=True)
class SceneSource:
    """A scene before it is loaded; `of` makes it.

    scene : name of a file, XML text or a dictionary, as given
    parameters : the given values of `<default>` parameters
    given : their texts
    path : name of the file, or what stands for it in messages
    folder : in which files that the scene names are searched for
    xml : content of the file or text and of the files that it includes; that of a dictionary is empty
    digests_known : SHA-256 by file; sources that share this dictionary read a file once
    """

    scene: str | os.PathLike[str] | Mapping[str, object]
    parameters: Mapping[str, object]
    given: dict[str, str]
    path: Path
    folder: Path
    xml: SceneXml
    digests_known: dict[Path, str] = field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls, scene: object, parameters: Mapping[str, object] | None = None, digests: dict[Path, str] | None = None
    ) -> SceneSource:
        """Read the XML of a scene; its dictionary is taken as it is.

        Raises
        ------
        SceneError : the file or one that it includes cannot be read or is not valid XML, `scene` is none of these, or
            it has no such parameter.
        """
        parameters, known = dict(parameters or {}), {} if digests is None else digests
        if isinstance(scene, Mapping):
            _require_scene(scene, parameters)
            return cls(scene, {}, {}, Path("dictionary"), Path(), SceneXml({}), known)
        given = parameter_texts(parameters)
        if is_text(scene):
            text = str(scene)
            found = cls(text, parameters, given, TEXT, Path(), read_text(text, given), known)
        elif isinstance(scene, (str, os.PathLike)):
            path = Path(scene)
            found = cls(scene, parameters, given, path, path.resolve().parent, read_xml(path, given), known)
        else:
            raise SceneError(
                f"scene: must be the name of a file, XML text or a dictionary, got {type(scene).__name__}. Give one."
            )
        found._require_known()
        return found

    @property
    def values(self) -> dict[str, str]:
        """Values of all `<default>` parameters as texts."""
        return self.xml.defaults | self.given

    def check(self) -> None:
        """Raise SceneError if the XML breaks one of the rules of `scene_rules`."""
        check_text(self.path, self.xml)

    def check_numbers(self) -> None:
        """Raise SceneError for a value that is no number where one is needed, OpticsError for an impossible lens."""
        check_values(self.path, self.xml)
        self._check_lens()

    def files(self) -> set[Path]:
        """The scene file, its includes, and every existing file that an attribute may refer to."""
        return self.xml.sources()

    def lens_parameters(self) -> dict[str, tuple[str, ...]]:
        """Names of the lens numbers that a parameter sets, for the parameters that set nothing else in the scene."""
        found: dict[str, tuple[str, ...]] = {}
        lens_nodes = []
        for node in self._lens:
            reference = REFERENCE.fullmatch(node.get("value", ""))
            if reference and node.tag == "float" and node.get("name") in (*number_names(), "pixel_pitch", *LIGHT):
                found[reference[1]] = (*found.get(reference[1], ()), node.get("name", ""))
                lens_nodes.append(node)
        elsewhere = " ".join(text for node in self.xml.nodes if node not in lens_nodes for text in node.attrib.values())
        return {name: numbers for name, numbers in found.items() if f"${name}" not in elsewhere}

    def digests(self) -> list[tuple[str, str]]:
        """Name and SHA-256 of every file of `files`.

        Names are relative to the scene's folder, so that a scene copied with its data has the same digests.
        """
        return sorted({(os.path.relpath(file, self.path.parent), self._digest(file)) for file in self.files()})

    def geometry(self) -> str:
        """Hash of the scene without the given values that set only the lens, and of the versions."""
        lens = self.lens_parameters()
        others = {name: value for name, value in self.given.items() if name not in lens}
        return hash_of([version(name) for name in ("mitsuba-fspt", "mitsuba")], self.digests(), others)

    def fingerprint(self, settings: Mapping[str, object]) -> str:
        """Hash of all that an image with these settings depends on."""
        lens = self.lens_parameters()
        return hash_of(self.geometry(), {name: self.given[name] for name in self.given if name in lens}, dict(settings))

    @cached_property
    def _lens(self) -> list[Element]:
        """The elements inside <sensor type="fspt_lens">; none if the scene has further sensors."""
        sensors = [node for node in self.xml.nodes if node.tag == "sensor"]
        return list(sensors[0]) if [node.get("type") for node in sensors] == ["fspt_lens"] else []

    def _check_lens(self) -> None:
        """Raise OpticsError for a lens that cannot exist, before any image is rendered.

        Numbers that the XML does not give as plain text are checked later, when the scene is loaded.
        """
        given = {node.get("name", ""): self.xml.fill_in(node.get("value", "")) for node in self._lens}
        numbers = {name: text for name, text in given.items() if name in number_names()}
        plain = all(map(is_number, numbers.values())) and "include" not in {node.tag for node in self._lens}
        if plain and {"focal_length", "f_number"} <= set(numbers):
            model = given.get("model", "diaphragm")
            with named("fspt_lens"):
                Lens.focused(model=model, **{name: float(text) for name, text in numbers.items()})  # type: ignore[arg-type]

    def _require_known(self) -> None:
        """Raise SceneError for a name that is no `<default>` of the XML, or that the parser cannot set."""
        known = self.xml.defaults
        for name in self.given:
            if name not in known:
                names = ", ".join(known) or "none"
                raise SceneError(
                    f"{self.path}: the scene has no parameter '{name}'. Its <default> parameters: {names}."
                )
            if name in OF_THE_PARSER:
                raise SceneError(
                    f"{self.path}: Mitsuba cannot set a parameter '{name}'. Give the <default> another name."
                )

    def _digest(self, file: Path) -> str:
        if file not in self.digests_known:
            self.digests_known[file] = _sha256(file)
        return self.digests_known[file]


def hash_of(*parts: object) -> str:
    """SHA-256 of plain data, as hexadecimal digits."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def _require_scene(scene: Mapping[str, object], parameters: Mapping[str, object]) -> None:
    """Raise SceneError for a dictionary that is no scene, and for parameters, which it does not have."""
    if parameters:
        names = ", ".join(f"'{name}'" for name in parameters)
        raise SceneError(f"dictionary: a scene given so has no parameter {names}. Put the values into it.")
    if scene.get("type") != "scene":
        raise SceneError(f"dictionary: its 'type' is {scene.get('type')!r}, a scene has 'scene'. Give one.")


def _sha256(file: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
