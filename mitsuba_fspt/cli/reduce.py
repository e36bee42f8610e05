"""`fspt reduce`: counts of a camera to power on its pixels, and the calibration by a uniform source."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from ..runtime.atomic_files import require_apart
from ..runtime.errors import DetectorError, ImageError
from ..runtime.progress_bar import progress_bar
from .options import AsJson, Quiet, require_image, require_writable
from .terminal import print_result

if TYPE_CHECKING:
    from ..detector.counts import Counts
    from ..detector.detector import Detector
    from ..detector.reduction import Exposed
    from ..images.image import Image
    from ..optics.thin_lens import Lens

Frame = Annotated[Path | None, typer.Option(metavar="FILE", help="Frame or stack [DN]: .tif, .fits, .npy.")]


def reduce(
    counts: Annotated[list[Path], typer.Argument(metavar="COUNTS...", help=".tif, .fits, .npy, or a click folder.")],
    detector: Annotated[Path, typer.Option(metavar="CAMERA.toml", help="Camera with a table [detector].")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Image to write, .exr; of several OUT_0.exr, …")],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength [nm].")],
    exposure_time: Annotated[float | None, typer.Option(help="[s] of a frame; that of the file if left out.")] = None,
    binning: Annotated[
        int | None, typer.Option(help="Side of the square of pixels read out as one; that of the file, else 1.")
    ] = None,
    pixel_pitch: Annotated[
        float | None, typer.Option(help="Of the pixels read out [mm]; detector's x binning.")
    ] = None,
    bias: Frame = None,
    dark: Frame = None,
    flat: Frame = None,
    cosmic_rays: Annotated[bool, typer.Option("--cosmic-rays", help="Mask pixels that cosmic rays hit.")] = False,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="The counts show a uniform source; write CALIBRATED.toml.")
    ] = False,
    radiance: Annotated[float | None, typer.Option(help="Of that source [W/mm2/sr].")] = None,
    radiance_error: Annotated[float, typer.Option(help="Relative uncertainty of it.")] = 0.0,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reduce counts to power in W with its error; saturated pixels are masked.

    With --calibrate and --radiance the counts show a uniform source, such as an
    integrating sphere, through the lens of the table [lens]: the output is the
    camera's TOML with the quantum efficiency that it shows. The transmittance of
    [lens] is not part of it; without one there, that of the lens is.
    """
    from ..detector.counts import read_counts
    from ..detector.detector import Detector
    from ..detector.reduction import reduce_counts

    camera = Detector.from_toml(detector)
    given = dict(exposure_time=exposure_time, wavelength_nm=wavelength_nm, binning=binning, pixel_pitch=pixel_pitch)
    frames = {"bias": bias, "dark": dark, "flat": flat, "cosmic_rays": cosmic_rays}
    _require_output(output, calibrate, radiance is not None or radiance_error != 0)
    require_apart(output, [*counts, detector, *(p for p in (bias, dark, flat) if p)], error=ImageError)
    images: list[Image] = []
    with progress_bar(quiet) as report:
        for number, path in enumerate(counts):
            report(f"reducing {path.name}", number / len(counts))
            found = read_counts(path)
            exposed = _exposed(path, found, camera, given)
            images.append(reduce_counts(camera, found, exposed, **frames))  # type: ignore[arg-type]
    if calibrate:
        record = _calibrated(camera, images, detector, output, radiance, radiance_error)
        print_result(_calibrated_text(record), record, as_json=as_json, quiet=quiet)
        return
    names = [output] if len(images) == 1 else [output.with_stem(f"{output.stem}_{k}") for k in range(len(images))]
    for image, name in zip(images, names, strict=True):
        image.write(name)
    records = [_record(image, name) for image, name in zip(images, names, strict=True)]
    lines = [f"{r['output']}: {r['power']:.6g} W in total, {r['masked_pixels']} pixels masked" for r in records]
    print_result("\n".join(lines), {"images": records}, as_json=as_json, quiet=quiet)


