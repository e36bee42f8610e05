"""CCD behind the lens, in the terms of EMVA 1288: from power on a pixel to electrons and counts.

    photons    μ_p = P t λ / (h c)
    electrons  μ_e = η μ_p + I_dark t,  summed over the pixels of a bin,  σ_e² = μ_e + σ_read²
    counts     y   = bias + round(electrons / gain)

The charge of a bin is Poisson distributed with mean μ_e (shot noise); its read-out adds normal noise, σ_read.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.exposure import Exposure
from ..images.formats import Metadata
from ..images.image import Image
from ..images.pixel_axes import CROP
from ..images.radiometry import PLANCK_TIMES_LIGHT, wavelength_of
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import DetectorError
from ..runtime.numbers import number, whole
from ..runtime.toml_file import read_toml
from ..runtime.wavelength import wavelength

if TYPE_CHECKING:
    from .counts import Frame
    from .flat_field import Scene

# Parameters of a detector, each with an example for messages, and their keys in an exposure's metadata, where
# `pixel_pitch` is that of the pixels read out.
EXAMPLES = {
    "quantum_efficiency": "0.85",
    "dark_current": "1e-3",
    "read_noise": "3.5",
    "full_well": "1e5",
    "gain": "1.6",
    "bias": "500",
    "bits": "16",
    "pixel_pitch": "0.0135",
}
TABLES = ("detector", "lens")  # of a camera's TOML file; this file reads the first one only
COMMENTS = {
    "quantum_efficiency": "electrons per photon, η of EMVA 1288",
    "dark_current": "e-/px/s",
    "read_noise": "e-, temporal dark noise of EMVA 1288",
    "full_well": "e-, saturation capacity of EMVA 1288",
    "gain": "e-/DN, 1/K of EMVA 1288",
    "bias": "DN",
    "bits": "of the converter",
    "pixel_pitch": "mm, of the pixel of the dark current",
    "gain_error": "relative standard uncertainty common to all pixels",
}
# Names of EMVA 1288 that a TOML may use instead; the overall system gain K is in DN/e-.
EMVA_1288 = {
    "temporal_dark_noise": "read_noise",
    "saturation_capacity": "full_well",
    "overall_system_gain": "gain",
}
RECORDED = {name: name for name in EXAMPLES} | {"pixel_pitch": "detector_pixel_pitch"}


@dataclass(frozen=True, eq=False)
class Expectation:
    """Mean [e-] and variance [e-²] of the electrons of each pixel read out, shape (h, w), ignoring the full well."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


