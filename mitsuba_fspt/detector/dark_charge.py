"""What counts have without light, its noise, and the charge that a dark frame shows above the bias."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.formats import Metadata
from ..images.noise_model import digest_of, frame_recorded
from ..runtime.errors import DetectorError
from ..runtime.numbers import number
from .counts import Counts, Frame, frame_like, require_same_rows, require_same_time
from .parameters import DetectorParameters

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
DARKEST = 10.0  # percent of the pixels, which have no light or less than others; bad ones are fewer
SURE = 5.0  # standard deviations of a dark frame less the bias: noise alone makes a pixel so bright once in 3 million


@dataclass(frozen=True, eq=False)
class Background:
    """What counts have without light, numbers or arrays (h, w); electrons are those before the register.

    level : to subtract [DN]
    charge : dark and spurious charge [e-]
    added : variance that a subtracted frame adds [e-²], 0 for a number
    frame : values of that frame [DN], None for a number
    """

    level: Array | float
    charge: Array | float
    added: Array | float = 0.0
    frame: Array | None = None

    def shared(self, independent: Array | float, frames: int, metadata: Mapping[str, Any]) -> Metadata:
        """Metadata of the noise that images have in common from which the same frame was subtracted.

        `frame_share` of the variance of a pixel without light, where it is the same on all pixels; else
        `frame_electrons` of the median pixel [e-²]. Empty for a number in place of a frame.

        independent : variance without light of one of the `frames` frames [e-²], without that of the subtracted one
        metadata : of the image, with its place on the film
        """
        if self.frame is None or not np.any(self.added):
            return {}
        common = frames * np.asarray(self.added)  # of one frame of the sum, as `independent` is
        return frame_recorded(digest_of([self.frame], metadata), common * frames, (independent + common) * frames)


def background_of(
    detector: DetectorParameters,
    raw: Counts,
    dark_charge: Array | float,
    spurious: float,
    exposure_time: float,
    bias: Frame | None,
    dark: Frame | float | None,
) -> Background:
    """What the counts have without light, by the numbers of the detector or by frames without light.

    A dark frame, or a number in its place, has the same exposure time as the counts and contains the bias. Both frames
    contain the spurious charge. What a dark frame shows above the bias counts as charge, see `shown_charge`.

    dark_charge, spurious : charges by the numbers of the detector, before the register [e-]
    exposure_time : [s]
    """
    shape = raw.values.shape
    gain = detector.on_pixels("gain", shape) / detector.em_gain  # electrons before the register per DN
    charge = dark_charge + spurious
    reading = (detector.on_pixels("read_noise", shape) / detector.em_gain) ** 2 + gain**2 / 12
    given = raw.bias if bias is None else bias
    empty = None if given is None else frame_like(given, "bias", shape)  # without dark charge
    zero = own = detector.on_pixels("bias", shape)
    tell = partial(tell_below_bias, raw.values, own, float(np.median(np.sqrt(reading) / gain)))
    noise: Array | float = 0.0  # variance of the bias frame
    if empty is not None:
        require_same_rows("bias", empty.top_row, "counts", raw.top_row)
        tell("bias", empty.values)
        zero, noise = empty.values - spurious / gain, (detector.excess * spurious + reading) / empty.frames
    if dark is not None and not isinstance(dark, (str, os.PathLike)) and np.ndim(dark) == 0:
        level = number("reduce: 'dark'", dark, DetectorError, "500")
        if not 0 <= level < np.inf:
            raise DetectorError(f"reduce: 'dark' must be >= 0 DN, got {level:g}. Give the bias and the dark current.")
        tell("dark", level)
        shown = gain * (level - zero)
        return Background(level, shown_charge(shown, charge, reading, detector.excess, math.inf, noise))
    frame = raw.background if dark is None and raw.background is not None else dark
    if frame is not None:
        found = frame_like(frame, "dark", shape)
        require_same_rows("dark", found.top_row, "counts", raw.top_row)
        require_same_time("dark", found, "counts", exposure_time)
        tell("dark", found.values)
        shown = gain * (found.values - zero)
        charge = shown_charge(shown, charge, reading, detector.excess, found.frames, noise)
        return Background(found.values, charge, (detector.excess * charge + reading) / found.frames, found.values)
    if empty is not None:
        return Background(empty.values + dark_charge / gain, charge, noise, empty.values)
    return Background(own + charge / gain, charge)


def tell_below_bias(counts: Array, bias: Array | float, noise: float, name: str, level: Array | float) -> None:
    """Say in one line on stderr that a frame without light has less than half of the bias of the detector, and the
    counts have more: the bias has been subtracted from the frame, as from darks that were reduced before, but not from
    the counts.

    counts : (h, w) [DN];  bias : of the detector [DN];  noise : of reading a pixel [DN]
    name : of the frame;  level : of its pixels [DN]
    """
    middle, below = float(np.median(bias)), float(np.median(bias - level))
    if below > max(SURE * noise, middle / 2) and float(np.percentile(counts - level, DARKEST)) > below / 2:
        LOG.warning(
            "fspt: reduce: '%s' is %.3g DN below the bias of the detector, %.4g DN, which counts have without light. "
            "If the bias was subtracted from it before, the image is too bright by that. Give frames as they are read "
            "out, or correct 'bias'.",
            name,
            below,
            middle,
        )


def shown_charge(
    shown: Array | float,
    stated: Array | float,
    reading: Array | float,
    excess: float,
    frames: float,
    zero: Array | float = 0.0,
) -> Array | float:
    """Charge without light [e-] of each pixel before the register, (h, w) or a number.

    It is the stated one, unless the dark frame shows so much more that the variance without light is more than twice
    the stated one: on hot pixels, or on most of them, which one line on stderr says. A smaller difference of all pixels
    counts as a drift of the bias.

    shown : dark frame less the bias (h, w), or a number [e-]
    stated : charge by the numbers of the detector [e-]
    reading : variance of reading a pixel [e-²]
    excess : F² of the register
    frames : number of frames that the dark frame is the mean of; inf for a number
    zero : variance of the subtracted bias frame [e-²]; 0 for a number
    """
    surplus = shown - stated
    middle = float(np.median(surplus))
    if excess * middle > float(np.median(excess * stated + reading)):
        LOG.warning(
            "fspt: reduce: the dark frame has %.3g electrons more than bias and dark current of the detector say. They "
            "are taken for dark charge, whose noise is part of the errors. Correct 'bias' and 'dark_current', or give "
            "a 'bias' frame.",
            middle,
        )
        stated = stated + middle
    known = excess * stated + reading  # variance without light
    hot = surplus - middle
    sure = (excess * hot > known) & (hot > SURE * np.sqrt(known / frames + zero))
    return stated + np.where(sure, hot, 0.0) if np.any(sure) else stated
