"""What counts have without light, its noise, and the charge that a dark frame shows above the bias."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.formats import Metadata
from ..images.noise_model import digest_of, frame_recorded

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
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