def _require_output(output: Path, calibrate: bool, source: bool) -> None:
    """Refuse an output that cannot be written, and numbers of a `source` that nothing is calibrated by."""
    if calibrate:
        require_writable(output, ".toml", DetectorError)
    elif source:
        raise DetectorError("--radiance and --radiance-error have no meaning without --calibrate. Give that, too.")
    else:
        require_image(output)


def _exposed(path: Path, counts: Counts, camera: Detector, given: dict[str, Any]) -> Exposed:
    """Circumstances of an exposure: the `given` ones, else those of the file; DetectorError without its time."""
    from ..detector.reduction import Exposed

    if given["exposure_time"] is None and counts.exposure_time is None:
        raise DetectorError(f"'{path}' does not say its exposure time. Give --exposure-time, in s.")
    found = given | {n: getattr(counts, n) for n in ("exposure_time", "binning") if given[n] is None}
    if found["pixel_pitch"] is None and camera.pixel_pitch is not None:
        found["pixel_pitch"] = camera.pixel_pitch * (found["binning"] or 1)
    return Exposed(**found)


def _record(image: Image, name: Path) -> dict[str, Any]:
    """Numbers about a reduced image, ready for JSON."""
    kept = ("electrons_per_watt", "read_noise", "gain_error", "masked_pixels")
    error = float(np.sqrt((image.error.astype(np.float64) ** 2).sum())) if image.error is not None else 0.0
    return {"output": str(name), "power": float(image.power.sum()), "error": error} | {
        k: image.metadata[k] for k in kept
    }


def _calibrated(
    camera: Detector, images: list[Image], toml: Path, output: Path, radiance: float | None, error: float
) -> dict[str, Any]:
    """Write the calibrated camera, and say what changed."""
    from ..detector.reduction import Exposed, calibrated
    from ..optics.uniform_source import uniform_power

    if radiance is None or not 0 < radiance < np.inf:
        raise DetectorError(f"--calibrate needs --radiance > 0 [W/mm2/sr] of the uniform source, got {radiance}.")
    if not 0 <= error < 1:
        raise DetectorError(f"--radiance-error must be in [0, 1), got {error:g}. Give for example 0.02.")
    if len(images) != 1 or "pixel_pitch" not in images[0].metadata:
        raise DetectorError(
            f"--calibrate takes one file of counts and needs 'pixel_pitch', got {len(images)}. Give a stack of frames."
        )
    image = images[0]
    lens, transmittance = _lens(toml, float(image.metadata["wavelength_nm"]))
    power = uniform_power(lens, radiance, float(image.metadata["pixel_pitch"]), image.shape, transmittance)
    found = calibrated(camera, image, power, error)
    found.to_toml(output)
    frame = Exposed(float(image.metadata["exposure_time"]), float(image.metadata["wavelength_nm"]))
    return {
        "output": str(output),
        "quantum_efficiency": found.quantum_efficiency,
        "gain_error": found.gain_error,
        "watts_per_dn": found.gain / frame.per_watt(found.quantum_efficiency),
        "masked_pixels": image.metadata["masked_pixels"],
    }


def _calibrated_text(record: dict[str, Any]) -> str:
    return (
        f"{record['output']}: quantum efficiency {record['quantum_efficiency']:.5g}, gain error "
        f"{record['gain_error']:.3g}, {record['watts_per_dn']:.5g} W per DN at this exposure time"
    )


def _lens(toml: Path, wavelength_nm: float) -> tuple[Lens, float]:
    """Lens of the table [lens] with its borders, and its transmittance at a wavelength."""
    from ..optics.thin_lens import Lens, number_names
    from ..optics.transmittance import Curve, transmittance_of
    from ..phantom.framed_scene import CURVE, camera_lens

    table = camera_lens(toml)
    if missing := [name for name in ("focal_length", "f_number") if name not in table]:
        raise DetectorError(f"'{toml}' [lens]: '{missing[0]}' is missing, which --calibrate needs. Give it.")
    lens = Lens.focused(**{name: table[name] for name in (*number_names(), "model") if name in table})
    given = {name: table[name] for name in ("transmittance",) if name in table}
    if CURVE not in table:
        return lens, transmittance_of(given, None)
    return lens, transmittance_of(given | {"wavelength_nm": wavelength_nm}, Curve.read(table[CURVE]))
