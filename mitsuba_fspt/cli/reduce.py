"""`fspt reduce`: counts of a camera to power on its pixels, and the calibration by a uniform source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from ..rendering.scene_rules import is_number
from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import DetectorError, ImageError, OpticsError, SceneError
from ..runtime.progress_bar import progress_bar
from .measured_vignetting import Flats, measured, text_of
from .options import (
    AsJson,
    Parameters,
    Quiet,
    SpectrumFile,
    WavelengthNm,
    definitions,
    require_image,
    require_writable,
)
from .terminal import print_result

if TYPE_CHECKING:
    import mitsuba as mi

    from ..detector.counts import Counts
    from ..detector.detector import Detector
    from ..detector.reduction import Exposed
    from ..images.image import Image
    from ..optics.light import Light
    from ..optics.thin_lens import Lens
    from ..optics.vignetting import Vignetting

FILES = ".tif, .fits, .npy"
Bias = Annotated[
    Path | None, typer.Option(metavar="FILE", help=f"Frame or stack [DN], {FILES}, in place of the detector's bias.")
]
Dark = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Dark frame or stack of the counts' exposure time; contains the bias."),
]
Flat = Annotated[Path | None, typer.Option(metavar="FILE", help="Frame or stack of a uniform light, with --flat-kind.")]
FlatKind = Annotated[
    str | None,
    typer.Option(
        metavar="lens|sensor",
        help="lens: a screen through the lens of --scene, whose cos^4 and vignetting are divided out; sensor: no lens.",
    ),
]
FlatDark = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|DN",
        help="Frame of the flat's exposure time, with the bias, or a number, 0 for a flat free of both; without it "
        "the bias is subtracted from a flat of unsigned integers, nothing from another one.",
    ),
]


Time = Annotated[float | None, typer.Option(help="Exposure time of a frame [s]; that of the file if left out.")]
Binning = Annotated[
    int | None, typer.Option(help="Side of the square of pixels read out as one; that of the file, else 1.")
]
Pitch = Annotated[
    float | None, typer.Option(help="Side of a pixel read out [mm]; detector's x binning, else that of the file.")
]
Scene = Annotated[
    Path | None, typer.Option(metavar="S.xml", help="Scene with the camera's lens and film, for --flat-kind lens.")
]
Frames = Annotated[int | None, typer.Option(metavar="N", help="Number of frames that a single one is the mean of.")]
BadPixels = Annotated[Path | None, typer.Option(metavar="FILE", help="Frame that is not 0 on the pixels to mask.")]
VignettingFile = Annotated[
    Path | None, typer.Option(metavar="V.exr", help="Write the vignetting that the flat of the lens of --scene shows.")
]
SensorFlat = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Flat without the lens, for --vignetting; else the pixels' response is in it."),
]
CountsFiles = Annotated[
    list[Path] | None, typer.Argument(metavar="COUNTS...", help=".tif, .fits, .npy, or a click folder.")
]
Output = Annotated[Path | None, typer.Option("-o", "--output", help="Image to write, .exr; of several OUT_0.exr, …")]
Calibrate = Annotated[
    bool, typer.Option("--calibrate", help="The counts show a uniform source; write CALIBRATED.toml.")
]


def reduce(
    counts: CountsFiles = None,
    detector: Annotated[Path | None, typer.Option(metavar="CAMERA.toml", help="Camera with a [detector].")] = None,
    output: Output = None,
    wavelength_nm: WavelengthNm = None,
    spectrum: SpectrumFile = None,
    exposure_time: Time = None,
    binning: Binning = None,
    pixel_pitch: Pitch = None,
    bias: Bias = None,
    dark: Dark = None,
    flat: Flat = None,
    flat_kind: FlatKind = None,
    flat_dark: FlatDark = None,
    scene: Scene = None,
    vignetting: VignettingFile = None,
    sensor_flat: SensorFlat = None,
    define: Parameters = None,
    frames: Frames = None,
    bad_pixels: BadPixels = None,
    cosmic_rays: Annotated[bool, typer.Option("--cosmic-rays", help="Mask pixels that cosmic rays hit.")] = False,
    calibrate: Calibrate = False,
    radiance: Annotated[float | None, typer.Option(help="Of that source [W/mm2/sr].")] = None,
    radiance_error: Annotated[float, typer.Option(help="Relative uncertainty of it.")] = 0.0,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reduce counts to power in W with its error; saturated pixels are masked.

    Bias and dark frames are those of the counts. A flat field has its own:
    see --flat-dark.

    With --calibrate and --radiance the counts show a uniform source, such as an
    integrating sphere, through the lens of the table [lens]: the output is the
    camera's TOML with the quantum efficiency that it shows. The transmittance of
    [lens] is not part of it; without one there, that of the lens is.

    With --vignetting and no COUNTS the flat of kind lens, over --sensor-flat,
    gives the vignetting of the lens of --scene.
    """
    level = float(flat_dark) if flat_dark is not None and is_number(flat_dark) else flat_dark
    if vignetting is not None or sensor_flat is not None:
        flats = Flats(flat, flat_kind, level, sensor_flat, counts, output)
        record = measured(vignetting, flats, detector, scene, lambda: _loaded(scene, define))
        print_result(text_of(record), record, as_json=as_json, quiet=quiet)
        return
    counts, detector, output = _required(counts, detector, output)
    _require_output(output, calibrate, radiance is not None or radiance_error != 0)
    others = (bias, dark, flat, flat_dark, bad_pixels, scene, spectrum)
    names = _outputs(output, len(counts), [*counts, detector, *(Path(path) for path in others if path)])
    camera, light = _camera_and_light(detector, wavelength_nm, spectrum, flat_kind, loaded := _loaded(scene, define))
    given = dict(exposure_time=exposure_time, light=light, binning=binning, pixel_pitch=pixel_pitch)
    frame_files = dict(bias=bias, dark=dark, flat=flat, flat_kind=flat_kind, flat_dark=level, scene=loaded)
    corrections = frame_files | dict(bad_pixels=bad_pixels, cosmic_rays=cosmic_rays)
    images = _reduced(camera, counts, frames, given, corrections, quiet)
    if calibrate:
        record = _calibrated(camera, images, detector, output, radiance, radiance_error)
        print_result(_calibrated_text(record), record, as_json=as_json, quiet=quiet)
        return
    _write(images, names, as_json, quiet)


