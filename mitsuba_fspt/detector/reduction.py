"""Counts of a detector to power [W]: bias, dark, flat, cosmic rays, quantum efficiency, and the noise that remains.

    electrons n = gain (DN − bias)/g − dark,   P = n / (flat · k),   k = t ⟨η λ⟩/(h c) [electrons per watt]
    error² = (F² (max(n, 0) + dark) + (σ_read/g)²) / (flat · k)² + (P ε)²

with g and F² of a multiplying register, both 1 without one, and the relative error ε of the response. All electrons of
an image, `dark_electrons` and `read_noise` too, are those before the register. Frames are corrected by ccdproc. A pixel
of a flat field below 1 collects fewer electrons per watt, flat · k. The image stores the flat field and its noise.
"""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.exposure import Exposure
from ..images.formats import Metadata, read_planes
from ..images.frame_file import FITS, TIFF
from ..images.image import Image, image_or_exposure
from ..images.noise_model import FLAT, FRAME, PART, NoiseModel, flat_digest
from ..images.pixel_map import DIGEST, MAP, recorded_map
from ..images.recorded_number import recorded_number, recorded_positive
from ..optics.light import Light
from ..rendering.lens_numbers import lens_numbers
from ..runtime.errors import BackendError, DetectorError, ImageError, named
from ..runtime.numbers import number, require_unmasked, whole
from .counts import (
    CLICK,
    Counts,
    Frame,
    frame_like,
    frame_of,
    require_same_rows,
    tell_stated,
    tell_unequal_frames,
)
from .dark_charge import background_of
from .flat_field import PRNU, FlatField, flat_field, require_no_flat, require_rows_of_maps, tell_loss
from .parameters import MAPPED, RECORDED, DetectorParameters, Own
from .read_out import pixels_read_out
from .saturation import full_pixels, saturated

if TYPE_CHECKING:
    from ..optics.light import Spectrum
    from .flat_field import Scene

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
DARKER = 5.0  # standard deviations of a total below 0: noise makes more once in 3 million images
REPLACED = (
    *("quantity", "unit", "bias", "gain", "bits", "full_well", "dark_current", "saturated_pixels"),
    *(
        *FRAME,
        FLAT,
        PART,
        "flat_kind",
        "flat_masked_pixels",
        "em_gain",
        "excess_noise",
        "spurious_charge",
        "prnu",
    ),
    *(name + end for name in MAPPED for end in (MAP, DIGEST)),
)
OPTIONAL = ("pixel_pitch", "em_gain", "excess_noise", "spurious_charge", "prnu")  # entries that an exposure may lack
# Metadata of a rendered image that say how it was computed. They do not hold for counts of it, whose error is noise.
COMPUTED = (
    *("method", "rtol", "domain", "pixel", "max_nodes", "max_specular", "shortcuts_off", "nodes", "levels", "left_out"),
    *("light_left_out", "light_left_out_error", "warnings", "wall_time", "variant", "versions"),
    *("sampler", "spp", "passes", "seed", "max_depth", "max_time", "stopped_after"),
)


@dataclass(frozen=True)
class Exposed:
    """Conditions of an exposure: time [s], light, binning, pitch of the pixels read out [mm] or None.

    A `binning` of None stands for that of the file of counts, or for 1 if the file does not state it.
    """

    exposure_time: float
    light: Light
    binning: int | None = 1
    pixel_pitch: float | None = None

    def __post_init__(self) -> None:
        time = number("reduce: 'exposure_time'", self.exposure_time, DetectorError, "60")
        if not 0 < time <= 1e12:
            raise DetectorError(f"reduce: 'exposure_time' must be > 0 and at most 1e12 s, got {time:g}. Give 60.")
        object.__setattr__(self, "exposure_time", time)
        if self.binning is not None:
            sides = whole("reduce: 'binning'", self.binning, DetectorError, "1")
            object.__setattr__(self, "binning", sides)
            if sides < 1:
                raise DetectorError(f"reduce: 'binning' must be >= 1, got {sides}. Give for example 1.")
        if self.pixel_pitch is not None:
            pitch = number("reduce: 'pixel_pitch'", self.pixel_pitch, DetectorError, "0.108")
            object.__setattr__(self, "pixel_pitch", pitch)
            if not 0 < pitch < np.inf:
                raise DetectorError(f"reduce: 'pixel_pitch' must be > 0 mm, got {pitch:g}. Give for example 0.108.")

    def per_watt(self, detector: DetectorParameters) -> float:
        """k, electrons per watt on a pixel (Eq. M.43)."""
        return detector.electrons_per_joule(self.light) * self.exposure_time

    def area(self, detector: DetectorParameters) -> float:
        """Number of the detector's own pixels in one that is read out."""
        return detector.area(self.pixel_pitch, self.binning)

    def dark(self, detector: DetectorParameters, shape: tuple[int, ...]) -> Array | float:
        """Electrons of the dark current in a pixel read out, a number or (h, w)."""
        return detector.on_pixels("dark_current", shape) * self.exposure_time * self.area(detector)

    def spurious(self, detector: DetectorParameters) -> float:
        """Electrons of the spurious charge in a pixel read out."""
        return detector.spurious_charge * self.area(detector)


