"""Vignetting of a lens from a flat of a uniform screen through it: what Eq. 9 says of the screen is divided out.

    share = (F/U)/f / level       F: the flat less its bias and dark current;  U: the screen by Eq. 9 (Eq. M.6)

f is the response of the pixels, from a flat of the sensor without a lens. Without one it stays in the shares. The
level is the largest of F/U/f, smoothed, so that noise does not raise it; shares above 1 become 1. The veiling glare of
the detector with its lens, a share of the mean of F/f, is taken off F/f before (Eq. M.38).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter

from ..images.formats import Metadata, write_planes
from ..images.frame_file import tell_open_rows
from ..optics.vignetting import VIGNETTING
from ..rendering.lens_numbers import lens_numbers
from ..runtime.errors import DetectorError
from .counts import Counts, Frame, frame_like, frame_of, require_same_rows
from .flat_field import LEAST, FlatField, flat_field, uniform_screen
from .parameters import DetectorParameters
from .stray_light import Spread

if TYPE_CHECKING:
    from .flat_field import Scene

# Of counts whose detector is not given: nothing of it but the range of 16 bits enters a quotient of flats.
UNKNOWN = DetectorParameters(1.0, 0.0, 0.0, 1e15, 1.0, 0.0, 16)
SMOOTHED = 8  # the level is the largest mean over squares of the film's shorter side over this
RESPONSE = {True: "divided out", False: "contained in the shares"}

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasuredVignetting:
    """Shares of a lens's vignetting, as `fspt_lens` takes them from a file.

    shares : in (0, 1] (h, w)
    filled : True where the flats give none, which have the mean of their neighbours (h, w)
    metadata : `pixel_response`, whether it is divided out or contained; `filled_pixels`; `clipped`, the largest share
        by which 1 was exceeded; the numbers of the lens
    """

    shares: Array
    filled: NDArray[np.bool_]
    metadata: Metadata

    @classmethod
    def of_flat(
        cls,
        flat: Frame,
        scene: Scene,
        *,
        detector: DetectorParameters | None = None,
        flat_dark: Frame | float | None = None,
        sensor_flat: Frame | None = None,
    ) -> MeasuredVignetting:
        """Shares from a flat of a uniform screen through the scene's lens, with the pixels of its crop window.

        flat : frame or stack [DN], or its file
        scene : what `render` takes, with the camera's lens, film and crop window
        detector : for saturated pixels, gain and bias, and the veiling glare, which is no vignetting
        flat_dark : as of `Detector.reduce`; of both flats
        sensor_flat : frame or stack of a uniform light on the sensor without the lens; None: the pixels' response stays
            in the shares

        Raises
        ------
        DetectorError : a lens that has a vignetting already, frames that do not fit, raw counts without
            a bias, or no usable pixel.
        ImageError, SceneError, OpticsError, BackendError : as `Detector.reduce`.
        """
        numbers, film = lens_numbers(scene)
        if VIGNETTING in numbers:
            raise DetectorError(
                f"reduce: the lens of the 'scene' has a vignetting already, '{numbers[VIGNETTING]}'. Leave it out to "
                "measure it."
            )
        found = frame_of(flat, "flat")
        known, shape = UNKNOWN if detector is None else detector, (film[0], film[1])
        _require_bias(detector, found, flat_dark)
        tell_open_rows("reduce: the FITS file of the flat", found.top_row, "in all frames of this camera")
        of_lens = flat_field(known, frame_like(found, "flat", shape), "lens", scene, shape, flat_dark=flat_dark)
        ratio, good = of_lens.response, ~of_lens.mask
        if sensor_flat is not None:
            response = _sensor_flat(known, detector, sensor_flat, flat_dark, shape)
            require_same_rows("sensor_flat", response.top_row, "flat", found.top_row)
            ratio, good = ratio / response.response, good & ~response.mask
        if not good.any():
            raise DetectorError("reduce: no pixel is usable in both flats. Give flats that do not saturate.")
        ratio = _without_glare(ratio, good, uniform_screen(scene, shape), known.veiling_glare)
        good &= ratio > LEAST * np.median(ratio[good])
        shares, clipped = _scaled(ratio, good)
        entries: Metadata = {
            "quantity": VIGNETTING,
            "unit": "1",
            "pixel_response": RESPONSE[sensor_flat is not None],
            "filled_pixels": int(np.sum(~good)),
            "clipped": clipped,
        }
        if of_lens.error is not None:
            entries["relative_error"] = float(np.median(of_lens.error[good]))
        return cls(shares, ~good, numbers | entries)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the shares, with the mask of the filled pixels, as an image file; raises as `Image.write`."""
        write_planes(path, {VIGNETTING: self.shares, "mask": self.filled.astype(np.float32)}, self.metadata)


def _require_bias(detector: DetectorParameters | None, flat: Counts, flat_dark: Frame | float | None) -> None:
    """Raise DetectorError for raw counts of which no bias is known."""
    if detector is None and flat.raw and flat_dark is None:
        raise DetectorError(
            "reduce: the flat holds raw counts, whose bias is unknown. Give the detector, or 'flat_dark', 0 if there "
            "is none."
        )


def _sensor_flat(
    known: DetectorParameters,
    detector: DetectorParameters | None,
    flat: Frame,
    flat_dark: Frame | float | None,
    shape: tuple[int, int],
) -> FlatField:
    """Response of the pixels by a flat without a lens."""
    found = frame_like(frame_of(flat, "sensor_flat"), "sensor_flat", shape)
    _require_bias(detector, found, flat_dark)
    return flat_field(known, found, "sensor", None, shape, flat_dark=flat_dark)


def _without_glare(ratio: Array, good: NDArray[np.bool_], screen: Array, glare: float) -> Array:
    """Shares (h, w), up to a factor, from the light on the film over the `screen` with its veiling glare (Eq. M.38).

    Of the lit pixels those that are not good count with the mean of the others.
    """
    if not glare:
        return ratio
    light, lit = ratio * Spread(None, glare).forward(screen), float((screen > LEAST * screen.max()).mean())
    mean = light[good].mean() * lit / (1 - glare + glare * lit)  # over the whole film
    return np.divide(light - glare * mean, screen, out=np.zeros_like(screen), where=good)


def _scaled(ratio: Array, good: NDArray[np.bool_]) -> tuple[Array, float]:
    """Shares in (0, 1] of a ratio (h, w) up to a factor; pixels that are not good have the mean of their neighbours.

    Second the largest excess over 1 that was cut off.
    """
    near = _mean_around(ratio, good, 3)
    nearest = distance_transform_edt(np.isnan(near), return_distances=False, return_indices=True)
    filled = np.where(good, ratio, near[tuple(nearest)])
    side = max(5, min(ratio.shape) // SMOOTHED) | 1
    once = uniform_filter(filled, side, mode="nearest")
    smooth = 2 * once - uniform_filter(once, side, mode="nearest")  # without the curvature that a mean takes off a peak
    shares = filled / float(smooth.max())
    return np.minimum(shares, 1.0), max(0.0, float(shares.max()) - 1)


def _mean_around(ratio: Array, good: NDArray[np.bool_], side: int) -> Array:
    """Mean of the good pixels in the square of an odd `side` about each pixel, (h, w); NaN without any."""
    weight = uniform_filter(good.astype(np.float64), side, mode="nearest")
    total = uniform_filter(np.where(good, ratio, 0), side, mode="nearest")
    return np.divide(total, weight, out=np.full(ratio.shape, np.nan), where=weight > 0.5 / side**2)
