"""Text of a scene file with other values of its `<default>` parameters, all else byte for byte."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.parsers.expat import ExpatError, ParserCreate

from ..optics.transmittance import CURVE, SPECTRUM
from ..optics.vignetting import VIGNETTING
from ..rendering.scene_xml import read_xml
from ..runtime.atomic_files import atomic_path, require_apart
from ..runtime.errors import InversionError

FILES = ("filename", CURVE, SPECTRUM, VIGNETTING)  # properties that name files beside the scene
TAG = re.compile(rb"""<default\b(?:[^>"']|"[^"]*"|'[^']*')*>""")
VALUE = re.compile(rb"""(\bvalue\s*=\s*)("[^"]*"|'[^']*')""")


def require_own_defaults(scene: str | os.PathLike[str], names: Sequence[str]) -> None:
    """Raise InversionError unless each name is set by one `<default>` of the scene file itself, not of an include."""
    own = [name for name, _, _ in _places(Path(scene).read_bytes(), Path(scene))]
    everywhere = [node.get("name") for node in read_xml(Path(scene), {}).nodes if node.tag == "default"]
    for name in names:
        if own.count(name) != 1 or everywhere.count(name) != 1:
            raise InversionError(
                f"calibrate: '{name}' is set by {own.count(name)} <default> of '{scene}' and "
                f"{everywhere.count(name) - own.count(name)} of its includes. Set it once, in the scene file itself."
            )


def require_files_found(scene: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Raise InversionError if files that the scene names beside it, such as meshes, are not beside `path`, too."""
    here, there = Path(scene).parent, Path(path).parent
    nodes = read_xml(Path(scene), {}).nodes
    for name in [node.get("value") for node in nodes if node.get("name") in FILES]:
        if name and not Path(name).is_absolute() and (here / name).exists() and not (there / name).exists():
            raise InversionError(
                f"output file '{path}': the scene names '{name}' beside it, which is not in '{there}'. Write it into "
                f"'{here}'."
            )


def write_calibrated(scene: str | os.PathLike[str], values: Mapping[str, float], path: str | os.PathLike[str]) -> None:
    """Write the text of a scene file with these values of its `<default>` parameters, written beside, then renamed.

    Raises
    ------
    InversionError : a name that is not set by one `<default>` of the file, files beside the scene that the output
        would not find, or the output cannot be written.
    """
    require_apart(Path(path), [Path(scene)], error=InversionError)
    require_own_defaults(scene, list(values))
    require_files_found(scene, path)
    text = with_defaults(Path(scene).read_bytes(), values, Path(scene))
    with atomic_path(path, InversionError) as temporary:
        temporary.write_bytes(text)


def with_defaults(text: bytes, values: Mapping[str, float], path: Path) -> bytes:
    """The XML `text` of the file `path` with other values of `<default>` elements; comments and the rest are kept."""
    for name, start, end in reversed(_places(text, path)):
        if name in values:
            number = repr(float(values[name])).encode("ascii")
            text = text[:start] + VALUE.sub(rb'\g<1>"' + number + rb'"', text[start:end], count=1) + text[end:]
    return text


def _places(text: bytes, path: Path) -> list[tuple[str, int, int]]:
    """Name, first byte and end of every `<default ...>` tag."""
    found: list[tuple[str, int, int]] = []
    parser = ParserCreate()

    def start(element: str, attributes: dict[str, str]) -> None:
        if element == "default":
            place = TAG.match(text, parser.CurrentByteIndex)
            if place is None or VALUE.search(place[0]) is None:
                raise InversionError(f"calibrate: '{path}' is not in UTF-8. Save the scene file as UTF-8.")
            found.append((attributes.get("name", ""), *place.span()))

    parser.StartElementHandler = start
    try:
        parser.Parse(text, True)
    except ExpatError as cause:
        raise InversionError(f"calibrate: '{path}' is not valid XML: {cause}. Fix that line.") from cause
    return found
