"""XML of a scene, read like Mitsuba's parser: `<default>` values, `$name` in texts, included files."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..runtime.errors import SceneError

TEXT = Path("XML text")  # stands for the file's name in messages where a scene is given as text


@dataclass(frozen=True)
class SceneXml:
    """Content of a scene file and of all files that it includes, in the order of the text.

    given : values for `<default>` parameters, as text
    files : the scene file and its includes
    nodes : their elements
    defaults : names and values of their `<default>` parameters; the first of a name counts
    folders : folders searched for a file, after the folder of the file that names it and before the current folder
    """

    given: Mapping[str, str]
    files: list[Path] = field(default_factory=list)
    nodes: list[ElementTree.Element] = field(default_factory=list)
    defaults: dict[str, str] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)

    def fill_in(self, text: str) -> str:
        """`text` with values in place of `$name`, the longest name first; a name without value is kept."""
        if "$" not in text:
            return text
        values = {**self.defaults, **self.given}
        names = sorted(filter(None, values), key=len, reverse=True)
        pattern = "|".join(re.escape(f"${name}") for name in names)
        return re.sub(pattern, lambda found: values[found[0][1:]], text) if names else text

    def candidates(self, name: str, folder: Path) -> list[Path]:
        """Existing files that `name` in a file of this folder may refer to, the likeliest first."""
        tried = [home / name for home in (folder, *self.folders)]
        there = [file for file in dict.fromkeys(tried) if os.path.isfile(file)]
        return there or [Path(name)] * os.path.isfile(name)

    def sources(self) -> set[Path]:
        """The scene file, its includes, and every existing file that an attribute may refer to."""
        names = {self.fill_in(text) for node in self.nodes for text in node.attrib.values()}
        folders = {file.parent for file in self.files}
        return set(self.files).union(*(self.candidates(name, folder) for name in names for folder in folders))


def read_xml(path: Path, given: Mapping[str, str]) -> SceneXml:
    """Content of a scene file with the values `given` for its parameters; SceneError if it cannot be read."""
    scene = SceneXml(given, folders=[path.parent])
    _read(path, scene, ())
    return scene


def read_text(text: str, given: Mapping[str, str]) -> SceneXml:
    """Content of the text of a scene with the values `given`; its files are searched for in the current folder."""
    scene = SceneXml(given, folders=[Path()])
    scene.files.append(TEXT)
    _add(_root(TEXT, text), TEXT, scene, ())
    return scene


def is_text(scene: object) -> bool:
    """True if `scene` is the XML text of a scene, which starts with '<'; False for the name of a file."""
    return isinstance(scene, str) and scene.lstrip("\ufeff \t\r\n").startswith("<")


def _read(path: Path, scene: SceneXml, outer: tuple[Path, ...]) -> None:
    """Add the content of a file to `scene`; `outer`: the chain of files whose includes lead to it."""
    if os.path.realpath(path) in map(os.path.realpath, outer):
        raise SceneError(f"{outer[0]}: {path} includes itself. Take that <include> out.")
    if path in scene.files:  # a second time
        return
    scene.files.append(path)
    _add(_root(path), path, scene, outer)


def _add(root: ElementTree.Element, path: Path, scene: SceneXml, outer: tuple[Path, ...]) -> None:
    """Add the elements of a file to `scene`, and the files that it includes."""
    for node in root.iter():
        scene.nodes.append(node)
        if node.tag == "default":
            scene.defaults.setdefault(node.get("name", ""), scene.fill_in(node.get("value", "")))
        elif node.tag == "path":
            scene.folders.append(path.parent / scene.fill_in(node.get("value", "")))
        elif node.tag == "include":
            for inner in scene.candidates(scene.fill_in(node.get("filename", "")), path.parent)[:1]:
                _read(inner, scene, (*outer, path))


def _instead(path: Path) -> str:
    """What to give in place of a file that is no scene."""
    if path.suffix.lower() == ".ply":
        return f"Write one for this phantom by 'fspt scene new mouse --phantom {path} -o scene.xml'."
    return "Give the name of one, or write one by 'fspt scene new'."


def _root(path: Path, text: str | None = None) -> ElementTree.Element:
    """Root element of an XML file, or of a text; SceneError if it cannot be read."""
    try:
        return ElementTree.parse(path).getroot() if text is None else ElementTree.fromstring(text)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}. Check the name.") from error
    except LookupError as error:
        raise SceneError(f"{path}: {error}. Save the scene file as UTF-8, and say so in its first line.") from error
    except ElementTree.ParseError as error:
        if text is None and not path.read_bytes()[:1024].lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
            raise SceneError(f"{path}: no scene, which is XML and begins with '<'. {_instead(path)}") from error
        raise SceneError(f"{path}: not valid XML: {error}. Fix that line.") from error
