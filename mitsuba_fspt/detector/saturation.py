"""Saturated pixels: by the detector's numbers, and by more pixels at exactly the largest count than noise explains."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, poisson

from .counts import Counts
from .parameters import DetectorParameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LOG = logging.getLogger("mitsuba_fspt")
CHANCE = 1e-6  # of a false alarm in an image whose noise is that of the detector's numbers
WHOLE = 1e-3  # deviation of a sum of frames from a whole number that rounding may cause
MANY = 5  # pixels: fewer at the largest count are passed over
FEWEST_BITS = 8  # of a converter
# Second differences over their standard deviation: the least median that noise makes, and the largest that is no edge;
# number of them that tells; least deviation of noise over the step of the counts, by whose rounding they are 0.14.
NOISY, EDGE, ENOUGH, COARSE = 0.3, 5.0, 100, 3.0
WINDOW = 2.0  # standard deviations to each side of a value, within which other counts of equal light lie


def saturated(detector: DetectorParameters, counts: Array) -> Mask:
    """True (h, w) where a count has reached the largest value of the converter or the full well."""
    top = 2**detector.bits - 1
    bias, gain = (_level(detector, name, counts) for name in ("bias", "gain"))
    return (counts >= top) | (counts >= bias + detector.full_well / gain - 0.5)


def _level(detector: DetectorParameters, name: str, counts: Array) -> Array | float:
    """Value of a parameter on the pixels of counts (h, w), its mean for a single count."""
    return detector.on_pixels(name, counts.shape) if counts.ndim else detector.mean(name)


def full_pixels(detector: DetectorParameters, counts: Counts, name: str) -> Mask:
    """True (h, w) where counts are saturated in any frame: by the detector's numbers, or at an `unknown_ceiling`.

    The latter is told in one line on stderr, which calls the counts `name`.
    """
    highest = counts.values if counts.highest is None else counts.highest
    full = saturated(detector, highest)
    if counts.first is None:
        ceiling = unknown_ceiling(detector, counts.values, counts.frames)
    else:  # the mean over frames has no such value; the first frame has, if no other frame exceeds it
        ceiling = unknown_ceiling(detector, counts.first)
        ceiling = ceiling if ceiling == highest.max() else None
    if ceiling is None or saturated(detector, np.array(ceiling)):
        return full
    reached = highest >= ceiling
    LOG.warning(
        "fspt: reduce: %d pixels of the %s have exactly the largest value, %g DN, where noise would spread them: the "
        "camera saturates there, below %d bits and full well. They are masked. Correct 'bits' or 'full_well'.",
        int(reached.sum()),
        name,
        ceiling,
        detector.bits,
    )
    return full | reached


def unknown_ceiling(detector: DetectorParameters, counts: Array, frames: int = 1) -> float | None:
    """The largest count [DN], if so many pixels have exactly this one that the camera saturates there; else None.

    Of n pixels that reach the largest value M, all have exactly M by chance with the probability hⁿ. h is the share of
    the value M in the tail from M on of a normal distribution with the standard deviation σ of shot and read noise at
    M: h = 1 − Q(z + s/σ)/Q(z), Q(z) = n/N, with all N pixels and the step s of the counts. Fewer pixels of that light
    lie less far in the tail, where h is smaller. At low light σ is below the step, h is near 1 and nothing is found.
    Counts without noise, such as simulated ones, repeat other values as often; then nothing is found either. Areas that
    were set to one value, or columns without response, repeat it too: neighbours elsewhere tell whether there is noise.
    Where all counts are equal, they are at the ceiling if they are the largest count of a converter with fewer bits.

    counts : (h, w) [DN], of one frame or the mean of `frames` frames
    """
    values, numbers = np.unique(counts, return_counts=True)
    reached = int(numbers[-1])
    if reached < MANY:
        return None
    if len(values) == 1:
        return float(values[0]) if values[0] + 1 in 2.0 ** np.arange(FEWEST_BITS, detector.bits) else None
    step = _step(values, frames)
    depth = norm.isf(reached / counts.size)
    share = 1 - norm.sf(depth + step / _sigma(detector, values[-1], frames)) / norm.sf(depth)
    if reached * np.log(share) > np.log(CHANCE):
        return None
    noisy = _neighbours_differ(detector, counts, step, frames)
    if not noisy and _without_noise(detector, values[:-1], numbers[:-1], step, frames):
        return None
    return float(values[-1])


def _step(values: Array, frames: int) -> float:
    """Step [DN] of which all distances of the ascending `values` (n,) are multiples; without one, the least distance.

    It is 1/frames for means, and more where the converter's counts are shifted to more bits.
    """
    whole = np.rint(values * frames)
    if np.abs(whole - values * frames).max() > WHOLE:
        return float(np.diff(values).min())
    return float(np.gcd.reduce(np.diff(whole).astype(np.int64))) / frames


def _neighbours_differ(detector: DetectorParameters, counts: Array, step: float, frames: int) -> bool:
    """True if second differences d along rows of counts (h, w) [DN] are as large as noise makes them.

    The median of |d|/(√6 σ) is 0.67 by normal noise. Of smooth counts without noise |d| is the `step` [DN] of rounding,
    which tells nothing where σ is not `COARSE` times as large. Three equal counts in a row, counts at the ceiling and
    edges in the image are left out.
    """
    if counts.ndim != 2 or counts.shape[1] < 3:
        return False
    left, middle, right = counts[:, :-2], counts[:, 1:-1], counts[:, 2:]
    sigma = _sigma(detector, middle, frames)
    ratio = np.abs(left - 2 * middle + right) / (math.sqrt(6) * sigma)
    used = ((left != middle) | (middle != right)) & (np.maximum(np.maximum(left, middle), right) < counts.max())
    used &= (ratio < EDGE) & (sigma > COARSE * step)
    return bool(used.sum() >= ENOUGH and np.median(ratio[used]) > NOISY)


def _without_noise(
    detector: DetectorParameters, values: Array, numbers: NDArray[np.int64], step: float, frames: int
) -> bool:
    """True if the most frequent of the `values` [DN] is more frequent than the detector's noise lets it be.

    Of normally distributed counts, the share of one value among those within `WINDOW` σ is largest at their mean. The
    most frequent of all values is tried, hence a chance for each.
    """
    most = int(np.argmax(numbers))
    sigma = _sigma(detector, values[most], frames)
    inside = int(numbers[np.abs(values - values[most]) <= WINDOW * sigma + step / 2].sum())
    share = min(1.0, (2 * norm.cdf(step / 2 / sigma) - 1) / (2 * norm.cdf(WINDOW) - 1))
    return bool(numbers[most] > 1 and len(values) * poisson.sf(numbers[most] - 1, inside * share) < CHANCE)


def _sigma(detector: DetectorParameters, counts: Array | float, frames: int) -> Array:
    """Standard deviation [DN] of shot, read and rounding noise of the mean of `frames` frames at these counts [DN]."""
    gain, read = detector.mean("gain"), detector.mean("read_noise")
    electrons = np.maximum(gain * (counts - detector.mean("bias")), 0.0)
    variance = (detector.em_gain * detector.excess * electrons + read**2) / gain**2 + 1 / 12
    return np.asarray(np.sqrt(variance / frames))
