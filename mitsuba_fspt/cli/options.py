"""Options that several verbs of the command line share, and checks of them before the work begins."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Annotated

import typer

from ..rendering.scene_rules import is_number
from ..runtime.atomic_files import require_place
from ..runtime.errors import FsptError, ImageError, SceneError

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE.xml", help="Mitsuba scene with an fspt_lens.")]
Parameters = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Value for a <default> of the scene; repeatable."),
]
ParameterLists = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=V1,V2,...",
        help="Values for a <default> of the scene, or start:stop:step with stop left out; repeatable.",
    ),
]
Method = Annotated[
    str | None,
    typer.Option(
        help="integral, path or ptracer; the scene's own if left out.",
        autocompletion=lambda: ["integral", "path", "ptracer"],
    ),
]
Rtol = Annotated[float | None, typer.Option(help="Error of the integral relative to the brightest pixel.")]
Domain = Annotated[
    str | None,
    typer.Option(help="pupil or surface; the scene's own if left out.", autocompletion=lambda: ["pupil", "surface"]),
]
Spp = Annotated[int | None, typer.Option(help="Monte Carlo samples a pixel.")]
MaxDepth = Annotated[
    int | None, typer.Option(metavar="N", help="Legs of light that path and ptracer follow; what the scene needs.")
]
MaxTime = Annotated[
    float | None, typer.Option(metavar="SECONDS", help="Stop refining then: the best image so far, with its errors.")
]
Sensor = Annotated[int, typer.Option(metavar="K", help="Number of the scene's sensor, counted from 0.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the Monte Carlo.")]
SourcePower = Annotated[
    float | None, typer.Option(metavar="W", help="Power of the light source [W], for a scene that is per 1 W of it.")
]
GainError = Annotated[
    float | None, typer.Option(help="Relative uncertainty common to all pixels; that of the images if left out.")
]
GainPerView = Annotated[
    float, typer.Option(metavar="SD", help="Relative uncertainty of a factor of each view, fitted as well; 0: none.")
]
Sampled = Annotated[
    bool, typer.Option("--sampled", help="Images of a Monte Carlo: their errors come from the scatter of samples.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Rows = Annotated[bool, typer.Option("--json", help="Print one JSON array of all rows.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print no results and no progress; warnings stay.")]
Unit = Annotated[
    str,
    typer.Option(
        metavar="W|photons/s|p/s/cm2/sr",
        help="Of the values: power, photon rate or radiance.",
        autocompletion=lambda: ["W", "photons/s", "p/s/cm2/sr"],
    ),
]
WavelengthNm = Annotated[float | None, typer.Option(help="Of the light [nm], for photons and electrons.")]
SpectrumFile = Annotated[
    Path | None,
    typer.Option(
        "--spectrum", metavar="CSV", help="Of the light at the detector: nm, power per nm; for --wavelength-nm."
    ),
]
MOST = 100_000  # values of a range
NAMES = {
    ".xml": "scene",
    ".png": "picture",
    ".csv": "table",
    ".ply": "phantom",
    ".vol": "fluence",
    ".vtu": "source",
    ".npz": "T",
    ".toml": "camera",
}


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


def typed(values: Mapping[str, str]) -> dict[str, float | str]:
    """The values that are numbers as such, others as text."""
    return {name: float(text) if is_number(text) else text for name, text in values.items()}


def value_lists(define: list[str] | None) -> dict[str, list[str]]:
    """Lists of values by name from the options -D NAME=V1,V2,...; SceneError as of `definitions`."""
    values: dict[str, list[str]] = {}
    for text in define or ():
        name, equals, listed = text.partition("=")
        if not (name and equals):
            raise SceneError(f"-D {text}: must be NAME=V1,V2,…, for example -D f_number=2.8,5.6.")
        if name in values:
            raise SceneError(f"-D {text}: '{name}' is given twice. Put all values into one, -D {name}=1,2.")
        values[name] = several(name, listed)
    return values


def several(name: str, text: str) -> list[str]:
    """Values of a parameter from text: V1,V2,… and ranges start:stop:step, whose stop is left out.

    Raises SceneError for a range that never ends, or has more than `MOST` values.
    """
    return [value for piece in text.split(",") for value in (_range(name, piece) or [piece.strip()])]


def _range(name: str, text: str) -> list[str] | None:
    """Values of a range, without rounding errors; None for text that is no range of numbers."""
    try:
        numbers = [Decimal(part.strip()) for part in text.split(":")]
    except InvalidOperation:
        return None
    if len(numbers) == 1:
        return None
    if len(numbers) != 3 or not all(number.is_finite() for number in numbers):
        raise SceneError(f"{name}={text}: a range is start:stop:step. Give for example {name}=0:360:10.")
    start, stop, step = numbers
    if step == 0 or (stop - start) * step <= 0:
        raise SceneError(
            f"{name}={text}: the step {step} does not lead from {start} to {stop}. Give start:stop:step, for "
            f"example {name}=0:360:10; stop is left out."
        )
    count = math.ceil((stop - start) / step)
    if count > MOST:
        raise SceneError(f"{name}={text}: has {count} values, at most {MOST} are taken. Give a larger step.")
    return [f"{(start + k * step).normalize():f}" for k in range(count)]


def require_writable(path: Path, suffix: str | None = None, error: type[FsptError] = ImageError) -> None:
    """Raise `error` for an output file that cannot be written, or that has another suffix (None: any suffix)."""
    if suffix and path.suffix.lower() != suffix:
        raise error(f"output file '{path}' must end in {suffix}. Give a name such as {NAMES[suffix]}{suffix}.")
    require_place(path, error)
    if not os.access(path.parent, os.W_OK):
        raise error(f"output file '{path}': the folder '{path.parent}' is not writable. Write elsewhere with -o.")


def require_image(path: Path) -> None:
    """Raise ImageError for an image that cannot be written, BackendError where its format needs a missing package."""
    from ..images.formats import format_of

    format_of(path)
    require_writable(path)


def require_picture(path: Path) -> None:
    """Raise ImageError for a PNG file that cannot be written, BackendError where matplotlib is missing."""
    from ..images.picture import require_matplotlib

    require_writable(path, ".png")
    require_matplotlib()
