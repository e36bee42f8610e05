"""`fspt view`: a page in the browser whose picture follows sliders."""

from __future__ import annotations

import webbrowser
from typing import Annotated

import typer

from ..runtime.backend import quiet_mitsuba
from .options import AsJson, Parameters, Quiet, SceneFile, Sensor, definitions
from .terminal import print_result


def view(
    scene: SceneFile,
    define: Parameters = None,
    sensor: Sensor = 0,
    port: Annotated[int, typer.Option(help="Of the page on 127.0.0.1; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Show a scene in the browser, with a slider for each of its numbers.

    Prints the address of the page, with its access token; anyone on this
    machine who has the address can use the page. Ctrl-C ends it.
    """
    from ..viewer.view import view as show

    def ready(address: str) -> None:
        text = f"{address}  (Ctrl-C ends it)"
        print_result(text, {"address": address, "scene": str(scene)}, as_json=as_json, quiet=quiet)
        if browser:
            webbrowser.open(address)

    quiet_mitsuba()
    show(scene, sensor=sensor, port=port, ready=ready, **definitions(define))