@dataclass(frozen=True)
class Detector:
    """CCD described by the parameters of EMVA 1288, which are the same for all its pixels.

    Parameters
    ----------
    quantum_efficiency : η, electrons per photon, in (0, 1]
    dark_current : [e-/px/s], >= 0
    read_noise : σ_read [e-] of one read-out, >= 0
    full_well : [e-], in (0, 1e15]; the most electrons that a read-out pixel, binned or not, delivers
    gain : [e-/DN], > 0; 1/K in EMVA 1288
    bias : [DN], >= 0
    bits : of the converter, 1 … 16; the largest count is 2^bits − 1
    pixel_pitch : [mm], > 0, of the pixel to which `dark_current` refers; for an image with another `pixel_pitch` in
        its metadata the dark current is scaled by area. None: it refers to the image's pixels, whatever their pitch
    name : label in the files
    gain_error : relative standard uncertainty, in [0, 1), of a factor common to all pixels, such as that of a
        calibration

    Raises
    ------
    DetectorError : a parameter is no number or outside its range.
    """

    quantum_efficiency: float
    dark_current: float
    read_noise: float
    full_well: float
    gain: float
    bias: float
    bits: int
    pixel_pitch: float | None = None
    name: str = "detector"
    gain_error: float = 0.0

    @classmethod
    def typical_ccd(cls) -> Detector:
        """Cooled back-illuminated 2048² CCD with 13.5 µm pixels; typical values, not those of a data sheet."""
        return cls(
            quantum_efficiency=0.85,
            dark_current=1e-3,
            read_noise=3.5,
            full_well=1e5,
            gain=1.6,
            bias=500,
            bits=16,
            pixel_pitch=0.0135,
            name="typical, not a data sheet",
        )

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Detector:
        """Detector of a camera's TOML file: its table [detector], whose keys are the parameters of the class.

        Only `pixel_pitch` and `name` may be left out. A table [lens] in the same file is not read.

            [detector]
            name = "iKon-M 934, serial 1234"
            quantum_efficiency = 0.9   # electrons per photon
            dark_current = 1e-3        # e-/px/s
            read_noise = 3.5           # e-
            full_well = 1e5            # e-
            gain = 1.6                 # e-/DN
            bias = 500                 # DN
            bits = 16
            pixel_pitch = 0.013        # mm, of the pixel of the dark current

        Raises
        ------
        DetectorError : the file cannot be read, has no table [detector], a key is unknown or missing, or a value is of
            the wrong type or outside its range.
        """
        content = read_toml(path, DetectorError)
        table = content.get("detector")
        if not isinstance(table, dict):
            raise DetectorError(f"'{path}': the table [detector] is missing. Give it, with {', '.join(EXAMPLES)}.")
        if unknown := [key for key in content if key not in TABLES]:
            raise DetectorError(
                f"'{path}': '{unknown[0]}' means nothing here. Put it into [detector], or leave it out."
            )
        known = {field.name: field.default for field in fields(cls)}
        table = _own_names(table, path)
        if unknown := [key for key in table if key not in known]:
            raise DetectorError(f"'{path}' [detector]: '{unknown[0]}' means nothing here. Give {', '.join(known)}.")
        if missing := [key for key, default in known.items() if default is MISSING and key not in table]:
            key = missing[0]
            raise DetectorError(f"'{path}' [detector]: '{key}' is missing. Give for example {key} = {EXAMPLES[key]}.")
        if not isinstance(table.get("name", ""), str):
            raise DetectorError(
                f"'{path}' [detector]: 'name' must be a text in quotes, got {table['name']}. Give for example \"CCD\"."
            )
        try:
            return cls(**table)
        except DetectorError as cause:
            raise DetectorError(f"'{path}' [detector]: {str(cause).removeprefix('detector: ')}") from cause

    def __post_init__(self) -> None:
        for name, example in EXAMPLES.items():
            value = getattr(self, name)
            if name != "pixel_pitch" or value is not None:
                object.__setattr__(self, name, number(f"detector: '{name}'", value, DetectorError, example))
        eta, full_well, bits = self.quantum_efficiency, self.full_well, self.bits
        _require("quantum_efficiency", eta, 0 < eta <= 1, "in (0, 1], for example 0.85")
        _require("full_well", full_well, 0 < full_well <= 1e15, "in (0, 1e15] e-, for example 1e5")
        _require("gain", self.gain, self.gain > 0, "> 0 e-/DN, for example 1.6")
        _require("dark_current", self.dark_current, self.dark_current >= 0, ">= 0 e-/px/s, for example 1e-3")
        _require("read_noise", self.read_noise, self.read_noise >= 0, ">= 0 e-, for example 3.5")
        _require("bias", self.bias, self.bias >= 0, ">= 0 DN, for example 500")
        _require("bits", bits, bits in range(1, 17), "a whole number in 1 … 16, for example 16")
        object.__setattr__(self, "bits", int(bits))
        error = number("detector: 'gain_error'", self.gain_error, DetectorError, "0.05")
        object.__setattr__(self, "gain_error", error)
        _require("gain_error", error, 0 <= error < 1, "in [0, 1), for example 0.05")
        if self.pixel_pitch is not None:
            _require("pixel_pitch", self.pixel_pitch, self.pixel_pitch > 0, "> 0 mm, for example 0.0135")

    def to_toml(self, path: str | os.PathLike[str]) -> None:
        """Write a camera's TOML file with the table [detector], which `from_toml` reads.

        Raises DetectorError if the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".toml":
            raise DetectorError(f"output file '{path}' must end in .toml. Give a name such as camera.toml.")
        lines = ["[detector]", f"name = {json.dumps(self.name)}"]
        for name, comment in COMMENTS.items():
            if (value := getattr(self, name)) is not None:
                lines.append(f"{name} = {value!r}  # {comment}")
        with atomic_path(path, DetectorError) as temporary:
            temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")

    def reduce(
        self,
        counts: Frame,
        *,
        exposure_time: float,
        wavelength_nm: float,
        binning: int | None = None,
        pixel_pitch: float | None = None,
        frames: int | None = None,
        bias: Frame | None = None,
        dark: Frame | None = None,
        flat: Frame | None = None,
        flat_kind: str | None = None,
        flat_dark: Frame | float | None = None,
        scene: Scene | None = None,
        bad_pixels: Frame | None = None,
        cosmic_rays: bool = False,
        metadata: Metadata | None = None,
    ) -> Image:
        """Image in W from raw counts, with its standard error and a mask of saturated pixels; see docs/images.md.

        Parameters
        ----------
        counts : (h, w) or (frames, h, w) [DN], or the name of a .tif, .fits, .npy file or of a click folder
        exposure_time : [s] of one frame, > 0
        wavelength_nm : of the light in vacuum [nm], 200 … 2500
        binning : side of the square of pixels that was read out as one; None: that of the file, else 1
        pixel_pitch : of the pixels read out [mm]; with it, `invert` can check that the image fits the scene;
            None: that of the file, if the detector has none of its own
        frames : number of frames that counts (h, w) are the mean of; None: 1; of a stack, its length
        bias, dark : frames or stacks [DN] in place of `bias` and `dark_current`; `dark` contains the bias
        flat, flat_kind : frame or stack [DN] of a uniform light, 'lens' through the lens of `scene`, or 'sensor'
            without a lens (Eq. M.36); the noise of a stack, not that of a single frame, enters the errors
        flat_dark : number, frame or stack [DN] to subtract from the flat; None: the bias, from unsigned integers alone
        scene : for 'lens': what `render` takes, with the camera's lens, film and crop window
        bad_pixels : (h, w) or its file, not 0 for pixels to mask
        cosmic_rays : also mask pixels that cosmic rays have hit
        metadata : further entries, such as those of the rendered image that was exposed, without how it was computed

        The metadata hold `electrons_per_watt`, `read_noise` [e-], `dark_electrons` (variance of dark current, rounding
        and subtracted frames [e-²]) and `gain_error`; a pixel where `flat` is f has f times `electrons_per_watt`.

        Raises
        ------
        DetectorError : a parameter outside its range, frames that do not fit, a flat without its kind.
        ImageError : a file cannot be read, or a stack has the shape (h, w, frames).
        SceneError, OpticsError, BackendError : the scene has no usable lens; a package is not installed.
        """
        from .reduction import Corrections, Exposed, reduce_counts

        exposed = Exposed(exposure_time, wavelength_nm, binning, pixel_pitch)
        corrections = Corrections(bias, dark, flat, flat_kind, flat_dark, scene, bad_pixels, cosmic_rays)
        return reduce_counts(self, counts, exposed, corrections, frames=frames, metadata=metadata)

    def expected(self, image: Image, exposure_time: float, wavelength_nm: float, *, binning: int = 1) -> Expectation:
        """Mean and variance of the electrons that `expose` draws, before the full well limits them.

        Parameters and errors as for `expose`.
        """
        exposure_time, wavelength_nm = _time_and_wavelength(exposure_time, wavelength_nm)
        if not isinstance(image, Image):
            raise DetectorError(
                f"detector: must be given an image, got {type(image).__name__}. Give fspt.Image(power)."
            )
        wavelength_of(image, wavelength_nm)
        if (darkest := image.power.min()) < 0:
            raise DetectorError(f"detector: power must be >= 0 on every pixel, got {darkest:g} W. Render it again.")
        energy = PLANCK_TIMES_LIGHT / (wavelength_nm * 1e-9)  # of one photon [J]
        photons = image.power.astype(np.float64) * (exposure_time / energy)
        pitch = image.metadata.get("pixel_pitch")
        area = 1.0 if self.pixel_pitch is None or pitch is None else (float(pitch) / self.pixel_pitch) ** 2
        charge = self.quantum_efficiency * photons + self.dark_current * exposure_time * area
        mean = _binned(charge, _whole("binning", binning))
        return Expectation(mean, mean + self.read_noise**2)

    def expose(
        self, image: Image, exposure_time: float, wavelength_nm: float, *, binning: int = 1, seed: int = 0
    ) -> Exposure:
        """One exposure of the detector to an image; the same seed gives bit-identical results.

        Parameters
        ----------
        image : power [W], shape (h, w), monochromatic
        exposure_time : [s], 0 … 1e12 (0 gives a bias frame)
        wavelength_nm : of the light in vacuum [nm], 200 … 2500
        binning : side of the square of pixels whose charge is summed before read-out, a divisor of h and w
        seed : of the shot and read noise, 0 … 2⁵³

        Raises
        ------
        DetectorError : a parameter is outside its range, or the binning does not divide the image.
        ImageError : the image was rendered for another wavelength.
        """
        exposure_time, wavelength_nm = _time_and_wavelength(exposure_time, wavelength_nm)
        seed, binning = _whole("seed", seed), _whole("binning", binning)
        _require(
            "seed", seed, 0 <= seed <= 1 << 53, ">= 0 and at most 2^53, for example 1"
        )  # an EXR stores integers as doubles, which hold no larger one exactly
        rng = np.random.default_rng(seed)
        mean = self.expected(image, exposure_time, wavelength_nm, binning=binning).mean
        # A mean this far above the full well saturates with certainty. NumPy cannot draw Poisson numbers above 9e18.
        charge = rng.poisson(np.minimum(mean, 2 * self.full_well + 1e6))
        electrons = np.minimum(charge + rng.normal(0.0, self.read_noise, mean.shape), self.full_well)
        full = electrons >= self.full_well
        electrons = electrons.astype(np.float32)  # the counts follow from the values that the EXR holds
        top = 2**self.bits - 1
        counts = np.clip(np.rint(self.bias + electrons / np.float64(self.gain)), 0, top)
        metadata = image.metadata | {
            "quantity": "electrons",
            "unit": "e-",
            "detector": self.name,
            "exposure_time": exposure_time,
            "wavelength_nm": wavelength_nm,
            "binning": binning,
            "detector_seed": seed,
            "saturated_pixels": int(np.sum(full | (counts >= top))),
        }
        metadata |= {key: getattr(self, name) for name, key in RECORDED.items() if getattr(self, name) is not None}
        if self.gain_error:
            metadata["gain_error"] = self.gain_error
        if "pixel_pitch" in image.metadata:
            metadata["pixel_pitch"] = image.metadata["pixel_pitch"] * binning
        if binning > 1:  # of a crop window, in pixels of the read-out
            metadata |= {key: float(image.metadata[key]) / binning for key in CROP if key in image.metadata}
        return Exposure(electrons, counts.astype(np.uint16), metadata)


def _own_names(table: dict[str, Any], path: str | os.PathLike[str]) -> dict[str, Any]:
    """Table [detector] with EMVA 1288's names replaced by this package's; DetectorError for a number given twice."""
    found = dict(table)
    for theirs, ours in EMVA_1288.items():
        if theirs not in found:
            continue
        if ours in found:
            raise DetectorError(f"'{path}' [detector]: '{theirs}' and '{ours}' are the same. Give one of them.")
        value = found.pop(theirs)
        if theirs == "overall_system_gain":
            value = number(f"'{path}' [detector]: '{theirs}'", value, DetectorError, "0.625")
            value = 1 / value if value else math.inf
        found[ours] = value
    return found


def _binned(charge: NDArray[np.float64], binning: int) -> NDArray[np.float64]:
    """Sums over squares of `binning` × `binning` pixels, shape (h/binning, w/binning)."""
    height, width = charge.shape
    if binning < 1 or height % binning or width % binning:
        raise DetectorError(
            f"detector: 'binning' = {binning} does not divide the image of {width} × {height} pixels. "
            f"Give a divisor of {math.gcd(height, width)}."
        )
    blocks = charge.reshape(height // binning, binning, width // binning, binning)
    return blocks.sum(axis=(1, 3))


def _time_and_wavelength(exposure_time: float, wavelength_nm: float) -> tuple[float, float]:
    """Both as floats, or DetectorError. The bound keeps photons per watt finite: 0 W times infinity would be NaN."""
    time = number("detector: 'exposure_time'", exposure_time, DetectorError, "60")
    _require("exposure_time", time, 0 <= time <= 1e12, "in 0 … 1e12 s, for example 60")
    return time, wavelength("detector: 'wavelength_nm'", wavelength_nm, DetectorError)


def _whole(name: str, value: int) -> int:
    return whole(f"detector: '{name}'", value, DetectorError, "1")


def _require(name: str, value: float, holds: bool, rule: str) -> None:
    """Raise DetectorError unless `value` is finite and the `rule` holds."""
    if not (holds and math.isfinite(value)):
        raise DetectorError(f"detector: '{name}' must be finite and {rule}, got {value}.")
