"""`fspt expose`: electrons and counts of a detector behind the lens."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ..rendering.scene_rules import is_number
from ..runtime.atomic_files import require_apart
from ..runtime.errors import ImageError
from .options import AsJson, Quiet, SourcePower, SpectrumFile, WavelengthNm, require_image
from .terminal import print_result

MAP = "or a map, .fits, .tif, .npy"
Camera = Annotated[
    Path | None,
    typer.Option(metavar="CAMERA.toml", help="Camera with a table [detector]; a typical cooled CCD if left out."),
]
Counts = Annotated[Path | None, typer.Option(help="Also write the counts [DN], 16-bit .png or .tif.")]
Efficiency = Annotated[
    str | None, typer.Option(metavar="X|CSV", help="Electrons per photon, in (0, 1], or a CSV of nm, efficiency.")
]
DarkCurrent = Annotated[str | None, typer.Option(metavar="X|MAP", help=f"[e-/px/s], of a --pixel-pitch, {MAP}.")]
ReadNoise = Annotated[str | None, typer.Option(metavar="X|MAP", help=f"Of one read-out [e-], {MAP}.")]
FullWell = Annotated[float | None, typer.Option(help="Of a read-out pixel, binned or not [e-].")]
Gain = Annotated[str | None, typer.Option(metavar="X|MAP", help=f"[e-/DN]; 1/K in EMVA 1288, {MAP}.")]
Bias = Annotated[str | None, typer.Option(metavar="X|MAP", help=f"[DN], {MAP}.")]
Bits = Annotated[int | None, typer.Option(help="Of the converter, 1 to 16.")]
Pitch = Annotated[float | None, typer.Option(help="Of the detector's own pixels [mm].")]
EmGain = Annotated[float | None, typer.Option(help="Of a multiplying register; gain and read noise are after it.")]
Excess = Annotated[float | None, typer.Option(help="F^2 of the register; 2 if left out.")]
Spurious = Annotated[float | None, typer.Option(help="Clock-induced charge before the register [e-/px/frame].")]
Prnu = Annotated[str | None, typer.Option(metavar="X|MAP", help=f"Relative deviation of the response, {MAP}.")]


def expose(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="Power image, as 'fspt render' writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Electrons to write: .exr, .tif, .h5, .npz or .fits.")],
    exposure_time: Annotated[float, typer.Option(help="Exposure time [s].")],
    wavelength_nm: WavelengthNm = None,
    spectrum: SpectrumFile = None,
    source_power: SourcePower = None,
    binning: Annotated[int, typer.Option(help="Pixels per side binned before read-out.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    counts: Counts = None,
    detector: Camera = None,
    quantum_efficiency: Efficiency = None,
    dark_current: DarkCurrent = None,
    read_noise: ReadNoise = None,
    full_well: FullWell = None,
    gain: Gain = None,
    bias: Bias = None,
    bits: Bits = None,
    pixel_pitch: Pitch = None,
    em_gain: EmGain = None,
    excess_noise: Excess = None,
    spurious_charge: Spurious = None,
    prnu: Prnu = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Expose a detector to an image: electrons, and with --counts counts.

    The detector is that of CAMERA.toml, or a typical cooled CCD (not a data
    sheet); options replace its numbers.
    """
    from ..detector.detector import Detector
    from ..images.image import read

    given = dict(locals())
    require_image(output)
    inputs = [image, detector] if detector else [image]
    require_apart(output, inputs, error=ImageError)
    if counts:
        require_apart(counts, [*inputs, output], "--counts", ImageError)
    camera = Detector.from_toml(detector) if detector else Detector.typical_ccd()
    camera = replace(camera, **_numbers(given))
    power = read(image)
    power = power if source_power is None else power.scaled(source_power)
    exposure = camera.expose(power, exposure_time, wavelength_nm, spectrum=spectrum, binning=binning, seed=seed)
    with exposure.counts_file(counts) if counts else nullcontext():  # both files or none
        exposure.write(output)
    peak, saturated = float(exposure.electrons.max()), exposure.metadata["saturated_pixels"]
    record = {"output": str(output), "counts": counts and str(counts), "peak": peak, "saturated_pixels": saturated}
    text = f"{output}: brightest pixel {peak:.6g} electrons, {saturated} pixels saturated"
    print_result(text, record, as_json=as_json, quiet=quiet)


def _numbers(given: dict[str, Any]) -> dict[str, Any]:
    """Parameters of the detector among the options, numbers or names of maps."""
    from ..detector.parameters import EXAMPLES

    found = {name: given.get(name) for name in EXAMPLES}
    return {
        name: float(value) if isinstance(value, str) and is_number(value) else value
        for name, value in found.items()
        if value is not None
    }
