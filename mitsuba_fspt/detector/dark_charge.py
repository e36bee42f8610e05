"""Charge that a dark frame shows above the bias: the counts have it, too, with its shot noise."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
SURE = 5.0  # standard deviations of a dark frame less the bias: noise alone makes a pixel so bright once in 3 million


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
