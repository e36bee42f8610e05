"""Comparison of a calculated image with a standard: the paper's ME and CF, absolute errors and a z-test."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..runtime.errors import ImageError
from ..runtime.numbers import whole
from .deviations import Deviations, LightOfOne, Profile
from .formats import Metadata
from .image import Image
from .pixel_axes import CROP
from .recorded_number import recorded_number
from .z_test import brightest, error_bound, z_test

SURE = 2.0  # standard errors above which a difference of the light that two images contain is significant
LEAST_LIGHT = 1e-5  # of the power: smaller differences are rounding errors
PSF, GLARE = "psf", "veiling_glare"  # keys of the metadata of images with stray light


class Comparison(Deviations):
    """Result of `compare`.

    Attributes
    ----------
    me : mean error, Σ|P_cal/max P_cal − P_std/max P_std| / N over the N pixels (paper, section 3), >= 0
    cf : correlation factor, Pearson's, with sums over N − 1 (paper, section 3), in [−1, 1]
    max_error : max|P_cal − P_std| / max P_std, absolute powers: only the standard's peak scales both
    rms : √(Σ(P_cal − P_std)² / N) / max P_std, likewise absolute
    ratio : Σ P_cal / Σ P_std of the absolute powers; None if it is not finite, as for Σ P_std = 0
    profiles : power along rows and columns
    light_of_one : light that only one of the images contains; None where both follow the same paths
    z_test : test of the differences against their errors; None if no pixel with light has a standard error, or with
        `light_of_one`, which the test would take for an error
    beyond : number of pixels at which the images differ by more than the sum of both integrals' errors; only if no
        such pixel has a standard error and both contain the same light, else None, as without any errors
    stray_light : 'calculated' or 'standard', the only image whose metadata tell of the stray light of a detector; None
        where both do or neither
    masked : number of pixels masked in either image, which no number above counts; profiles show them as stored
    """

    def _repr_png_(self) -> bytes | None:
        """Profiles for notebooks; None without matplotlib."""
        from .notebook import comparison_png

        return comparison_png(self)

    def _repr_html_(self) -> str:
        """Numbers and profiles for notebooks."""
        from .notebook import comparison_html

        return comparison_html(self)


def compare(
    calculated: Image,
    standard: Image,
    *,
    rows: ArrayLike | None = None,
    columns: ArrayLike | None = None,
) -> Comparison:
    """Deviation of a calculated image from a standard of the same shape (h, w).

    Parameters
    ----------
    calculated, standard : power [W], for example the integral and a Monte Carlo image
    rows, columns : indices of the profiles, one or several, in 0 … h − 1 and 0 … w − 1; if neither is given, the row
        and column through the standard's brightest pixel

    Pixels that are masked in either image, such as saturated ones, are left out of all numbers. Where the metadata of
    the images state that one contains light which the other leaves out (`light_left_out`), that is said, and the pixels
    are not tested.

    The z-test assumes that the errors of the two images are independent. It treats the error of the integral as a
    bound, that of Monte Carlo as a standard error estimated from few passes, and any other as a known standard
    deviation; see `ZTest`.

    Raises
    ------
    ImageError : an argument is no `Image`, the shapes differ, every pixel is masked, an image has no positive power or
        is constant (ME or CF is then undefined), or a row or column does not exist.
    """
    kept = _checked(calculated, standard)
    all_cal, all_std = (image.power.astype(np.float64) for image in (calculated, standard))
    p_cal, p_std = all_cal[kept], all_std[kept]
    peak = p_std.max()
    normalised_cal, normalised_std = p_cal / p_cal.max(), p_std / peak
    difference = np.abs(p_cal - p_std)
    if rows is None and columns is None:
        row, column = brightest(standard, kept)
        rows, columns = [int(row)], [int(column)]
    light = _light_of_one(calculated, standard)
    test = None if light else z_test(calculated, standard)
    return Comparison(
        me=float(np.abs(normalised_cal - normalised_std).mean()),
        cf=float(np.corrcoef(normalised_cal, normalised_std)[0, 1]),
        max_error=float(difference.max() / peak),
        rms=float(np.sqrt(np.square(difference / peak).mean())),
        ratio=_ratio(float(p_cal.sum()), float(p_std.sum())),
        profiles=_profiles(all_cal, all_std, () if rows is None else rows, () if columns is None else columns),
        z_test=test,
        beyond=None if test or light else _beyond(difference, error_bound(calculated, standard)[kept]),
        masked=int(kept.size - kept.sum()),
        light_of_one=light,
        stray_light=_with_stray_light(calculated, standard),
    )


def _with_stray_light(calculated: Image, standard: Image) -> str | None:
    """The only image whose metadata tell of stray light: 'calculated' or 'standard'; None for both or neither."""
    images = {"calculated": calculated, "standard": standard}
    found = [name for name, image in images.items() if any(image.metadata.get(key) for key in (PSF, GLARE))]
    return found[0] if len(found) == 1 else None


def _light_of_one(calculated: Image, standard: Image) -> LightOfOne | None:
    """The light that the metadata say only one of the images contains; None where that is not significant."""
    images = {"calculated": calculated, "standard": standard}
    if not all("method" in image.metadata for image in images.values()):  # a measured image contains all light
        return None
    left, errors = (
        [recorded_number(image.metadata, key, 0.0) for image in images.values()]
        for key in ("light_left_out", "light_left_out_error")
    )
    error = math.hypot(*errors)
    if abs(left[0] - left[1]) <= max(SURE * error, LEAST_LIGHT) or left[1] >= 1:
        return None
    # With shares l of all power W left out, the images contain (1 - l) W.
    ratio = (1 - left[0]) / (1 - left[1])
    ratio_error = math.hypot(errors[0], ratio * errors[1]) / (1 - left[1])
    image = "standard" if left[0] > left[1] else "calculated"
    return LightOfOne(image, abs(left[0] - left[1]), error, ratio, ratio_error)


def _checked(calculated: Image, standard: Image) -> NDArray[np.bool_]:
    """True (h, w) on the pixels to compare, those masked in neither image; ImageError for what `compare` refuses."""
    for image in (calculated, standard):
        if not isinstance(image, Image):
            raise ImageError(
                f"compare: must be given two images, got {type(image).__name__}. Give what `read` returns."
            )
    if calculated.shape != standard.shape:
        raise ImageError(
            f"compare: the calculated image has {_size(calculated)} pixels, the standard {_size(standard)}. "
            "Render both with the same film."
        )
    windows: list[Metadata] = [{k: i.metadata[k] for k in CROP if k in i.metadata} for i in (calculated, standard)]
    if all(windows) and windows[0] != windows[1]:
        raise ImageError(
            f"compare: the images are different crop windows of the film, {_window(windows[0])} and "
            f"{_window(windows[1])}. Give the same part of both."
        )
    kept = calculated.kept & standard.kept
    if not kept.any():
        raise ImageError(
            f"compare: every pixel is masked in one of the images, {calculated.masked} in the calculated one and "
            f"{standard.masked} in the standard; nothing to compare. Expose for a shorter time."
        )
    for name, image in (("calculated image", calculated), ("standard", standard)):
        peak = image.power[kept].max()
        if not peak > 0:
            raise ImageError(
                f"compare: the {name} is dark, its brightest pixel has {peak:g} W; nothing to normalise by. "
                "Check that the camera sees the phantom."
            )
        if image.power[kept].min() == peak:
            raise ImageError(
                f"compare: every pixel of the {name} has {peak:g} W; the correlation with a constant (CF) is "
                "not defined. Give an image with some structure."
            )
    return kept


def _beyond(difference: NDArray[np.float64], bound: NDArray[np.float64]) -> int | None:
    return int(np.count_nonzero(difference > bound)) if bound.any() else None


def _ratio(calculated: float, standard: float) -> float | None:
    ratio = calculated / standard if standard else math.inf
    return ratio if math.isfinite(ratio) else None


def _profiles(
    p_cal: NDArray[np.float64], p_std: NDArray[np.float64], rows: ArrayLike, columns: ArrayLike
) -> tuple[Profile, ...]:
    profiles = []
    for line, indices, cal, std in (("row", rows, p_cal, p_std), ("column", columns, p_cal.T, p_std.T)):
        for given in np.atleast_1d(indices):
            index = whole(f"compare: the number of a {line}", given, ImageError, "0")
            if not 0 <= index < len(std):
                raise ImageError(f"compare: {line} {index} does not exist. Give one in 0 … {len(std) - 1}.")
            profiles.append(Profile(line, index, cal[index], std[index]))
    return tuple(profiles)


def _window(crop: Metadata) -> str:
    """First pixel of a crop window and the size of its film, for messages."""
    return "x = {}, y = {} of {} × {} pixels".format(*(crop.get(k) for k in (*CROP[2:], *CROP[:2])))


def _size(image: Image) -> str:
    """Width × height, the order of all messages; arrays have the shape (h, w)."""
    return " × ".join(map(str, image.shape[::-1]))
