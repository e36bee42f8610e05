"""Loading of scenes: from XML with `<default>` parameters, or a dictionary, to a Mitsuba scene."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..runtime import backend
from ..runtime.errors import SceneError
from ..runtime.interrupt import ctrl_c_noted
from ..runtime.ply_file import require_whole
from .provenance import remember_defaults, remember_placements, remember_source
from .scene_rules import check_text
from .scene_xml import TEXT, SceneXml, is_text, read_text, read_xml

COLOUR_FORMATS = ("rgb", "rgba", "xyz", "xyza")
COLOURS = {  # plugins of colours and of spectra
    **dict.fromkeys(("d65", "srgb"), "colour"),
    **dict.fromkeys(("blackbody", "regular", "irregular"), "spectrum"),
}

if TYPE_CHECKING:
    import mitsuba as mi

    Array = NDArray[np.float64]
    Parser = Callable[[mi.parser.ParserConfig], mi.parser.ParserState]


def load(scene: str | os.PathLike[str] | Mapping[str, object], /, **parameters: object) -> mi.Scene:
    """Mitsuba scene of an XML file, of XML text or of a dictionary; keywords replace the XML's `<default>` values.

    Sets a variant if none is active (see `backend.ensure_variant`), and turns Embree's robust mode on. The scene's
    `id()` is the file and its parameters, for example 'scenes/nylon_cylinder.xml f_number=8'.

    Parameters
    ----------
    scene : name of an XML file; text of one, which starts with '<' (`scene_xml` writes it; files that it names are
        searched for in the current folder); or a dictionary as of `mi.load_dict`
    parameters : values for `<default>` parameters

    Raises
    ------
    SceneError : the file cannot be read, is no valid scene, has no such parameter, or a value does not fit its
        parameter; one line with the cause.
    """
    backend.ensure_variant()
    import mitsuba as mi

    from ..emission.of_emitter import probe_beside

    path, folder, parse = _source_of(scene, parameters)
    with _files_of(folder):
        config = _config()
        state = parse(config)
        _set_up(state, path, parameters)
        placements = _placements(state)
        mi.parser.transform_all(config, state)
        loaded = mi.parser.instantiate(config, state)
    loaded = loaded[0] if isinstance(loaded, list) else loaded
    probe_beside(loaded)
    remember_defaults(loaded, values_of(scene, parameters))
    remember_placements(loaded, placements)
    if not isinstance(scene, Mapping):
        remember_source(loaded, scene, parameters)
    return loaded


def parsed(scene: str | os.PathLike[str] | Mapping[str, object], /, **parameters: object) -> list[mi.parser.SceneNode]:
    """Elements of a scene as `load` parses and checks them, before Mitsuba's objects are made; raises as `load`."""
    backend.ensure_variant()
    _, folder, parse = _source_of(scene, parameters)
    with _files_of(folder):
        return list(parse(_config()).nodes)


def _source_of(scene: object, parameters: Mapping[str, object]) -> tuple[Path, Path, Parser]:
    """Name of a scene for messages, folder in which its files are searched for, and the function that parses it."""
    if isinstance(scene, Mapping):
        return Path("dictionary"), Path(), _parser_of_dictionary(scene, parameters)
    if is_text(scene):
        return TEXT, Path(), _parser_of_text(str(scene), parameters)
    path = _path_of(scene)
    return path, path.resolve().parent, _parser_of_file(path, parameters)


def _config() -> mi.parser.ParserConfig:
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = False  # shapes keep their ids, and rectangles their bounding boxes
    return config


@contextmanager
def _files_of(folder: Path) -> Iterator[None]:
    """Context manager in which Mitsuba finds files of `folder`, and its errors become SceneErrors of one line."""
    import mitsuba as mi

    resolver = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(resolver))
    mi.file_resolver().prepend(str(folder))
    try:
        with ctrl_c_noted():
            yield
    except (RuntimeError, ValueError) as error:
        raise error if isinstance(error, SceneError) else SceneError(_one_line(str(error))) from error
    finally:
        mi.set_file_resolver(resolver)


def values_of(scene: object, parameters: Mapping[str, object]) -> dict[str, str]:
    """Values of all `<default>` parameters of a scene as texts, with the given `parameters`; `scene` as of `load`."""
    if isinstance(scene, Mapping):
        return {}
    given = _texts(parameters)
    xml = read_text(str(scene), given) if is_text(scene) else read_xml(_path_of(scene), given)
    return xml.defaults | given


def _path_of(scene: object) -> Path:
    """Name of a scene file as a path; SceneError if `scene` is no name of a file."""
    if not isinstance(scene, (str, os.PathLike)):
        raise SceneError(
            f"scene: must be the name of a file, XML text or a dictionary, got {type(scene).__name__}. Give one."
        )
    return Path(scene)


def _parser_of_file(path: Path, parameters: Mapping[str, object]) -> Parser:
    """Function that parses a scene file with these values of its parameters, after their check."""
    import mitsuba as mi

    check_parameters(path, parameters)
    check_text(path, _xml_of(path, parameters))
    return lambda config: mi.parser.parse_file(config, str(path), **_texts(parameters))


def _parser_of_text(text: str, parameters: Mapping[str, object]) -> Parser:
    """Function that parses the XML text of a scene with these values of its parameters, after their check."""
    import mitsuba as mi

    xml = read_text(text, _texts(parameters))
    _require_known(TEXT, xml, parameters)
    check_text(TEXT, xml)
    return lambda config: mi.parser.parse_string(config, text, **_texts(parameters))


