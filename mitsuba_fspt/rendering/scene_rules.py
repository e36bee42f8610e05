"""Rules for the XML of a scene. They are checked first, as Mitsuba reports violations badly, not at all, or crashes."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from ..runtime.errors import SceneError
from .scene_xml import SceneXml

REFERENCE = re.compile(r"\$(\w+)")
NO_PROPERTIES = ("default", "alias", "include", "path", "resource")
LISTS = {  # attributes that hold one or several numbers, by element
    **dict.fromkeys(("point", "vector", "translate", "scale", "rotate", "matrix"), ("value",)),
    "lookat": ("origin", "target", "up"),
}
OF_THE_LENS = (
    *("f_number", "magnification", "image_distance", "pixel_pitch", "lens_diameter", "diaphragm_distance"),
    *("pupil_magnification", "distortion", "vignetting"),
)
CAMERAS = ("perspective", "thinlens", "orthographic")  # of Mitsuba
AXIS_ROUNDING = 2e-4  # of the length of a rotation's axis, by four digits a number: Mitsuba scales by up to twice that
NEEDED = {"bitmap": ("filename", "data", "bitmap"), "volume": ("volume",)}  # without one, the texture crashes Mitsuba


def check_text(path: Path, scene: SceneXml) -> None:
    """Raise SceneError, of one line, if the XML of a scene breaks one of the rules of this file."""
    check_values(path, scene)
    for node in scene.nodes:
        _check_duplicates(path, node)
        _check_source(path, node, scene)
        _check_parents(path, node)
        _check_sensor(path, node, scene)
        _check_rotation(path, node, scene)


def check_values(path: Path, scene: SceneXml) -> None:
    """Raise SceneError if a given value is no number, whole number or boolean where one is required.

    Mitsuba would report the line that uses the value, not the parameter's name.
    """
    for node in scene.nodes:
        for attribute, text in node.attrib.items():
            for piece in re.split(r"[\s,]+", text):
                reference = REFERENCE.fullmatch(piece)
                if reference and reference[1] in scene.given:
                    _check_value(path, reference[1], scene.given[reference[1]], node.tag, attribute)


def is_number(text: str) -> bool:
    """True for a finite number in Mitsuba's notation."""
    try:
        return math.isfinite(float(text)) and text.isascii() and "_" not in text
    except ValueError:
        return False


def _check_value(path: Path, name: str, text: str, tag: str, attribute: str) -> None:
    """Raise SceneError if the text of parameter `name` does not fit the attribute of the element `tag`."""
    due = None
    if (tag, attribute) == ("integer", "value"):
        due = None if re.fullmatch(r"\s*-?[0-9]+\s*", text) else "a whole number"
    elif (tag, attribute) == ("boolean", "value"):
        due = None if text.lower() in ("true", "false") else "true or false"
    elif (tag, attribute) == ("float", "value") or attribute in ("x", "y", "z", "angle"):
        due = None if is_number(text) else "a finite number"
    elif attribute in LISTS.get(tag, ()):
        due = None if all(map(is_number, re.split(r"[\s,]+", text.strip()))) else "a finite number"
    if due:
        raise SceneError(f"{path}: parameter '{name}' must be {due}, got '{text}'. Correct this value.")


def _check_duplicates(path: Path, node: ElementTree.Element) -> None:
    """Raise SceneError for two properties of one name: Mitsuba cannot parse the second, or ignores one silently."""
    names = [child.get("name") for child in node if child.tag not in NO_PROPERTIES and child.get("name")]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        thing = node.get("type", node.tag)
        raise SceneError(f"{path}: '{thing}' has '{twice}' more than once. Leave it there once.")


def _check_source(path: Path, node: ElementTree.Element, scene: SceneXml) -> None:
    """Raise SceneError for a texture without its data."""
    kind = scene.fill_in(node.get("type", ""))
    needed = NEEDED.get(kind, ()) if node.tag == "texture" else ()
    if needed and not any(child.get("name") in needed for child in node):
        raise SceneError(f"{path}: a texture '{kind}' has no '{needed[0]}'. Give it one.")


def _check_sensor(path: Path, node: ElementTree.Element, scene: SceneXml) -> None:
    """Raise SceneError for a parameter of `fspt_lens` in another camera: Mitsuba may say that its type is wrong."""
    kind = scene.fill_in(node.get("type", "")) if node.tag == "sensor" else ""
    if kind not in CAMERAS:
        return
    # Mitsuba's own cameras have a `focal_length`, too, as a text such as 50mm.
    left = [
        name
        for child in node
        if (name := child.get("name", "")) in OF_THE_LENS or (child.tag, name) == ("float", "focal_length")
    ]
    if left:
        raise SceneError(
            f"{path}: the sensor '{kind}' has '{left[0]}', a parameter of fspt_lens. Use a sensor of type 'fspt_lens', "
            "or leave that out."
        )


def _check_parents(path: Path, node: ElementTree.Element) -> None:
    """Raise SceneError for an fspt_surface outside a shape: the integral would ignore it, Monte Carlo would fail.

    An fspt_surface with an id is accepted, since a shape may refer to it.
    """
    for child in node if node.tag != "shape" else ():
        if child.get("type") == "fspt_surface" and not child.get("id"):
            raise SceneError(f"{path}: an fspt_surface stands in <{node.tag}>. Put it into the <shape> that glows.")


def _check_rotation(path: Path, node: ElementTree.Element, scene: SceneXml) -> None:
    """Raise SceneError for a rotation about an axis of another length than 1: Mitsuba would stretch what it turns.

    Values that Mitsuba cannot parse are left to it.
    """
    if node.tag != "rotate":
        return
    given = node.get("value")
    texts = [node.get(name, "0") for name in "xyz"] if given is None else re.split(r"[\s,]+", given.strip())
    texts = [scene.fill_in(text).strip() for text in texts]
    try:
        axis = [float(text) for text in (texts if len(texts) == 3 else 3 * texts[:1])]
    except ValueError:
        return
    length = math.hypot(*axis)
    if not abs(length - 1) <= AXIS_ROUNDING:  # NaN, too
        of = " ".join(texts)
        mend = (
            "Give one such as y = 1."
            if not 0 < length < math.inf
            else (
                "Give " + ", ".join(f'{name}="{one / length:.6f}"' for name, one in zip("xyz", axis, strict=True)) + "."
            )
        )
        raise SceneError(
            f"{path}: the axis {of} of a <rotate> must have the length 1, got {length:.6g}: Mitsuba stretches what it "
            f"turns. {mend}"
        )