@dataclass(frozen=True, eq=False)
class Corrections:
    """What corrects counts, see `Detector.reduce`: frames, the flat field with its kind, and pixels to leave out."""

    bias: Frame | None = None
    dark: Frame | float | None = None
    flat: Frame | FlatField | None = None
    flat_kind: str | None = None
    flat_dark: Frame | float | None = None
    scene: Scene | None = None
    bad_pixels: Frame | None = None
    cosmic_rays: bool = False

    def flat_field(self, detector: DetectorParameters, counts: Counts, exposed: Exposed) -> FlatField | None:
        """Flat field of the counts, that of the detector's map, or None; DetectorError for settings of a missing one.

        A flat field of the counts contains the response that the map has, which is then not used.
        """
        shape = counts.values.shape
        if self.flat is None:
            require_no_flat(flat_kind=self.flat_kind, flat_dark=self.flat_dark, scene=self.scene)
            return FlatField.of_map(detector, shape)
        if isinstance(self.flat, FlatField):
            if self.flat.response.shape != shape:
                raise DetectorError(
                    f"reduce: 'flat' has the shape {self.flat.response.shape}, the counts {shape}. Give a frame of the "
                    "same film."
                )
            require_same_rows("flat", self.flat.top_row, "counts", counts.top_row)
            return self.flat
        flat = frame_of(self.flat, "flat")
        require_same_rows("flat", flat.top_row, "counts", counts.top_row)
        bias = counts.bias
        if self.bias is not None:
            empty = frame_like(self.bias, "bias", shape)
            require_same_rows("bias", empty.top_row, "flat", flat.top_row)
            bias = empty.values
        found = flat_field(
            detector,
            flat,
            self.flat_kind,
            self.scene,
            shape,
            flat_dark=self.flat_dark,
            bias=bias,
            pixel_pitch=exposed.pixel_pitch,
            area=replace(exposed, binning=exposed.binning or counts.binning or 1).area(detector),
            binning=exposed.binning or counts.binning,
        )
        tell_loss(found, detector.gain_error)
        return found

    def bad(self, counts: Counts) -> NDArray[np.bool_]:
        """True (h, w) on the pixels to leave out; DetectorError for a mask of another size or order of rows."""
        shape = counts.values.shape
        if self.bad_pixels is None:
            return np.zeros(shape, bool)
        given = self.bad_pixels
        if not isinstance(given, (str, os.PathLike)):
            require_unmasked("bad_pixels", given, ImageError, "Give its data, not 0 for pixels to mask.")
            given = np.asarray(given)
            given = given.astype(np.uint8) if given.dtype == bool else given
        found = frame_like(given, "bad_pixels", shape)
        require_same_rows("bad_pixels", found.top_row, "counts", counts.top_row)
        return found.values != 0


def light_of(
    metadata: Mapping[str, Any], scene: Scene | None, wavelength_nm: float | None, spectrum: Spectrum | None
) -> Light:
    """The light at the detector: that of the image's metadata or of the scene's lens, or else the given one.

    Raises
    ------
    DetectorError : there is none, or another one is given than the image or the lens has.
    """
    known: Mapping[str, Any] = metadata
    if scene is not None and Light.recorded(metadata, DetectorError, "reduce") is None:
        known = lens_numbers(scene)[0]
    given = Light.given(wavelength_nm, spectrum, DetectorError, "reduce")
    return Light.of_image(known, given, DetectorError, "reduce")