def _required(counts: list[Path] | None, detector: Path | None, output: Path | None) -> tuple[list[Path], Path, Path]:
    """The files that are needed unless a vignetting is measured; DetectorError for a missing one, ImageError for counts
    that are none, before other options are asked for."""
    from ..detector.counts import require_suffix

    for name, value in (("COUNTS", counts), ("--detector", detector), ("-o", output)):
        if not value:
            raise DetectorError(f"reduce: {name} is missing. Give 'fspt reduce COUNTS --detector CAMERA.toml -o OUT'.")
    for path in counts or ():
        require_suffix(path)
    return counts, detector, output  # type: ignore[return-value]  # all are there


def _camera_and_light(
    detector: Path, wavelength_nm: float | None, spectrum: Path | None, flat_kind: str | None, scene: mi.Scene | None
) -> tuple[Detector, Light]:
    """The detector, and the light at it: the given one, or that of the scene's lens for a flat through it."""
    from ..detector.detector import Detector
    from ..detector.reduction import light_of

    through = scene if flat_kind == "lens" else None
    return Detector.from_toml(detector), light_of({}, through, wavelength_nm, spectrum)


def _write(images: list[Image], names: list[Path], as_json: bool, quiet: bool) -> None:
    """Write all images, and say what is in them."""
    for image, name in zip(images, names, strict=True):
        image.write(name)
    records = [_record(image, name) for image, name in zip(images, names, strict=True)]
    print_result("\n".join(map(_text, records)), {"images": records}, as_json=as_json, quiet=quiet)


def _reduced(
    camera: Detector,
    files: list[Path],
    frames: int | None,
    given: dict[str, Any],
    corrections: dict[str, Any],
    quiet: bool,
) -> list[Image]:
    """Images of all files of counts, with one flat field; `given` as of `_exposed`, `corrections` of `Corrections`."""
    from ..detector.counts import read_counts
    from ..detector.reduction import Corrections, reduce_counts

    applied, images = Corrections(**corrections), []
    with progress_bar(quiet) as report:
        for number, path in enumerate(files):
            report(f"reducing {path.name}", number / len(files))
            found = read_counts(path, frames)
            exposed = _exposed(path, found, camera, given)
            applied = replace(applied, flat=applied.flat_field(camera, found, exposed))
            images.append(reduce_counts(camera, found, exposed, applied))
    return images


def _outputs(output: Path, count: int, inputs: list[Path]) -> list[Path]:
    """Names of the images: `output` of a single one, else OUT_00, OUT_01, …, which sort in their order.

    Raises ImageError where one of them is an input.
    """
    digits = len(str(count - 1))
    names = [output] if count == 1 else [output.with_stem(f"{output.stem}_{k:0{digits}d}") for k in range(count)]
    for name in names:
        require_apart(name, inputs, error=ImageError)
    return names


