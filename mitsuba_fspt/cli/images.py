"""`fspt compare` and `fspt expose`: two images against each other, and the detector's response to one."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.atomic_files import require_apart
from ..runtime.errors import ImageError


def compare(
    calculated: Annotated[Path, typer.Argument(metavar="CALCULATED.exr")],
    standard: Annotated[Path, typer.Argument(metavar="STANDARD.exr")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, profiles included.")] = False,
    png: Annotated[Path | None, typer.Option(help="Also draw both images and their difference.")] = None,
) -> None:
    """Compare two images: ME and CF as the paper defines them, largest and RMS error, a z-test."""
    from ..images.comparison import compare
    from ..images.image import read

    images = read(calculated), read(standard)
    result = compare(*images)
    if png:
        from ..images.picture import write_comparison_png

        write_comparison_png(*images, png)
    typer.echo(json.dumps(result.to_dict()) if as_json else result.render_text())


def expose(
    image: Annotated[Path, typer.Argument(metavar="IMAGE.exr", help="Power image, as 'fspt render' writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Electrons to write, .exr.")],
    exposure_time: Annotated[float, typer.Option(help="Exposure time [s].")],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength [nm].")],
    binning: Annotated[int, typer.Option(help="Pixels per side binned before read-out.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    counts: Annotated[Path | None, typer.Option(help="Also write the counts [DN], 16-bit .png or .tif.")] = None,
) -> None:
    """Expose a typical cooled CCD (not a data sheet) to an image: electrons, and counts if asked."""
    from ..images.detector import Detector
    from ..images.image import read

    require_apart(output, [image], error=ImageError)
    exposure = Detector.typical_ccd().expose(
        read(image), exposure_time=exposure_time, wavelength_nm=wavelength_nm, binning=binning, seed=seed
    )
    with exposure.counts_file(counts) if counts else nullcontext():  # both files or none
        exposure.write(output)
    saturated = exposure.metadata["saturated_pixels"]
    typer.echo(f"{output}: brightest pixel {exposure.electrons.max():.6g} electrons, {saturated} pixels saturated")
