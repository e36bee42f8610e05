"""Scenes that verbs take: a file, or views of a phantom before a camera; and the options for the latter."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from ..optics.focused_lens import FOCUS
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import read_text
from ..runtime.errors import SceneError
from .options import several, typed

SceneOrPhantom = Annotated[
    Path, typer.Argument(metavar="SCENE.xml|PHANTOM.ply", help="Mitsuba scene with an fspt_lens, or a phantom.")
]
Views = Annotated[
    str | None, typer.Option(metavar="0,90,...", help="Of a phantom: turns about +z [degrees], an image each.")
]
View = Annotated[str | None, typer.Option(metavar="DEGREES", help="Of a phantom: turn about +z [degrees].")]
FocalLength = Annotated[float | None, typer.Option(help="Before a phantom: F [mm], 50 if left out.")]
FNumber = Annotated[float | None, typer.Option(help="Before a phantom: F/D, 1.8 if left out.")]
Camera = Annotated[
    Path | None, typer.Option(metavar="CAMERA.toml", help="Before a phantom: camera with a table [lens].")
]


class GivenScene(NamedTuple):
    """A scene with values for its parameters.

    scene : name of the file, or its text
    parameters : values for its `<default>` parameters
    view : turn of a phantom [degrees], as it was given; '' of a scene file
    origin : what metadata and the page call the scene; None leaves that to `load`
    warning : about the camera that was chosen for a phantom
    """

    scene: Path | str
    parameters: dict[str, str]
    view: str = ""
    origin: str | None = None
    warning: str | None = None


def framing_of(
    view: str | None, focal_length: float | None, f_number: float | None, camera: Path | None
) -> dict[str, Any]:
    """The options for a phantom that are given, by name."""
    options = {"view": view, "focal_length": focal_length, "f_number": f_number, "camera": camera}
    return {name: value for name, value in options.items() if value is not None}


def scenes_of(scene: Path, parameters: dict[str, str], framing: dict[str, Any]) -> list[GivenScene]:
    """The scene, or every view of a phantom in the order given; -D and options overrule the camera's file.

    Raises SceneError for an option that does not go with the file, and as `scene_xml`.
    """
    if scene.suffix.lower() == ".ply":
        return _views(scene, parameters, dict(framing))
    if framing:
        option = "--" + next(iter(framing)).replace("_", "-")
        raise SceneError(
            f"{option} goes with PHANTOM.ply, '{scene}' is a scene with parameters of its own. Give -D NAME=VALUE."
        )
    return [GivenScene(scene, parameters)]


def one_scene(scene: Path, parameters: dict[str, str], framing: dict[str, Any]) -> GivenScene:
    """The scene, or the only view of a phantom; SceneError for several views, and as `scenes_of`."""
    scenes = scenes_of(scene, parameters, framing)
    if len(scenes) > 1:
        views = ",".join(one.view for one in scenes)
        raise SceneError(
            f"--view {views}: must be one number of degrees here. Give for example --view {scenes[0].view}."
        )
    return scenes[0]


def _views(phantom: Path, parameters: dict[str, str], framing: dict[str, Any]) -> list[GivenScene]:
    """A phantom's views."""
    from ..phantom.framed_scene import camera_lens, front_behind_focus, text_and_outline

    if twice := set(parameters) & set(framing):
        name = min(twice)
        raise SceneError(f"-D {name}={parameters[name]}: --{name.replace('_', '-')} gives it already. Give it once.")
    numbers = typed({name: text for name, text in parameters.items() if name != "view"})
    lens = camera_lens(framing.pop("camera")) if "camera" in framing else {}
    if set(FOCUS) & set(numbers):  # takes the place of the focus in the camera's file
        lens = {name: value for name, value in lens.items() if name not in FOCUS}
    views = several("view", framing.pop("view", parameters.get("view", "0")))
    if wrong := [view for view in views if not is_number(view) or views.count(view) > 1]:
        raise SceneError(f"--view: must be different numbers of degrees, got '{wrong[0]}'. Give for example 0,90,180.")
    settings = lens | numbers | framing
    text, outline = text_and_outline(phantom, **settings)
    magnified = float(settings.get("pupil_magnification", 1.0))
    scenes, defaults = [], read_text(text, {}).defaults
    for view in views:
        values = defaults | {"view": view}
        origin = " ".join([str(phantom), *(f"{name}={value}" for name, value in values.items())])
        placed = {name: float(number) for name, number in values.items()}
        warning = front_behind_focus(outline, placed, float(view), magnified)
        scenes.append(GivenScene(text, {"view": view}, view, origin, warning))
    return scenes