def reduce_counts(
    detector: DetectorParameters,
    counts: Frame | Counts,
    exposed: Exposed,
    corrections: Corrections,
    *,
    frames: int | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Image:
    """Image in W of raw counts; see `Detector.reduce`."""
    raw = frame_of(counts, "counts", frames)
    binning = raw.binning if exposed.binning is None else exposed.binning
    pitch = exposed.pixel_pitch
    if pitch is None and detector.pixel_pitch is None:
        pitch = raw.pixel_pitch
    binning, pitch, metadata = pixels_read_out(metadata or {}, binning, pitch, detector.pixel_pitch)
    stated = detector.mean("gain") if detector.em_gain == 1 else None  # programs count the register's in or not
    tell_stated(raw, exposed.exposure_time, stated, binning, pitch, detector.pixel_pitch)
    exposed = replace(exposed, binning=binning or 1, pixel_pitch=pitch)
    require_rows_of_maps(detector, "counts", raw, unused=() if corrections.flat is None else PRNU)
    shape = raw.values.shape
    full = full_pixels(detector, raw, "counts")
    rays = _cosmic_rays(detector, raw.values, full) if corrections.cosmic_rays else np.zeros(shape, bool)
    charges = exposed.dark(detector, shape), exposed.spurious(detector)
    dark = background_of(detector, raw, *charges, exposed.exposure_time, corrections.bias, corrections.dark)
    flat = corrections.flat_field(detector, raw, exposed)
    gain = detector.on_pixels("gain", shape) / detector.em_gain
    electrons = _corrected(raw.values, dark.level, flat) * gain
    independent = detector.excess * dark.charge + gain**2 / 12  # gain²/12: variance of the rounding
    read = (detector.on_pixels("read_noise", shape) / detector.em_gain) ** 2
    shared = dark.shared(independent + read, raw.frames, metadata)
    independent = independent + raw.frames * dark.added
    mask = full | rays | corrections.bad(raw)
    image = _image(detector, electrons, flat, independent, raw.frames, mask, exposed, metadata)
    image = replace(image, metadata=image.metadata | shared)
    light = detector.excess * np.maximum(electrons.mean(), 0)
    noise = np.sqrt(np.mean(independent) + np.mean(read) + light) / np.mean(gain)
    tell_unequal_frames(raw, float(np.mean(dark.level)), float(noise))
    _report_darkness(image)
    return image


def _report_darkness(image: Image) -> None:
    """Say in one line on stderr that all pixels are masked, or that their power is negative by more than noise."""
    power, error = (np.asarray(plane, np.float64) for plane in (image.power, image.error))
    total, noise = power.sum(), np.sqrt(np.square(error[image.kept]).sum())
    if image.masked == power.size:
        LOG.warning(
            "fspt: reduce: all pixels are masked, as saturated or bad: the image says nothing of the light. Expose "
            "for a shorter time, or correct the maps of pixels."
        )
    if total < -DARKER * noise:
        LOG.warning(
            "fspt: reduce: the total is %.3g W, %.0f standard deviations below 0: the counts are darker than bias and "
            "dark current say. Check 'bias', 'dark_current' and the frames.",
            total,
            -total / noise,
        )


def reduced(exposure: Exposure) -> Image:
    """Image in W of an exposure, by the parameters of its detector in its metadata.

    Raises
    ------
    DetectorError : the metadata lack a number, or a map is missing or has changed since.
    """
    found = exposure.metadata
    needed = [key for name, key in RECORDED.items() if name not in OPTIONAL]
    light = Light.recorded(found, DetectorError, "reduce")
    missing = [key for key in (*needed, "exposure_time") if key not in found]
    if missing := [*missing, *([] if light else ["wavelength_nm"])]:
        raise DetectorError(
            f"reduce: the electrons come without '{missing[0]}'. Reduce the counts with the numbers of their detector."
        )
    numbers: dict[str, Any] = {name: found[key] for name, key in RECORDED.items() if key in found}
    for name in MAPPED:
        if (one := recorded_map(found, name)) is not None:
            numbers[name] = one.path
    detector = DetectorParameters(**numbers, name=str(found.get("detector", "detector")))
    recorded = partial(recorded_number, found, thing="reduce: the exposure", error=DetectorError)
    exposed = Exposed(
        found["exposure_time"],  # type: ignore[arg-type]
        light,  # type: ignore[arg-type]  # there is one
        recorded("binning", 1),  # type: ignore[arg-type]  # checked there
        recorded_positive(found, "pixel_pitch", "reduce: the exposure", DetectorError),
    )
    detector = replace(detector, gain_error=recorded("gain_error", 0.0))
    charge = exposed.dark(detector, exposure.shape) + exposed.spurious(detector)
    electrons = exposure.electrons.astype(np.float64)
    full = (electrons >= detector.full_well) | saturated(detector, exposure.counts.astype(np.float64))
    flat = FlatField.of_map(detector, exposure.shape)
    charge_of_light = (electrons / detector.em_gain - charge) / (1.0 if flat is None else flat.response)
    return _image(detector, charge_of_light, flat, detector.excess * charge, 1, full, exposed, found)


def calibrated(detector: Own, image: Image, power: Array, error: float) -> Own:
    """Detector with the quantum efficiency, a number, that follows from the image of a source of known power.

    Parameters
    ----------
    detector : with the numbers by which `image` was reduced from counts
    image : of the source
    power : of the source on each pixel, (h, w) [W]
    error : relative uncertainty of `power`, which becomes the `gain_error`

    Raises
    ------
    DetectorError : no light, another shape, or a quantum efficiency that comes out above 1.
    """
    good = np.ones(image.shape, bool) if image.mask is None else ~image.mask
    if power.shape != image.shape or not good.any() or not power[good].sum() > 0:
        raise DetectorError(
            f"calibrate: the source's power has the shape {power.shape}, the counts {image.shape}, "
            f"{int(good.sum())} pixels are not saturated. Give an unsaturated frame of the same film."
        )
    share = float(image.power[good].sum() / power[good].sum())
    light = Light.of_image(image.metadata, None, DetectorError, "calibrate")
    efficiency = detector.electrons_per_joule(light) / light.photons_per_joule * share
    if not 0 < efficiency <= 1:
        raise DetectorError(
            f"calibrate: the source shows a quantum efficiency of {efficiency:.4g}, which must be in (0, 1]. Check the "
            "radiance, the exposure time and 'gain' [e-/DN]."
        )
    noise = 0.0
    if image.error is not None:
        noise = float(np.sqrt((image.error[good].astype(np.float64) ** 2).sum()) / image.power[good].sum())
    return replace(detector, quantum_efficiency=efficiency, gain_error=float(np.hypot(error, noise)))


def _corrected(values: Array, level: Array | float, flat: FlatField | None) -> Array:
    """(Counts − level)/response; by ccdproc if the level is a frame or there is a flat field."""
    if flat is None and np.ndim(level) == 0:
        return values - level
    ccdproc, data_of = _ccdproc()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame = data_of(values, unit="adu")
        frame = ccdproc.subtract_bias(frame, data_of(np.broadcast_to(level, values.shape).copy(), unit="adu"))
        if flat is not None:
            frame = ccdproc.flat_correct(frame, data_of(flat.response, unit=""), norm_value=1.0)
    return np.asarray(frame.data, np.float64)


def _cosmic_rays(detector: DetectorParameters, values: Array, full: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that cosmic rays hit, by the Laplacian edge detection of ccdproc.

    It takes the variance for the signal; that of x electrons after a register is g F² x, so that x/(g F²) is given.
    """
    ccdproc, data_of = _ccdproc()
    unit = detector.em_gain * detector.excess  # electrons after the register
    light = (values - detector.on_pixels("bias", values.shape)) * detector.on_pixels("gain", values.shape) / unit
    electrons = data_of(light, unit="electron", mask=full)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = ccdproc.cosmicray_lacosmic(
            electrons,
            readnoise=detector.mean("read_noise") / unit,
            gain_apply=False,
            satlevel=detector.full_well / unit,
            sigclip=6.0,
        )
    return np.asarray(found.mask, bool) & ~full


def _ccdproc() -> tuple[Any, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import ccdproc
            from astropy.nddata import CCDData
    except ImportError as cause:
        raise BackendError(
            f"reduce: ccdproc, which corrects frames, is not installed ({cause}). pip install 'mitsuba-fspt[reduce]'."
        ) from cause
    return ccdproc, CCDData


def _image(
    detector: DetectorParameters,
    electrons: Array,
    flat: FlatField | None,
    dark: Array | float,
    frames: int,
    mask: NDArray[np.bool_],
    exposed: Exposed,
    metadata: Mapping[str, Any] | None,
) -> Image:
    """Image in W from `electrons` (h, w) before the register, the mean over `frames` frames, over the flat field.

    `dark` is the variance [e-²] of one frame in addition to that of light and of reading. The numbers in the metadata
    are those of the sum of the frames, whose shot noise is that of all its electrons.
    """
    per_watt = exposed.per_watt(detector) * frames
    read = detector.on_pixels("read_noise", electrons.shape) / detector.em_gain * frames**0.5
    mask = mask if flat is None else mask | flat.mask
    kept: Metadata = dict(metadata or {})
    for name in (*REPLACED, *COMPUTED):
        kept.pop(name, None)
    kept |= {
        "quantity": "power",
        "unit": "W",
        "detector": detector.name,
        "exposure_time": exposed.exposure_time,
        **exposed.light.metadata(),
        "binning": exposed.binning or 1,
        "electrons_per_watt": per_watt,
        "read_noise": float(np.sqrt(np.mean(np.square(read)))),
        "dark_electrons": float(np.mean(dark)) * frames,
        "gain_error": detector.gain_error,
        "masked_pixels": int(mask.sum()),
    }
    kept |= detector.stray_light.recorded(electrons.shape)  # which the image has
    if detector.em_gain > 1:
        kept |= {"em_gain": detector.em_gain, "excess_noise": detector.excess}
    if flat is not None:
        kept |= {"flat_kind": flat.kind, "flat_masked_pixels": int(flat.mask.sum())}
    elif detector.prnu:  # a number, of which the response of each pixel does not follow
        kept["prnu"] = float(detector.prnu) / math.sqrt(max(exposed.area(detector), 1.0))
    if exposed.pixel_pitch is not None:
        kept["pixel_pitch"] = exposed.pixel_pitch
    if detector.pixel_pitch is not None:
        kept[RECORDED["pixel_pitch"]] = detector.pixel_pitch
    planes = {} if flat is None else {"flat": flat.response, "flat_error": flat.error}
    if np.ndim(read) or np.ndim(dark):  # another noise on each pixel
        planes["dark_noise"] = np.sqrt(np.broadcast_to(np.square(read) + dark * frames, electrons.shape))
    image = Image(np.where(mask, 0, electrons) * frames / per_watt, metadata=kept, mask=mask, **planes)
    if (digest := flat_digest(image)) is not None:
        image = replace(image, metadata=image.metadata | {FLAT: digest})
    return _with_error(image)


def _with_error(image: Image) -> Image:
    """The image with the standard error that follows from its power by its noise model."""
    model = NoiseModel.of(image)
    if model is None:
        return image
    return replace(image, error=np.sqrt(model.variance(image.power.astype(np.float64))))


def measured(given: Image | Exposure | str | os.PathLike[str]) -> Image:
    """Image in W of an image, an exposure, or a file of either, as `reduced` and `read_measured` make it."""
    if isinstance(given, (str, os.PathLike)):
        return read_measured(given)
    return reduced(given) if isinstance(given, Exposure) else given


def read_measured(path: str | os.PathLike[str]) -> Image:
    """Image in W from a file of `fspt reduce` or a rendering, or from electrons of `fspt expose`, which are reduced.

    Raises
    ------
    ImageError : the file cannot be read.
    DetectorError : electrons without the numbers of their detector, or counts, which `fspt reduce` takes.
    """
    path = Path(path)
    counts_alone = f"'{path}' holds counts without their detector's numbers. Reduce it with 'fspt reduce'."
    if path.is_dir() and not any(file.stem.lower() == CLICK for file in path.iterdir()):
        raise ImageError(f"image file '{path}' is a folder. Give the path of an image that fspt wrote.")
    if path.suffix.lower() in (".npy", ".png") or path.is_dir():
        raise DetectorError(counts_alone)
    try:
        planes, metadata = read_planes(path)
    except ImageError as cause:
        if path.suffix.lower() in (*TIFF, *FITS):  # of another program
            raise DetectorError(counts_alone) from cause
        raise
    found = image_or_exposure(path, planes, metadata)
    with named(f"'{path}'"):
        return measured(found)
