"""`fspt view`: a page in the browser whose picture follows sliders."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.backend import quiet_mitsuba
from ..viewer.origin import Origin
from .given_scene import Camera, FNumber, FocalLength, GivenScene, SceneOrPhantom, View, framing_of, one_scene
from .options import AsJson, Parameters, Quiet, Sensor, definitions
from .terminal import print_result


def view(
    scene: SceneOrPhantom,
    view: View = None,
    focal_length: FocalLength = None,
    f_number: FNumber = None,
    camera: Camera = None,
    define: Parameters = None,
    sensor: Sensor = 0,
    port: Annotated[int, typer.Option(help="Of the page on 127.0.0.1; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Show a scene in the browser, with a slider for each of its numbers.

    Of PHANTOM.ply, the scene is that of 'fspt render PHANTOM.ply'.
    Prints the address of the page, with its access token; anyone on this
    machine who has the address can use the page. Ctrl-C ends it.
    """
    from ..viewer.view import view as show

    def ready(address: str) -> None:
        text = f"{address}  (Ctrl-C ends it)"
        # Without a browser nothing else tells where the page is.
        print_result(text, {"address": address, "scene": str(scene)}, as_json=as_json, quiet=quiet and browser)
        if browser:
            webbrowser.open(address)

    quiet_mitsuba()
    given = one_scene(scene, definitions(define), framing_of(view, focal_length, f_number, camera))
    show(given.scene, sensor=sensor, port=port, ready=ready, origin=_origin(scene, given, camera), **given.parameters)


def _origin(scene: Path, given: GivenScene, camera: Path | None) -> Origin | None:
    """The phantom of the scene's text; None for a scene file."""
    if given.origin is None:
        return None
    return Origin(str(scene), ("fspt", "render", str(scene), *(("--camera", str(camera)) if camera else ())))
