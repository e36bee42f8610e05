"""Flat field: the response of each pixel relative to the mean one, from frames of a uniform light.

    sensor   f = F/⟨F⟩            uniform light on the sensor, without the lens
    lens     f = (F/U)/⟨F/U⟩      uniform screen through the scene's lens; U is its image by the model (Eq. M.6)

F are the flat's counts less its bias and dark current, ⟨⟩ is the mean over the pixels that are kept. U includes cos⁴θ
and the vignetting by the borders of the lens, and the veiling glare of detector and lens (Eq. M.38). The matrix and
every rendered image contain the former, the model of `invert` the latter, so f must not.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter

from ..images.frame_file import FIRST, SAME_PITCH
from ..images.radiometry import etendue_of
from ..rendering.lens_numbers import lens_numbers
from ..runtime.errors import DetectorError
from ..runtime.numbers import number
from .counts import Counts, Frame, frame_like, require_same_rows, require_same_time
from .dark_charge import tell_below_bias
from .parameters import DetectorParameters
from .saturation import full_pixels
from .stray_light import Spread

if TYPE_CHECKING:
    import mitsuba as mi

    Scene = mi.Scene | str | os.PathLike[str] | Mapping[str, object]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LOG = logging.getLogger("mitsuba_fspt")
KINDS = ("lens", "sensor")
PRNU = ("prnu",)  # the map in place of which a flat field is used
LEAST = 0.05  # of the median response, and of the screen's brightest pixel: darker ones have > 20 times the noise
HOT = 2.0  # times the median of its 5 × 5 neighbours: an unmasked hot pixel of n changes the mean by less than 1/n
NEIGHBOURS = 5  # pixels a side
SMOOTHED = 8  # squares of the shorter side over this show what a lens loses, which is smooth
CHANCE = 4.0  # standard deviations of a mean over pixels: more is no noise
LOSS = 0.02  # by which the mean response may lie below the largest smooth one without a word
NORMALISED = 2.0  # largest median of a flat that was divided by its mean before; that of DN is larger


@dataclass(frozen=True, eq=False)
class FlatField:
    """Response of the pixels (h, w).

    response : f, relative to the mean of the pixels that are kept; 1 where masked
    mask : True where the flat gives no response: dark, negative, saturated or hot pixels, and those without light
    error : relative standard error of f (h, w) by shot and read noise; None for a single frame, whose number of frames
        is unknown, and for a map
    kind : 'lens', 'sensor' or, of the detector's own map, 'map'
    top_row : of its file, as of `Counts`
    """

    response: Array
    mask: Mask
    error: Array | None
    kind: str
    top_row: str | None = FIRST

    @classmethod
    def of_map(cls, detector: DetectorParameters, shape: tuple[int, ...]) -> FlatField | None:
        """Response by the map `prnu` of a detector; None without one."""
        response = detector.response(shape)
        if response is None:
            return None
        return cls(response, np.zeros(shape, bool), None, "map", detector.maps["prnu"].top_row)


def flat_field(
    detector: DetectorParameters,
    flat: Frame | Counts,
    kind: str | None,
    scene: Scene | None,
    shape: tuple[int, int],
    *,
    flat_dark: Frame | float | None = None,
    bias: Array | None = None,
    pixel_pitch: float | None = None,
    area: float = 1.0,
    binning: int | None = None,
) -> FlatField:
    """Flat field of counts of this `shape` (h, w); parameters as of `Detector.reduce`.

    bias : frame [DN] in place of the detector's number, for a flat of raw counts without `flat_dark`
    pixel_pitch, binning : of the pixels read out [mm], and the pixels along their side, or None
    area : number of the detector's own pixels in one that is read out

    Raises
    ------
    DetectorError : the kind is missing or unknown, a scene is missing or has no meaning, sizes do not fit, or no pixel
        is left.
    SceneError, OpticsError : the scene has no lens that can be used.
    """
    _require_kind(kind, scene)
    found = frame_like(flat, "flat", shape)
    require_rows_of_maps(detector, "flat", found, unused=PRNU)
    spurious = detector.spurious_charge * area * detector.em_gain / detector.on_pixels("gain", shape)
    level = detector.on_pixels("bias", shape) + spurious if bias is None else bias  # a frame contains that charge
    background, frames = _background(detector, found, flat_dark, level, shape)
    light = found.values - background
    full = _full(detector, found, light)
    screen = np.ones(shape) if scene is None else uniform_screen(scene, shape, pixel_pitch, binning)
    lit = screen > LEAST * screen.max()
    screen = Spread(None, detector.veiling_glare).forward(screen)  # a kernel leaves a smooth image as it is
    usable = lit & ~full & (light > 0)
    if not usable.any():
        raise DetectorError(
            f"reduce: the flat field has no usable pixel: {int(full.sum())} are saturated, {int((light <= 0).sum())} "
            "not above its bias. Give another one."
        )
    electrons = light * detector.on_pixels("gain", shape)  # after the register
    relative = np.where(usable, electrons / np.where(lit, screen, 1), 0)
    usable &= relative >= LEAST * np.median(relative[usable])
    # A masked neighbour counts as the median pixel, so that it makes no other pixel hot.
    filled = np.where(usable, relative, np.median(relative[usable]))
    usable &= relative <= HOT * median_filter(filled, NEIGHBOURS, mode="nearest")
    response = np.where(usable, relative / relative[usable].mean(), 1.0)
    error = _error(detector, np.where(usable, electrons, 1.0), found.frames, frames) if _is_in_dn(found) else None
    return FlatField(response, ~usable, error, str(kind), found.top_row)


def require_rows_of_maps(detector: DetectorParameters, name: str, counts: Counts, unused: tuple[str, ...] = ()) -> None:
    """Raise DetectorError for a map of the detector whose order of rows may be another one than that of counts.

    name : of the counts, for messages;  unused : names of maps that do not apply to them
    """
    for own, pixels in detector.maps.items():
        if own not in unused:
            require_same_rows(own, pixels.top_row, name, counts.top_row)


def tell_loss(field: FlatField, gain_error: float) -> None:
    """Say in one line on stderr that a flat through the lens falls off over the film beyond the model of the lens.

    The mean counts as 1, with what the lens loses. Where the quantum efficiency is the sensor's, the power comes out
    too small by that; told if by more than its relative uncertainty `gain_error`.
    """
    side = max(NEIGHBOURS, min(field.response.shape) // SMOOTHED) | 1
    if field.kind != "lens" or min(field.response.shape) < 2 * side:
        return
    smooth = uniform_filter(field.response, side, mode="reflect")
    noise = CHANCE * float(np.std(field.response - smooth)) / (side // 2)  # in a corner, of a quarter of a square
    if (loss := 1 - 1 / float(smooth.max())) > max(LOSS, gain_error, noise):
        LOG.warning(
            "fspt: reduce: the flat field falls from %.3g to %.3g over the film beyond the model of the lens. Its mean "
            "counts as 1: the power is too small by %.2g %% if the lens loses that, but for a 'quantum_efficiency' "
            "measured through it. Give the scene's lens its 'vignetting', see --vignetting.",
            *(smooth.max(), smooth.min(), 100 * loss),
        )


def uniform_screen(
    scene: Scene, shape: tuple[int, int], pixel_pitch: float | None = None, binning: int | None = None
) -> Array:
    """Étendue [mm² sr] of the pixels read out, (h, w): the image of a uniform surface over its radiance (Eq. M.6).

    It follows from the scene's lens, film and crop window, summed over the pixels of a bin, without a render. A film of
    as many pixels as the counts has the pixels read out.

    Raises
    ------
    DetectorError : the film is no whole multiple of `shape`, its pixels have not the `pixel_pitch` [mm], or neither
        that nor the `binning` says that several of them are read out as one.
    SceneError, OpticsError : the scene has no lens that can be used.
    """
    numbers, film = lens_numbers(scene)
    height, width = shape
    side = max(1, film[0] // height)
    if (height * side, width * side) != film or (side > 1 and pixel_pitch is None and side != binning):
        raise DetectorError(
            f"reduce: the film of the 'scene' has {film[1]} × {film[0]} pixels, the counts {width} × {height}. Give "
            "the scene of this camera, with its film and crop window, and 'pixel_pitch' or 'binning' of the counts."
        )
    own = float(numbers["pixel_pitch"]) * side
    if pixel_pitch is not None and abs(pixel_pitch - own) > SAME_PITCH * own:
        raise DetectorError(
            f"reduce: 'pixel_pitch' is {pixel_pitch:g} mm, the film of the 'scene' has {own:g} mm on the same pixels. "
            "Give the scene of this camera."
        )
    return etendue_of(film, numbers).reshape(height, side, width, side).sum(axis=(1, 3))


def _require_kind(kind: str | None, scene: Scene | None) -> None:
    """Raise DetectorError for a flat without its kind, and for a scene that is missing or has no meaning."""
    if kind not in KINDS:
        given = "is missing" if kind is None else f"must be one of {', '.join(KINDS)}, got '{kind}'"
        raise DetectorError(
            f"reduce: 'flat_kind' {given}. Give 'lens' for a uniform screen seen through the camera's lens, with the "
            "'scene' of that lens, whose cos⁴ and vignetting are then divided out; 'sensor' for uniform light on the "
            "sensor without a lens."
        )
    if kind == "lens" and scene is None:
        raise DetectorError("reduce: 'flat_kind' = lens needs the 'scene' with the camera's fspt_lens. Give its file.")
    if kind == "sensor" and scene is not None:
        raise DetectorError("reduce: 'scene' has no meaning for 'flat_kind' = sensor. Leave it out, or give 'lens'.")


def _background(
    detector: DetectorParameters,
    flat: Counts,
    flat_dark: Frame | float | None,
    bias: Array | float,
    shape: tuple[int, int],
) -> tuple[Array | float, float]:
    """Level to subtract from the flat [DN], and the number of frames that it is the mean of (inf for a number).

    Says in one line on stderr what is assumed without `flat_dark`.
    """
    if flat_dark is not None:
        if not isinstance(flat_dark, (str, os.PathLike)) and np.ndim(flat_dark) == 0:
            level = number("reduce: 'flat_dark'", flat_dark, DetectorError, "0")
            if not 0 <= level < np.inf:
                raise DetectorError(f"reduce: 'flat_dark' must be >= 0 DN, got {level:g}. Give 0 for a flat without.")
            return level, np.inf
        frame = frame_like(flat_dark, "flat_dark", shape)
        require_same_rows("flat_dark", frame.top_row, "flat", flat.top_row)
        require_same_time("flat_dark", frame, "flat", flat.exposure_time)
        if flat.raw:
            noise = detector.mean("read_noise") / detector.mean("gain")
            tell_below_bias(flat.values, detector.on_pixels("bias", shape), noise, "flat_dark", frame.values)
        return frame.values, frame.frames
    if flat.raw:
        given = f"{float(bias):g} DN" if np.ndim(bias) == 0 else "frame"
        LOG.warning(
            "fspt: reduce: the flat field holds raw counts; the bias, %s, is subtracted, no dark current. Give "
            "'flat_dark', a frame of the flat's exposure time that contains the bias, or 0.",
            given,
        )
        return bias, np.inf
    if (middle := float(np.median(flat.values))) > NORMALISED:
        LOG.warning(
            "fspt: reduce: the flat field, median %.6g, holds no unsigned integers as raw counts are; it is taken as "
            "free of bias and dark current. Give 'flat_dark', 0 if it is.",
            middle,
        )
    return 0.0, np.inf


def _is_in_dn(flat: Counts) -> bool:
    """False for a flat over its own mean; for a stack of such, a line on stderr says that its noise is left out."""
    if flat.raw or float(np.median(flat.values)) > NORMALISED:
        return True
    if flat.frames > 1:
        LOG.warning(
            "fspt: reduce: the %d frames of the flat field are not in DN, their noise is not part of the errors. Give "
            "frames of counts.",
            flat.frames,
        )
    return False


def _full(detector: DetectorParameters, flat: Counts, light: Array) -> Mask:
    """True where the flat is saturated; nowhere for one in other units than DN, such as a sum of frames."""
    if flat.raw:
        return full_pixels(detector, flat, "flat field")
    if float(np.median(flat.values)) <= NORMALISED:
        return np.zeros(flat.values.shape, bool)
    with_bias = bool(np.any(light != flat.values))  # a dark frame has been subtracted
    more = 0.0 if with_bias else detector.mean("bias")
    highest, first = (None if one is None else one + more for one in (flat.highest, flat.first))
    full = full_pixels(detector, replace(flat, values=flat.values + more, highest=highest, first=first), "flat field")
    return full if full.mean() < 0.5 else np.zeros_like(full)


def _error(detector: DetectorParameters, electrons: Array, frames: int, dark_frames: float) -> Array | None:
    """Relative standard error of the mean of a stack of flats by shot and read noise, and the read noise of its dark.

    electrons : mean of the flats (h, w) [e-] after the register;  frames, dark_frames : of the flat and of its dark
    """
    if frames == 1:
        return None
    read = np.square(detector.on_pixels("read_noise", electrons.shape)) * (1 / frames + 1 / dark_frames)
    return np.sqrt(detector.em_gain * detector.excess * electrons / frames + read) / electrons


def require_no_flat(**given: Any) -> None:
    """Raise DetectorError for a given setting of a flat field without one."""
    for name, value in given.items():
        if value is not None:
            raise DetectorError(
                f"reduce: '{name}' has no meaning without 'flat'. Give the flat field, or leave it out."
            )
