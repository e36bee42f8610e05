"""The XML of a scene as a sweep reads it: what a parameter feeds, which files the scene names, what the lens is."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from ..optics.thin_lens import Lens, number_names
from ..rendering.scene_rules import REFERENCE, check_values, is_number
from ..rendering.scene_xml import read_xml


class SceneSource:
    """A scene file and the files it includes with some values of its parameters, as they were when read.

    `digests` are known of files already; sources that share them read a file once.

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
        # Children of the lens, where there is one and no other sensor.
        self._lens = list(sensors[0]) if [node.get("type") for node in sensors] == ["fspt_lens"] else []
        self._digests = {} if digests is None else digests

    def lens_parameters(self) -> dict[str, tuple[str, ...]]:
        """Parameters that set numbers of the only `fspt_lens` and nothing else, with the names of these numbers."""
        found: dict[str, tuple[str, ...]] = {}
        ours = []
        for node in self._lens:
            reference = REFERENCE.fullmatch(node.get("value", ""))
            if reference and node.tag == "float" and node.get("name") in (*number_names(), "pixel_pitch"):
                found[reference[1]] = (*found.get(reference[1], ()), node.get("name", ""))
                ours.append(node)
        elsewhere = " ".join(text for node in self._nodes if node not in ours for text in node.attrib.values())
        return {name: numbers for name, numbers in found.items() if f"${name}" not in elsewhere}

    def check(self) -> None:
        """Raise SceneError or OpticsError for a value that is no number where one is due, or that no lens can have."""
        check_values(self.path, self._xml)
        self._check_lens()

    def _check_lens(self) -> None:
        """Before the work, not after half of it; what the scene file does not say in so many words is left to it."""
        given = {node.get("name", ""): self._xml.fill_in(node.get("value", "")) for node in self._lens}
        numbers = {name: text for name, text in given.items() if name in number_names()}
        plain = all(map(is_number, numbers.values())) and "include" not in {node.tag for node in self._lens}
        if plain and {"focal_length", "f_number"} <= set(numbers):
            model = given.get("model", "diaphragm")
            Lens.focused(model=model, **{name: float(text) for name, text in numbers.items()})  # type: ignore[arg-type]

    def digests(self) -> list[tuple[str, str]]:
        """Name and SHA-256 of the scene file, of what it includes and of every file that its attributes name."""
        # A scene that moved with its data is the same scene.
        return sorted({(os.path.relpath(file, self.path.parent), self._digest(file)) for file in self._xml.sources()})

    def _digest(self, file: Path) -> str:
        if file not in self._digests:
            self._digests[file] = _sha256(file)
        return self._digests[file]


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
