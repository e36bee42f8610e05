"""`fspt.view`: the live view of a scene, as a page in the browser or as a widget of a notebook."""

from __future__ import annotations

import os
import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..runtime.extras import require
from ..runtime.progress_bar import in_notebook
from .answers import Answers
from .origin import Origin

if TYPE_CHECKING:
    import mitsuba as mi


def view(
    scene: mi.Scene | str | os.PathLike[str],
    *,
    sensor: int = 0,
    port: int = 0,
    ready: Callable[[str], object] | None = None,
    origin: Origin | None = None,
    **parameters: object,
) -> object:
    """Show a scene with sliders for the numbers among its `<default>` parameters; the image follows them.

    In a notebook it returns a widget. Elsewhere it serves a page on 127.0.0.1 until Ctrl-C, and returns None.

    Parameters
    ----------
    scene : name of an XML file, XML text, or a scene that `load` has made from one of them
    sensor : number of the lens, in a scene with several
    port : of the page; 0: any free one. Without effect in a notebook
    ready : function that is called with the page's address; None opens it in the browser
    origin : file of which XML text was made, which the page names in place of the text
    parameters : values for `<default>` parameters

    Raises
    ------
    SceneError, OpticsError, ExitanceError : the scene cannot be loaded, or was changed after that.
    ViewerError : the port cannot be opened.
    BackendError : a package of the extra `view`, in a notebook of `notebook`, is not installed.
    """
    if in_notebook() and ready is None:
        require("anywidget", "The viewer in a notebook")
        from .widget import widget

        return widget(Answers(scene, parameters, sensor, origin))
    for module in ("starlette", "uvicorn", "websockets"):
        require(module, "The viewer")
    from .server import ViewServer

    ViewServer(lambda: Answers(scene, parameters, sensor, origin), port).run(ready or webbrowser.open)
    return None
