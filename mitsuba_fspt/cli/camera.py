"""`fspt camera check`: the numbers that follow from a camera file."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.errors import OpticsError, named
from .options import AsJson, Quiet, SpectrumFile, WavelengthNm, definitions, typed
from .terminal import print_result

if TYPE_CHECKING:
    from ..optics.light import Light
    from ..optics.transmittance import Filters

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
NOMINAL_NM = 600.0  # wavelength of the Airy disc where none is given
FILM = (256, 256)  # of a camera file without width and height, as `fspt render PHANTOM.ply` takes it


@app.callback()
def camera() -> None:
    """Check camera files."""


@app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="CAMERA.toml", help="With tables [lens] and [detector].")],
    define: Annotated[
        list[str] | None,
        typer.Option(
            "-D", "--define", metavar="NAME=VALUE", help="Number of [lens], such as magnification; repeatable."
        ),
    ] = None,
    wavelength_nm: WavelengthNm = None,
    spectrum: SpectrumFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Print what follows from a camera file, or say what contradicts itself.

    Working f-number, T-stop, field of view, scale, depth of field at a blur
    of one pixel, Airy radius, illumination and distortion in the corner, and
    electrons per joule at a wavelength or spectrum, that of the lens if it has
    one, if there is a [detector].
    The focus is in [lens] or given by -D: focus_distance, magnification or
    image_distance.
    """
    from ..optics.light import Light

    table, light = camera_table(file, definitions(define)), None
    if wavelength_nm is not None or spectrum is not None:
        light = Light.given(wavelength_nm, spectrum, OpticsError, "camera check")
    with named(f"'{file}' [lens]"):
        filters = _filters(table, light)
        record = _numbers(table, filters, light or filters.light)
    record["electrons_per_joule"] = _electrons(file, light or filters.light)
    finite = {name: None if value == math.inf else value for name, value in record.items()}
    finite["depth_of_field"] = [None if value == math.inf else value for value in record["depth_of_field"]]
    print_result(_text(record), finite, as_json=as_json, quiet=quiet)


def camera_table(file: Path, given: dict[str, str]) -> dict[str, Any]:
    """The table [lens] of a camera file with values by -D; OpticsError where a name is missing or that of no lens."""
    from ..optics.thin_lens import number_names
    from ..phantom.framed_scene import CURVE, SPECTRUM, VIGNETTING, camera_lens

    table = camera_lens(file) | typed(given)
    if missing := [name for name in ("focal_length", "f_number", "pixel_pitch") if name not in table]:
        raise OpticsError(f"'{file}' [lens]: '{missing[0]}' is missing. Give it, or -D {missing[0]}=VALUE.")
    known = {*number_names(), "model", "distortion", "pixel_pitch", "width", "height"}
    others = {"transmittance", CURVE, SPECTRUM, VIGNETTING, "wavelength_nm"}
    if unknown := [name for name in table if name not in known | others]:
        raise OpticsError(f"'{file}' [lens]: '{unknown[0]}' is no parameter of a lens. Leave it out or correct it.")
    return table


def _filters(table: dict[str, Any], light: Light | None) -> Filters:
    """What the lens lets through, for its own light or the given one behind it."""
    from ..optics.light import read_spectrum
    from ..optics.transmittance import CURVE, SPECTRUM, Curve, Filters

    given: dict[str, float] = {name: float(table[name]) for name in ("transmittance", "wavelength_nm") if name in table}
    spectrum = read_spectrum(table[SPECTRUM], OpticsError) if SPECTRUM in table else None
    curve = Curve.read(table[CURVE]) if CURVE in table else None
    if curve and spectrum is None and light and light.wavelength_nm is not None:
        given.setdefault("wavelength_nm", light.wavelength_nm)
    filters = Filters.of(given, curve, spectrum)
    if light and filters.light and not light.same(filters.light):
        raise OpticsError(f"{light.argument}, but the lens is for {filters.light}. Leave one of them out.")
    return filters


def _numbers(table: dict[str, Any], filters: Filters, light: Light | None) -> dict[str, Any]:
    """The record of `CameraNumbers`, with the film's size and the wavelength of the Airy disc."""
    from ..images.vignetting_file import read_vignetting
    from ..optics.camera_numbers import CameraNumbers
    from ..optics.thin_lens import Lens, number_names
    from ..optics.vignetting import VIGNETTING

    lens = Lens.focused(**{name: table[name] for name in (*number_names(), "model", "distortion") if name in table})
    size = int(table.get("width", FILM[0])), int(table.get("height", FILM[1]))
    mean = light.mean_wavelength_nm if light else NOMINAL_NM
    found = CameraNumbers.of(
        lens,
        float(table["pixel_pitch"]),
        size,
        transmittance=filters.transmittance,
        wavelength_nm=mean,
        vignetting=read_vignetting(table[VIGNETTING]) if VIGNETTING in table else None,
    )
    return asdict(found) | {"width": size[0], "height": size[1], "airy_wavelength_nm": mean}


def _electrons(file: Path, light: Light | None) -> float | None:
    """Electrons per joule on a pixel of the file's detector (Eq. M.43); None without a table [detector] or a light.

    The detector is read in any case: its contradictions are refused.
    """
    from ..detector.detector import Detector
    from ..runtime.toml_file import read_toml

    if "detector" not in read_toml(file, OpticsError):
        return None
    detector = Detector.from_toml(file)
    return None if light is None else detector.electrons_per_joule(light)


def _text(record: dict[str, Any]) -> str:
    """Table of the numbers, a line each."""
    wide, high = record["field_of_view"]
    near, far = record["depth_of_field"]
    u, v, t = (record[name] for name in ("focus_distance", "image_distance", "magnification"))
    rows = [
        ("focus", f"u {u:.5g} mm, v {v:.5g} mm, t {t:.4g}"),
        ("working f-number", f"{record['working_f_number']:.4g}"),
        ("T-stop", f"{record['t_stop']:.4g}"),
        ("field of view", f"{wide:.4g} x {high:.4g} mm ({record['width']} x {record['height']} pixels)"),
        ("scale", f"{record['scale']:.4g} mm per pixel in the plane in focus"),
        ("depth of field", f"{near:.5g} to {far:.5g} mm from the lens plane, at a blur of one pixel"),
        (
            "Airy radius",
            f"{record['airy_radius']:.3g} mm on the film, {record['airy_pixels']:.2g} pixels, at "
            f"{record['airy_wavelength_nm']:.4g} nm",
        ),
        (
            "corner",
            f"illumination {record['corner_illumination']:.3f}, distortion {100 * record['corner_distortion']:+.2f} %",
        ),
    ]
    if record["electrons_per_joule"] is not None:
        rows.append(("electrons", f"{record['electrons_per_joule']:.5g} per joule on a pixel"))
    return "\n".join(f"{name:<18}{text}" for name, text in rows)
