"""`fspt render`: the image of a scene."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..rendering.scene_xml import read_xml
from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import ImageError
from .options import (
    Domain,
    Method,
    Parameters,
    Rtol,
    SceneFile,
    Seed,
    SourcePower,
    Spp,
    definitions,
    require_picture,
    require_writable,
)
from .terminal import progress_bar

if TYPE_CHECKING:
    from ..images.image import Image


def render(
    scene: SceneFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Image to write, .exr.")] = None,
    method: Method = None,
    rtol: Rtol = None,
    domain: Domain = None,
    spp: Spp = None,
    seed: Seed = None,
    source_power: SourcePower = None,
    define: Parameters = None,
    png: Annotated[bool, typer.Option("--png", help="Also write a picture to look at, beside the image.")] = False,
    shortcuts: Annotated[bool, typer.Option(help="Leave out what the scene does not need, see 'fspt explain'.")] = True,
) -> None:
    """Render a scene to an EXR with the power [W], its error and the coverage of every pixel."""
    output = output or Path((scene.stem or "image") + ".exr")
    require_writable(output, ".exr")
    picture, parameters = output.with_suffix(".png") if png else None, definitions(define)
    if picture:
        require_picture(picture)
    for written in (output, picture) if picture else (output,):
        require_apart(written, read_xml(scene, parameters).sources(), error=ImageError)
    if source_power is not None:
        from ..images.image import required_source_power

        required_source_power(source_power)
    with progress_bar() as progress:
        from ..rendering.render import render
        from ..rendering.scene import load

        quiet_mitsuba()
        loaded = load(scene, **parameters)
        image = render(
            loaded, method=method, rtol=rtol, domain=domain, shortcuts=shortcuts, spp=spp, seed=seed, progress=progress
        )
    image = image if source_power is None else image.scaled(source_power)
    _write(image, output, picture)
    _print_summary(image, output, picture)


def _write(image: Image, output: Path, picture: Path | None) -> None:
    """Write the image and, if `picture` is given, its PNG: both files or none."""
    from ..images.picture import png_file

    with png_file(image, picture) if picture else nullcontext():
        image.write(output)


def _print_summary(image: Image, output: Path, picture: Path | None) -> None:
    """Print the files, the total power and the brightest pixel; on stderr what the metadata warn of."""
    power, peak = image.power.sum(), image.power.max()
    typer.echo(f"{output}: total {power:.6g} W, brightest pixel {peak:.6g} W, {image.metadata['wall_time']:.3g} s")
    if picture:
        typer.echo(f"{picture}: the same to look at")
    if "warnings" in image.metadata:
        typer.echo(f"fspt: {output}: {image.metadata['warnings']}.", err=True)
