"""Loading of scenes: from XML with `<default>` parameters, or a dictionary, to a Mitsuba scene."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..runtime import backend
from ..runtime.errors import SceneError
from ..runtime.interrupt import ctrl_c_noted
from ..runtime.ply_file import require_whole
from .provenance import remember_defaults, remember_placements, remember_source
from .scene_source import SceneSource
from .scene_xml import TEXT

COLOUR_FORMATS = ("rgb", "rgba", "xyz", "xyza")
COLOURS = {  # plugins of colours and of spectra
    **dict.fromkeys(("d65", "srgb"), "colour"),
    **dict.fromkeys(("blackbody", "regular", "irregular"), "spectrum"),
}

if TYPE_CHECKING:
    import mitsuba as mi

    Array = NDArray[np.float64]


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
    return load_source(SceneSource.of(scene, parameters))


def load_source(source: SceneSource) -> mi.Scene:
    """Mitsuba scene of a source, as of `load`."""
    backend.ensure_variant()
    import mitsuba as mi

    from ..emission.of_emitter import probe_beside

    with _files_of(source.folder):
        config = _config()
        state = _parsed(source, config)
        _set_up(state, source)
        placements = _placements(state)
        mi.parser.transform_all(config, state)
        loaded: Any = mi.parser.instantiate(config, state)
    loaded = loaded[0] if isinstance(loaded, list) else loaded
    probe_beside(loaded)
    remember_defaults(loaded, source.values)
    remember_placements(loaded, placements)
    if not isinstance(source.scene, Mapping):
        remember_source(loaded, source.scene, source.parameters)
    return loaded


def parsed(source: SceneSource) -> list[mi.parser.SceneNode]:
    """Elements of a scene as `load` parses and checks them, before Mitsuba's objects are made; raises as `load`."""
    backend.ensure_variant()
    with _files_of(source.folder):
        return list(_parsed(source, _config()).nodes)


def _parsed(source: SceneSource, config: mi.parser.ParserConfig) -> mi.parser.ParserState:
    """Mitsuba's elements of a source, after its check."""
    import mitsuba as mi

    source.check()
    if isinstance(source.scene, Mapping):
        return mi.parser.parse_dict(config, dict(source.scene))
    if source.path is TEXT:
        return mi.parser.parse_string(config, str(source.scene), **source.given)
    return mi.parser.parse_file(config, str(source.path), **source.given)


def _config() -> mi.parser.ParserConfig:
    import mitsuba as mi

    config = mi.parser.ParserConfig(str(mi.variant()))
    config.merge_meshes = False  # shapes keep their ids, and rectangles their bounding boxes
    return config


@contextmanager
def _files_of(folder: Path) -> Iterator[None]:
    """Context manager in which Mitsuba finds files of `folder`, and its errors become SceneErrors of one line."""
    import mitsuba as mi

    files: Any = mi  # whose stubs do not type the functions of its file resolver
    resolver = files.file_resolver()
    files.set_file_resolver(mi.FileResolver(resolver))
    files.file_resolver().prepend(str(folder))
    try:
        with ctrl_c_noted():
            yield
    except (RuntimeError, ValueError) as error:
        raise error if isinstance(error, SceneError) else SceneError(_one_line(str(error))) from error
    finally:
        files.set_file_resolver(resolver)


def _set_up(state: mi.parser.ParserState, source: SceneSource) -> None:
    """Set robust mode, ids and film formats of a parsed scene; SceneError if its root element is no scene."""
    root = state.root.props
    if root.plugin_name() != "scene":
        raise SceneError(f"{source.path}: the root is <{root.plugin_name()}>, a scene file has <scene>. Give one.")
    root["embree_use_robust_intersections"] = True
    root.set_id(" ".join([str(source.path), *(f"{name}={text}" for name, text in source.given.items())]))
    _refuse_colours(source.path, state)
    _require_whole_meshes(state)
    _name_children(state)
    _set_film_formats(state)


def _require_whole_meshes(state: mi.parser.ParserState) -> None:
    """Raise SceneError for a PLY that ends early, or is damaged such that Mitsuba would read beyond its vertices."""
    import mitsuba as mi

    files: Any = mi
    for node in state.nodes:
        props = node.props
        if props.plugin_name() == "ply" and "filename" in props:
            used, name = props.was_queried("filename"), str(props["filename"])
            props.mark_queried("filename", used)  # as before this look-up
            require_whole(Path(str(files.file_resolver().resolve(name))), SceneError)


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


def _refuse_colours(path: Path, state: mi.parser.ParserState) -> None:
    """Raise SceneError for J_n as a colour or a spectrum, also within a texture: its power would depend on the variant.

    The check precedes the loading of the plugins, because monochrome and colour variants replace `d65` by a number.
    """
    import mitsuba as mi

    kinds: Any = mi.Properties.Type
    todo = [node.props for node in state.nodes if node.props.plugin_name() == "fspt_surface"]
    while todo:
        props = todo.pop()
        for name in props.keys():  # Properties have no iterator
            kind, used, value = props.type(name), props.was_queried(name), props[name]
            props.mark_queried(name, used)  # as before this look-up: Mitsuba reports names that no plugin has queried
            what = "colour" if kind == kinds.Color else ""
            if kind == kinds.Spectrum and not value.is_uniform():
                what = "spectrum"
            if kind == kinds.ResolvedReference:
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