def _loaded(scene: Path | None, define: list[str] | None) -> mi.Scene | None:
    """The scene with the values of its parameters, if one is given."""
    from ..rendering.scene import load

    if scene is None:
        if define:
            raise SceneError(f"-D {define[0]} goes with --scene, which is missing. Give both, or leave it out.")
        return None
    quiet_mitsuba()
    return load(scene, **definitions(define))


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
    kept = ("electrons_per_watt", "read_noise", "gain_error", "masked_pixels", "flat_masked_pixels")
    power, own = float(image.power.sum()), 0.0 if image.error is None else np.linalg.norm(image.error[image.kept])
    error = float(np.hypot(own, power * (image.gain_error or 0.0)))
    return {"output": str(name), "power": power, "error": error} | {
        k: image.metadata[k] for k in kept if k in image.metadata
    }


def _text(record: dict[str, Any]) -> str:
    """A line about a reduced image."""
    flat = f", {record['flat_masked_pixels']} of them by the flat field" if "flat_masked_pixels" in record else ""
    return f"{record['output']}: {record['power']:.6g} W in total, {record['masked_pixels']} pixels masked{flat}"


def _calibrated(
    camera: Detector, images: list[Image], toml: Path, output: Path, radiance: float | None, error: float
) -> dict[str, Any]:
    """Write the calibrated camera, and say what changed."""
    from ..detector.reduction import Exposed, calibrated
    from ..optics.light import Light
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
    light = Light.of_image(image.metadata, None, DetectorError, "calibrate")
    lens, transmittance, vignetting = _lens(toml, light)
    power = uniform_power(lens, radiance, float(image.metadata["pixel_pitch"]), image.shape, transmittance, vignetting)
    found = calibrated(camera, image, power, error)
    found.to_toml(output)
    frame = Exposed(float(image.metadata["exposure_time"]), light)
    return {
        "output": str(output),
        "quantum_efficiency": found.quantum_efficiency,
        "gain_error": found.gain_error,
        "watts_per_dn": found.mean("gain") / found.em_gain / frame.per_watt(found),
        "masked_pixels": image.metadata["masked_pixels"],
    }


def _calibrated_text(record: dict[str, Any]) -> str:
    return (
        f"{record['output']}: quantum efficiency {record['quantum_efficiency']:.5g}, gain error "
        f"{record['gain_error']:.3g}, {record['watts_per_dn']:.5g} W per DN at this exposure time"
    )


def _lens(toml: Path, light: Light) -> tuple[Lens, float, Vignetting | None]:
    """Lens of the table [lens] with its borders, its transmittance for a light at the detector, and its vignetting."""
    from ..images.vignetting_file import read_vignetting
    from ..optics.thin_lens import Lens, number_names
    from ..optics.vignetting import VIGNETTING
    from ..phantom.framed_scene import camera_lens

    table = camera_lens(toml)
    if missing := [name for name in ("focal_length", "f_number") if name not in table]:
        raise DetectorError(f"'{toml}' [lens]: '{missing[0]}' is missing, which --calibrate needs. Give it.")
    lens = Lens.focused(**{name: table[name] for name in (*number_names(), "model", "distortion") if name in table})
    vignetting = read_vignetting(table[VIGNETTING]) if VIGNETTING in table else None
    return lens, _transmittance(table, toml, light), vignetting


def _transmittance(table: dict[str, Any], toml: Path, light: Light) -> float:
    """Transmittance of the table [lens] for a light at the detector."""
    from ..optics.light import read_spectrum
    from ..optics.transmittance import CURVE, SPECTRUM, Curve, transmittance_of

    given = {name: table[name] for name in ("transmittance",) if name in table}
    curve = Curve.read(table[CURVE]) if CURVE in table else None
    if SPECTRUM in table:
        return transmittance_of(given, curve, read_spectrum(table[SPECTRUM], OpticsError))
    if curve is None:
        return transmittance_of(given, None)
    if light.wavelength_nm is None:
        raise DetectorError(
            f"--calibrate: the mean of 'transmittance_curve' in '{toml}' does not follow from a spectrum at the "
            "detector. Give 'spectrum' there, that before the filters, or 'transmittance', a number."
        )
    return transmittance_of(given | {"wavelength_nm": light.wavelength_nm}, curve)
