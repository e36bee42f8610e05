"""`fspt plot`, `compare` and `roi`: pictures of images, comparison, regions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.atomic_files import atomic_path, require_apart
from ..runtime.errors import ImageError
from .options import (
    AsJson,
    Quiet,
    Rows,
    SpectrumFile,
    Unit,
    WavelengthNm,
    require_picture,
    require_writable,
)
from .terminal import print_result


def compare(
    calculated: Annotated[Path, typer.Argument(metavar="CALCULATED")],
    standard: Annotated[Path, typer.Argument(metavar="STANDARD")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, profiles included.")] = False,
    quiet: Quiet = False,
    png: Annotated[Path | None, typer.Option(help="Also draw both images and their difference.")] = None,
) -> None:
    """Compare two images: ME and CF as the paper defines them, largest and RMS error, a z-test."""
    from ..images.comparison import compare
    from ..images.image import read

    if png:
        require_picture(png)
        require_apart(png, [calculated, standard], "--png", ImageError)
    images = read(calculated), read(standard)
    result = compare(*images)
    for path, image, other in zip((calculated, standard), images, images[::-1], strict=True):
        if image.error is None and other.error is not None:
            typer.echo(f"fspt: {path}: it has no plane of errors; its power is taken as exact.", err=True)
    if result.masked:
        typer.echo(f"fspt: compare: {result.masked} pixels masked in either image are left out.", err=True)
    if png:
        from ..images.picture import write_comparison_png

        write_comparison_png(*images, result, png)
    print_result(result.render_text(), result.to_dict(), as_json=as_json, quiet=quiet)


def plot(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Images, a panel each.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Picture to write, .png; IMAGE.png, or plot.png for several.")
    ] = None,
    log: Annotated[bool, typer.Option("--log", help="Logarithmic colour scale.")] = False,
    limits: Annotated[
        str | None, typer.Option("--range", metavar="A,B", help="Ends of the colour scale [unit, W/pixel if left out].")
    ] = None,
    per_panel: Annotated[bool, typer.Option("--per-panel", help="A colour scale for each image.")] = False,
    outline: Annotated[bool, typer.Option("--outline", help="Draw the outline of the phantom.")] = False,
    unit: Unit = "W",
    wavelength_nm: WavelengthNm = None,
    spectrum: SpectrumFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Draw images, or electrons of 'fspt expose', with colour bar, axes in mm and total.

    The scale is logarithmic where peaks differ a lot.
    """
    from ..images.exposure import Exposure
    from ..images.image import read_image_or_exposure
    from ..images.picture import draw_panels, save_figure
    from ..optics.light import Light

    if per_panel and len(images) == 1:
        raise ImageError("--per-panel has no meaning for one image, which has its own scale. Leave it out.")
    output = output or Path(f"{images[0].stem}.png" if len(images) == 1 else "plot.png")
    require_picture(output)
    require_apart(output, images, error=ImageError)
    pictures = [read_image_or_exposure(path) for path in images]
    ends = _range(limits) if limits is not None else None
    names = [path.stem for path in images]
    figure = draw_panels(
        pictures,
        names,
        log=log,
        limits=ends,
        per_panel=per_panel,
        outline=outline,
        unit=unit,
        light=Light.given(wavelength_nm, spectrum),
    )
    save_figure(figure, output)
    masked = [0 if isinstance(image, Exposure) else image.masked for image in pictures]
    if any(masked):
        counts = ", ".join(f"{count} of {path}" for count, path in zip(masked, images, strict=True) if count)
        typer.echo(f"fspt: plot: total powers leave out masked pixels: {counts}.", err=True)
    totals = [None if isinstance(image, Exposure) else image.total_power for image in pictures]
    record = {"output": str(output), "images": [*map(str, images)], "total_power": totals, "power_unit": "W"}
    record["masked"] = masked
    if any(isinstance(image, Exposure) for image in pictures):
        record["total_electrons"] = [image.total if isinstance(image, Exposure) else None for image in pictures]
    text = f"{output}: {len(images)} {'image' if len(images) == 1 else 'images'}"
    print_result(text, record, as_json=as_json, quiet=quiet)


def roi(
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGE...", help="Power images, as 'fspt render' writes them.")
    ],
    region: Annotated[
        list[str] | None,
        typer.Option(
            "--roi",
            metavar="X,Y,W,H|circle:X,Y,R|25%|MASK.tif",
            help="Region in pixels from the upper left corner, or of the brightest pixel; repeatable; else all pixels.",
        ),
    ] = None,
    wavelength_nm: WavelengthNm = None,
    spectrum: SpectrumFile = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Table to write, .csv.")] = None,
    as_json: Rows = False,
    quiet: Quiet = False,
) -> None:
    """Measure regions: total flux, mean and largest radiance with error, area, as imaging programs print them.

    Prints a CSV with a row for each image and region. What the columns mean,
    beside those of other programs: docs/units.md.
    """
    from ..images.image import read
    from ..images.regions import csv_table, measure
    from ..optics.light import Light

    if output:
        require_writable(output, ".csv")
        require_apart(output, images, error=ImageError)
    light = Light.given(wavelength_nm, spectrum)
    regions: list[str | None] = [*region] if region else [None]
    rows = []
    for path in images:
        image = read(path)
        rows += [(str(path), name or "all", measure(image, name, light)) for name in regions]
    for name, one, found in rows:
        if found.masked:
            typer.echo(
                f"fspt: {name}, region {one}: {found.masked} masked pixels are left out; its numbers are those of the "
                f"{found.pixels} others.",
                err=True,
            )
    table = csv_table(rows)
    if output:
        with atomic_path(output, ImageError) as temporary:
            temporary.write_text(table, encoding="utf-8")
    record = [{"image": image, "region": name} | asdict(found) for image, name, found in rows]
    print_result(f"{output}: {len(rows)} rows" if output else table.rstrip("\n"), record, as_json=as_json, quiet=quiet)


def _range(text: str) -> tuple[float, float]:
    """Two numbers from the text A,B; ImageError for another text."""
    try:
        low, high = map(float, text.split(","))
    except ValueError as cause:
        raise ImageError(f"--range {text}: must be two numbers A,B in W/pixel, for example --range 0,1e-9.") from cause
    return low, high
