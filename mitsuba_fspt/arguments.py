"""Arguments that several verbs of the command line have, and what is made of them before the work begins."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from .atomic import require_place
from .errors import ImageError, SceneError

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE.xml", help="Mitsuba scene with an fspt_lens.")]
Parameters = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Value for a <default> of the scene; repeatable."),
]


def definitions(define: list[str] | None) -> dict[str, str]:
    """Values by name of the options -D NAME=VALUE; SceneError for one that is none."""
    pairs = dict(text.partition("=")[::2] for text in define or ())
    for text in define or ():
        if "=" not in text.strip("="):
            raise SceneError(f"-D {text}: must be NAME=VALUE, for example -D f_number=8.")
    return pairs


def require_writable(path: Path, suffix: str) -> None:
    """Refuse an output that cannot be written before the work, not after it."""
    if path.suffix != suffix:
        raise ImageError(f"{path}: images are written as {suffix}. Give a name such as image{suffix}.")
    require_place(path, ImageError)
    if not os.access(path.parent, os.W_OK):
        raise ImageError(f"{path}: the folder '{path.parent}' is not writable. Write elsewhere with -o.")
