"""Options that several verbs of the command line share, and checks of them before the work begins."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.atomic_files import require_place
from ..runtime.errors import FsptError, ImageError, SceneError

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE.xml", help="Mitsuba scene with an fspt_lens.")]
Parameters = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Value for a <default> of the scene; repeatable."),
]
Method = Annotated[str | None, typer.Option(help="integral, path or ptracer; the scene's own if left out.")]
Rtol = Annotated[float | None, typer.Option(help="Error of the integral relative to the brightest pixel.")]
Domain = Annotated[str | None, typer.Option(help="pupil or surface; the scene's own if left out.")]
Spp = Annotated[int | None, typer.Option(help="Monte Carlo samples a pixel.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the Monte Carlo.")]
SourcePower = Annotated[
    float | None, typer.Option(metavar="W", help="Power of the light source [W], for a scene that is per 1 W of it.")
]
NAMES = {".exr": "image", ".png": "picture", ".csv": "table", ".ply": "phantom", ".vol": "fluence"}


def definitions(define: list[str] | None) -> dict[str, str]:
    """Values by name from the options -D NAME=VALUE; SceneError for text of another form or a name given twice."""
    pairs: dict[str, str] = {}
    for text in define or ():
        if "=" not in text.strip("="):
            raise SceneError(f"-D {text}: must be NAME=VALUE, for example -D f_number=8.")
        name, _, value = text.partition("=")
        if name in pairs:
            raise SceneError(f"-D {text}: {name} is {pairs[name]} already. Give each name once.")
        pairs[name] = value
    return pairs


def require_writable(path: Path, suffix: str | None = None, error: type[FsptError] = ImageError) -> None:
    """Raise `error` for an output file that cannot be written, or that has another suffix (None: any suffix)."""
    if suffix and path.suffix.lower() != suffix:
        raise error(f"output file '{path}' must end in {suffix}. Give a name such as {NAMES[suffix]}{suffix}.")
    require_place(path, error)
    if not os.access(path.parent, os.W_OK):
        raise error(f"output file '{path}': the folder '{path.parent}' is not writable. Write elsewhere with -o.")


def require_picture(path: Path) -> None:
    """Raise ImageError for a PNG file that cannot be written, BackendError where matplotlib is missing."""
    from ..images.picture import require_matplotlib

    require_writable(path, ".png")
    require_matplotlib()
