"""Loading of scene files: from XML with `<default>` parameters to a Mitsuba scene."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..runtime import backend
from ..runtime.errors import SceneError
from ..runtime.interrupt import ctrl_c_noted
from .scene_rules import check_text
from .scene_xml import SceneXml, read_xml

COLOUR_FORMATS = ("rgb", "rgba", "xyz", "xyza")

if TYPE_CHECKING:
    import mitsuba as mi


def load(path: str | os.PathLike[str], /, **parameters: object) -> mi.Scene:
    """Mitsuba scene of an XML file; keywords replace the file's `<default>` values.

    Sets a variant if none is active (see `backend.ensure_variant`), and turns Embree's robust mode on. The scene's
    `id()` is the file and its parameters, for example 'scenes/nylon_cylinder.xml f_number=8'.

    Raises
    ------
    SceneError : the file cannot be read, is no valid scene, has no such parameter, or a value does not fit its
        parameter; one line with the cause.
    """
    path = Path(path)
    backend.ensure_variant()
    import mitsuba as mi

    from ..emission.face_probe import probe_beside

    check_parameters(path, parameters)
    check_text(path, _xml_of(path, parameters))
    texts = {name: parameter_text(value) for name, value in parameters.items()}
    config = mi.parser.ParserConfig(mi.variant())
    resolver = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(resolver))
    mi.file_resolver().prepend(str(path.resolve().parent))
    try:
        with ctrl_c_noted():
            state = mi.parser.parse_file(config, str(path), **texts)
            if state.root.props.plugin_name() != "scene":
                raise SceneError(
                    f"{path}: the root is <{state.root.props.plugin_name()}>, a scene file has <scene>. Give one."
                )
            state.root.props["embree_use_robust_intersections"] = True
            state.root.props.set_id(" ".join([str(path), *(f"{name}={text}" for name, text in texts.items())]))
            _name_children(state)
            _set_film_formats(state)
            mi.parser.transform_all(config, state)
            scene = mi.parser.instantiate(config, state)
    except (RuntimeError, ValueError) as error:
        raise error if isinstance(error, SceneError) else SceneError(_one_line(str(error))) from error
    finally:
        mi.set_file_resolver(resolver)
    scene = scene[0] if isinstance(scene, list) else scene
    probe_beside(scene)
    return scene


def loaded(scene: mi.Scene | str | os.PathLike[str]) -> mi.Scene:
    """`scene` itself, or the scene loaded from the file of that name."""
    return load(scene) if isinstance(scene, (str, os.PathLike)) else scene


def _xml_of(path: Path, parameters: Mapping[str, object]) -> SceneXml:
    """XML of the scene file with these values of its parameters."""
    return read_xml(path, {name: parameter_text(value) for name, value in parameters.items()})


def check_parameters(path: Path, parameters: Mapping[str, object]) -> None:
    """Raise SceneError for a name that is no `<default>` of the file or of the files it includes with these values."""
    known = _xml_of(path, parameters).defaults
    for name in parameters:
        if name not in known:
            names = ", ".join(known) or "none"
            raise SceneError(f"{path}: the scene has no parameter '{name}'. Its <default> parameters: {names}.")
        if name in ("config", "filename"):  # names of arguments of Mitsuba's parser
            raise SceneError(f"{path}: Mitsuba cannot set a parameter '{name}'. Give the <default> another name.")


def parameter_text(value: object) -> str:
    """Text of a parameter's value for Mitsuba's parser."""
    return str(value).lower() if isinstance(value, (bool, np.bool_)) else str(value)


def _name_children(state: mi.parser.ParserState) -> None:
    """Give sensors and shapes without an id one, 'fspt_lens', 'sphere', 'sphere_2', for messages and `mi.traverse`."""
    import mitsuba as mi

    taken = {node.props.id() for node in state.nodes}
    for node in state.nodes:
        if node.type in (mi.ObjectType.Sensor, mi.ObjectType.Shape) and not node.props.id():
            plain = node.props.plugin_name()
            names = itertools.chain([plain], (f"{plain}_{number}" for number in itertools.count(2)))
            node.props.set_id(next(name for name in names if name not in taken))
            taken.add(node.props.id())


def _set_film_formats(state: mi.parser.ParserState) -> None:
    """Store films as luminance in monochrome variants; Mitsuba does the same, but with a warning for each film."""
    import mitsuba as mi

    if not mi.is_monochromatic:
        return
    for node in state.nodes:
        if node.type == mi.ObjectType.Film and str(node.props.get("pixel_format", "rgb")).lower() in COLOUR_FORMATS:
            node.props["pixel_format"] = "luminance"


def _one_line(message: str) -> str:
    """Position and cause from Mitsuba's message, without its source lines and Python's traceback."""
    lines = [re.sub(r"\[[\w.]+:\d+\] ", "", line).strip() for line in message.splitlines()]
    text = " ".join(filter(None, lines))
    found = re.match(
        r"(?:At|Error while loading|While loading|Parsing of XML file) (.*?\(line \d+, col \d+\)):? (.*)", text
    )
    position, cause = (found[1] + ": ", found[2]) if found else ("", text)
    ours = [line for line in lines if re.match(r"(\w+\.)*\w*(Error|Exception): ", line)]
    unknown = re.match(r'Found \d+ unreferenced .* plugin of type "(\w+)": ', cause)
    broken = re.match(r'failed to instantiate (\w+) plugin of type "(\w+)": (.*)', cause)
    if ours:
        cause = ours[-1].split(": ", 1)[1]
    elif unknown:
        names = re.findall(r'- \w+ "(\w+)"', cause)
        named = [name for name in names if not name.startswith("_arg_")]
        cause = f"'{unknown[1]}' has no parameter {', '.join(named)}. Correct its name or leave it out."
        if not named:  # only properties without a name, to which Mitsuba gives its own
            cause = f"'{unknown[1]}' has no use for what stands in it without a name. Name it, or leave it out."
    elif broken:
        cause = f"cannot load the {broken[1]} '{broken[2]}': {broken[3].rstrip('.!')}. Check its file and parameters."
    return position + cause