def _parser_of_dictionary(scene: Mapping[str, object], parameters: Mapping[str, object]) -> Parser:
    """Function that parses a scene's dictionary, which has no parameters."""
    import mitsuba as mi

    if parameters:
        names = ", ".join(f"'{name}'" for name in parameters)
        raise SceneError(f"dictionary: a scene given so has no parameter {names}. Put the values into it.")
    if scene.get("type") != "scene":
        raise SceneError(f"dictionary: its 'type' is {scene.get('type')!r}, a scene has 'scene'. Give one.")
    return lambda config: mi.parser.parse_dict(config, dict(scene))


def _set_up(state: mi.parser.ParserState, path: Path, parameters: Mapping[str, object]) -> None:
    """Set robust mode, ids and film formats of a parsed scene; SceneError if its root element is no scene."""
    root = state.root.props
    if root.plugin_name() != "scene":
        raise SceneError(f"{path}: the root is <{root.plugin_name()}>, a scene file has <scene>. Give one.")
    root["embree_use_robust_intersections"] = True
    root.set_id(" ".join([str(path), *(f"{name}={text}" for name, text in _texts(parameters).items())]))
    _refuse_colours(path, state)
    _require_whole_meshes(state)
    _name_children(state)
    _set_film_formats(state)


def _require_whole_meshes(state: mi.parser.ParserState) -> None:
    """Raise SceneError for a PLY that ends early, or is damaged such that Mitsuba would read beyond its vertices."""
    import mitsuba as mi

    for node in state.nodes:
        props = node.props
        if props.plugin_name() == "ply" and "filename" in props:
            used, name = props.was_queried("filename"), str(props["filename"])
            props.mark_queried("filename", used)  # as before this look-up
            require_whole(Path(str(mi.file_resolver().resolve(name))), SceneError)


def _placements(state: mi.parser.ParserState) -> dict[str, Array]:
    """`to_world` (4, 4) of every shape that has one, by its id."""
    import mitsuba as mi

    return {
        node.props.id(): np.array(node.props["to_world"].matrix, np.float64)
        for node in state.nodes
        if node.type == mi.ObjectType.Shape and "to_world" in node.props
    }


def loaded(scene: mi.Scene | str | os.PathLike[str] | Mapping[str, object]) -> mi.Scene:
    """`scene` itself, or the scene loaded from the file of that name, from XML text or from a dictionary."""
    return load(scene) if isinstance(scene, (str, os.PathLike, Mapping)) else scene


def _texts(parameters: Mapping[str, object]) -> dict[str, str]:
    """Texts of the parameters' values."""
    return {name: parameter_text(value) for name, value in parameters.items()}


def _xml_of(path: Path, parameters: Mapping[str, object]) -> SceneXml:
    """XML of the scene file with these values of its parameters."""
    return read_xml(path, _texts(parameters))


def check_parameters(path: Path, parameters: Mapping[str, object]) -> None:
    """Raise SceneError for a name that is no `<default>` of the file or of the files it includes with these values."""
    _require_known(path, _xml_of(path, parameters), parameters)


def _require_known(path: Path, xml: SceneXml, parameters: Mapping[str, object]) -> None:
    """Raise SceneError for a name that is no `<default>` of this XML, or that the parser cannot set."""
    known = xml.defaults
    for name in parameters:
        if name not in known:
            names = ", ".join(known) or "none"
            raise SceneError(f"{path}: the scene has no parameter '{name}'. Its <default> parameters: {names}.")
        if name in ("config", "filename", "string"):  # names of arguments of Mitsuba's parser
            raise SceneError(f"{path}: Mitsuba cannot set a parameter '{name}'. Give the <default> another name.")


def parameter_text(value: object) -> str:
    """Text of a parameter's value for Mitsuba's parser."""
    return str(value).lower() if isinstance(value, (bool, np.bool_)) else str(value)


def _refuse_colours(path: Path, state: mi.parser.ParserState) -> None:
    """Raise SceneError for J_n as a colour or a spectrum, also within a texture: its power would depend on the variant.

    The check precedes the loading of the plugins, because monochrome and colour variants replace `d65` by a number.
    """
    import mitsuba as mi

    todo = [node.props for node in state.nodes if node.props.plugin_name() == "fspt_surface"]
    while todo:
        props = todo.pop()
        for name in props.keys():  # Properties have no iterator
            kind, used, value = props.type(name), props.was_queried(name), props[name]
            props.mark_queried(name, used)  # as before this look-up: Mitsuba reports names that no plugin has queried
            what = "colour" if kind == mi.Properties.Type.Color else ""
            if kind == mi.Properties.Type.Spectrum and not value.is_uniform():
                what = "spectrum"
            if kind == mi.Properties.Type.ResolvedReference:
                inner = state.nodes[value.index()].props
                todo.append(inner)
                what = COLOURS.get(inner.plugin_name(), "")
            if what:
                raise SceneError(
                    f"{path}: '{name}' of an fspt_surface is a {what}, J_n is one number. Give W/mm² as a float or a "
                    "texture of one channel."
                )


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
        r"(?:At|Error while loading|While loading|Parsing of XML file) "
        r"(.*?\(line \d+, col \d+\)|dictionary node \"[^\"]*\"):? (.*)",
        text,
    )
    position, cause = (re.sub("^string ", f"{TEXT} ", found[1]) + ": ", found[2]) if found else ("", text)
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
