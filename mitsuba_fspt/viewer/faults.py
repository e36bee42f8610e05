"""Messages of errors in the words of the page, whose sliders are parameters of the scene."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from ..rendering.scene_xml import SceneXml

LENS = "fspt_lens"


def in_parameters(message: str, scene: SceneXml, changed: Mapping[str, str]) -> str:
    """The message with names of parameters in place of the properties of the lens that they set.

    'to_world' becomes 'distance' where the lens's place is set by a parameter of that name. The values that were
    changed since the last picture are added, unless the message names one of them already.

    message : of one line
    scene : with its parameters
    changed : values that were changed since the last picture, as texts by name
    """
    if LENS in message:
        for name, parameters in _parameters_of_lens(scene).items():
            if name not in parameters:
                message = message.replace(f"'{name}'", " or ".join(f"'{parameter}'" for parameter in parameters))
    if not changed or any(f"'{name}'" in message for name in changed):
        return message
    values = ", ".join(f"{name} = {text}" for name, text in changed.items())
    return f"{message.rstrip('.')}. Changed since the last picture: {values}."


def _parameters_of_lens(scene: SceneXml) -> dict[str, list[str]]:
    """The parameters that each property of the lens is made of, if any."""
    found: dict[str, list[str]] = {}
    for node in scene.nodes:
        for child in node if node.get("type") == LENS else ():
            texts = " ".join(text for inner in child.iter() for text in inner.attrib.values())
            if names := list(_used(texts, scene.defaults)):
                found[child.get("name", "")] = names
    return found


def _used(text: str, names: Iterable[str]) -> Iterable[str]:
    """Those of the names that the text refers to as $name."""
    return (name for name in names if name and re.search(re.escape(f"${name}") + r"(?!\w)", text))
