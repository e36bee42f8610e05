"""Measured images of all views: power, its noise as a function of the signal, and the pixels that count."""

from __future__ import annotations

import hashlib
import logging
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from ..detector.reduction import measured
from ..images.exposure import Exposure
from ..images.image import Image
from ..images.image_data import require_upright
from ..images.noise_model import NoiseModel, is_known, response_of
from ..runtime.errors import ImageError, InversionError
from ..runtime.numbers import number, require_unmasked, stacked
from ..runtime.stderr_lines import told
from .band_light import light_of_images
from .common_noise import CommonNoise, squared_correlations
from .stray_matrix import stray_light_of, without_glare_of
from .transport_matrix import TransportMatrix
from .view_factors import gain_error_of

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
MISFIT = 4.0  # standard deviations of Σ (residual/σ)² by chance: more happens in one fit of 30,000
WIDE = 0.9  # chi2 below which a warning says that errors are stated too large: intervals are > 5 % too wide
# Of Eq. M.27: steps of ln P; the number of groups for one variance, since the square of one standard error from eight
# passes is wrong by a half; and the share of the brightest pixel below which pixels count as equally dark.
ALIKE, GROUPS, FAINT = 0.05, 16, 1e-4
WIDEST = 1 << 24  # pixels in a row of a film, at most


@dataclass(frozen=True)
class Chi2:
    """Σ (noise/σ)² of pixels as the stated noise alone makes it.

    mean : without the numerical error of the fitted signal; with it at its bound, the number of pixels
    variance : 2 a pixel for normal noise, more for few electrons, and for noise that images have in common
    """

    mean: float
    variance: float


@dataclass(frozen=True, eq=False)
class Noise:
    """Variance of the pixels of all views, (views, h, w): shot · signal + other + (relative · signal)² (M.24, M.27).

    shot : [W], variance of the shot noise over the power: F²/(electrons per watt), 0 where `other` holds all the noise
    other : [W²], variance that does not depend on the signal: read-out, dark current, a given error
    sampled : (views,) True for images of Monte Carlo: their `other` are squares of standard errors that the scatter of
        samples gave, and the variance is a smooth function of the signal instead
    relative : relative standard error of the pixels' response, (views, h, w) or a number
    excess : F² of an electron-multiplying register, (views,) or a number
    detector : (views,) number of the detector and flat field of each view: pixels of one have the same response in all
        images, of other bands, too
    frame : [W²], (views, h, w) or a number, the part of `other` by a subtracted frame
    subtracted : (views,) number of that frame: the noise of one is the same in all images
    first : (views, 2) row and column on the film of the first pixel of each view
    places : pixels of the last call of `common`
    """

    shot: Array
    other: Array
    sampled: NDArray[np.bool_]
    relative: Array | float = 0.0
    excess: Array | float = 1.0
    detector: NDArray[np.int64] | int = 0
    frame: Array | float = 0.0
    subtracted: NDArray[np.int64] | int = 0
    first: NDArray[np.int64] | int = 0
    places: dict[bytes, list[CommonNoise]] = field(init=False, repr=False, default_factory=dict)

    def variance(self, signal: Array, used: NDArray[np.bool_]) -> Array:
        """Variance [W²] for a fitted signal [W], NaN where it is not known, of the pixels `used`; (views, h, w)."""
        light = np.maximum(signal, 0)
        variance = self.shot * light + self.other + (self.relative * light) ** 2
        if self.sampled.any():
            drawn = used & self.sampled[:, None, None]
            variance[drawn] = sampling_variance(signal, self.other, drawn)[drawn]
        return variance

    def chi2(self, signal: Array, sigma: Array, used: NDArray[np.bool_]) -> Chi2:
        """Mean and variance of Σ (noise/σ)² over the pixels `used`; `sigma` [W] may contain more than noise (M.24)."""
        variance = self.variance(signal, used)[used]
        shot = np.where(self.sampled[:, None, None], 0, self.shot)[used] * np.maximum(signal[used], 0)
        # Light in events of power w: the fourth moment of the noise is 3 v² + w² v for a variance v. A register turns
        # one electron into a gamma distributed number with the moments 1, F² and F² (2 F² − 1) (3 F² − 2) over gⁿ.
        f2 = np.broadcast_to(np.reshape(self.excess, (-1, 1, 1)), used.shape)[used]
        fourth = self.shot[used] ** 2 * shot * (2 * f2 - 1) * (3 * f2 - 2) / f2**2
        drawn = np.broadcast_to(self.sampled[:, None, None], used.shape)[used] & (signal[used] > 0)
        fourth[drawn] = variance[drawn] ** 3 / signal[used][drawn] ** 2
        square = sigma[used] ** 2
        pairs = 2 * squared_correlations(self.common(signal, used), sigma[used])
        return Chi2(float((variance / square).sum()), float(((2 * variance**2 + fourth) / square**2).sum()) + pairs)

    def common(self, signal: Array, used: NDArray[np.bool_]) -> list[CommonNoise]:
        """Noise of the pixels `used` that images have in common for a fitted signal (views, h, w) [W].

        By the response (M.24), and by a subtracted frame.
        """
        key = np.packbits(used).tobytes()
        if (places := self.places.get(key)) is None:
            self.places.clear()  # rows of one fit are the same each time
            self.places[key] = places = self._places(used)
        response = np.broadcast_to(self.relative, used.shape)[used] * np.maximum(signal[used], 0)
        frame = np.sqrt(np.broadcast_to(self.frame, used.shape)[used])
        return [place.of(part) for place, part in zip(places, (response, frame), strict=True)]

    def _places(self, used: NDArray[np.bool_]) -> list[CommonNoise]:
        """The pixels `used` of the response and of the frames, without noise."""
        view, row, column = np.nonzero(used)
        top, left = np.broadcast_to(self.first, (len(used), 2))[view].T
        pixel = (row + top) * WIDEST + column + left
        origins = (np.broadcast_to(origin, len(used))[view] for origin in (self.detector, self.subtracted))
        return [CommonNoise(np.zeros(len(view)), origin, pixel) for origin in origins]


def sampling_variance(signal: Array, squares: Array, used: NDArray[np.bool_]) -> Array:
    """Variance [W²] of Monte Carlo pixels, (views, h, w), as a function of the fitted signal P (Eq. M.27).

    A pixel's own standard error is not taken: one that few samples met by chance is too dark, has too small an error,
    and would count more. The variance depends on how P varies in the pixel: whether a silhouette crosses it, and how
    steep P is. Pixels are grouped by P and by the largest and the least P of their 3 × 3 neighbourhood (NaN left out),
    in steps of `ALIKE`. The variance is the mean of the `squares` of the standard errors in the `GROUPS` groups most
    alike; where all of these are 0, since no sample met the pixels, the nearest group with an error counts, too. 0
    where no pixel is used.
    """
    light = np.maximum(signal, 0)
    darkest, brightest = (np.where(np.isnan(light), end, light) for end in (np.inf, -np.inf))
    around = [
        light,
        maximum_filter(brightest, (1, 3, 3), mode="nearest"),
        minimum_filter(darkest, (1, 3, 3), mode="nearest"),
    ]
    least = FAINT * (float(light[used].max(initial=0.0)) or 1.0)
    steps = np.stack([np.rint(np.log(np.maximum(one[used], least) / least) / ALIKE) for one in around], axis=-1)
    _, first, group = np.unique(steps @ (1 << np.array([40, 20, 0])), return_index=True, return_inverse=True)
    steps, count = steps[first], np.bincount(group)
    total = np.bincount(group, squares[used])
    near = cKDTree(steps).query(steps, [*range(1, min(GROUPS, len(steps)) + 1)])[1] if len(steps) else np.empty((0, 0))
    sums, counts = total[near].sum(axis=1), count[near].sum(axis=1)
    dark, met = sums == 0, np.flatnonzero(total)
    if dark.any() and len(met):
        nearest = met[cKDTree(steps[met]).query(steps[dark])[1]]
        sums[dark], counts[dark] = total[nearest], counts[dark] + count[nearest]
    variance = np.zeros(signal.shape)
    variance[used] = (sums / counts)[group]
    return variance


@dataclass(frozen=True, eq=False)
class Measurement:
    """Images of all views, pixel by pixel in the order of the rows of the matrix, (N,).

    power : [W], 0 where masked
    noise : variance of the pixels, (views, height, width)
    mask : True where a pixel is left out
    gain_error : relative standard deviation of a factor common to all pixels
    matrix : T for these images, behind the point-spread function of their detector, if they name one
    light_nm : mean wavelength of the images' light [nm], NaN where they state none

    The veiling glare g of a detector is taken out of the images: power and noise are those of (P − g ⟨P⟩)/(1 − g).
    """

    power: Array
    noise: Noise
    mask: NDArray[np.bool_]
    gain_error: float
    matrix: TransportMatrix
    light_nm: float = float("nan")

    @property
    def shot(self) -> Array:
        """(N,) [W], variance of the shot noise over the power."""
        return self.noise.shot.ravel()

    @property
    def other(self) -> Array:
        """(N,) [W²], variance that does not depend on the signal."""
        return self.noise.other.ravel()

    @classmethod
    def of(
        cls,
        matrix: TransportMatrix,
        images: ArrayLike | Sequence[Image | Exposure | str | os.PathLike[str]] | Image | Exposure | os.PathLike[str],
        error: ArrayLike | None,
        mask: ArrayLike | None,
        gain_error: float | None,
        sampled: bool = False,
    ) -> Measurement:
        """Measurement from images as `invert` takes them; a file of `fspt reduce` or `fspt expose` may stand for one.

        Raises
        ------
        InversionError : no error is known, it is not > 0, or nothing is left to fit.
        TransportError : the images do not fit the matrix.
        DetectorError : an Exposure without the numbers of its detector.
        ImageError : a file that cannot be read.
        """
        if isinstance(images, (Image, Exposure, str, os.PathLike)):
            images = [images]
        for name, plane in (("images", images), ("error", error), ("mask", mask)):
            require_upright(f"invert: '{name}'", plane, InversionError)
        require_unmasked("invert: 'error'", error, InversionError, "Give its data, and its mask as 'mask'.")
        if isinstance(images := stacked(images), np.ma.MaskedArray):
            mask = np.ma.getmaskarray(images) | (False if mask is None else np.asarray(mask))
            images = images.filled(0)
        listed = isinstance(images, (list, tuple))
        planes: Any = [measured(image) for image in images] if listed else images  # type: ignore[union-attr,arg-type]
        masks = _mask(matrix, planes if listed else [], mask)
        if not listed:
            planes = np.where(masks, 0.0, _numbers(planes, masks.shape))
        power = matrix.images(planes)
        sensors = [view.get("sensor", 0) for view in matrix.views]
        noise = noise_of(matrix.image_shape, planes if listed else [], error, sampled, sensors=sensors)
        shown = [plane for plane in planes if isinstance(plane, Image)] if listed else []
        found = gain_error_of(shown, "invert") if gain_error is None else gain_error
        found = number("invert: 'gain_error'", found, InversionError, "0.05")
        if not 0 <= found < 1:
            raise InversionError(f"invert: 'gain_error' must be in [0, 1), got {found:g}. Give for example 0.05.")
        if masks.all():
            raise InversionError("invert: every pixel is masked or saturated. Expose for a shorter time.")
        stray = stray_light_of(matrix, planes if listed else [], "invert")
        power, noise = without_glare(power, noise, masks, stray.glare)
        known, light = np.where(masks, 0, power).ravel(), light_of_images(shown, "invert")
        return cls(known, noise, masks.ravel(), found, without_glare_of(matrix, stray), light)

    @property
    def relative(self) -> Array:
        """(N,) relative standard error of the pixels' response."""
        return np.broadcast_to(self.noise.relative, self.noise.shot.shape).ravel()

    def slope(self, rows: NDArray[np.int64], signal: Array) -> Array:
        """Slope [W] of the variance of the pixels `rows` with a fitted signal [W] (Eq. M.29); 0 for a Monte Carlo."""
        return np.asarray(self.shot[rows] + 2 * self.relative[rows] ** 2 * np.maximum(signal, 0))

    def background(self, rows: NDArray[np.int64], signal: Array) -> Array:
        """Variance [e⁻] of the pixels `rows` beside their shot noise for a fitted signal [W] (Eq. M.28)."""
        variance = self.other[rows] + (self.relative[rows] * np.maximum(signal, 0)) ** 2
        return np.asarray(variance / self.shot[rows] ** 2)

    def sigma(self, rows: NDArray[np.int64], signal: Array, numerical: Array, verb: str) -> Array:
        """Standard deviation [W] of the pixels `rows` for a fitted signal and its numerical error [W] (Eq. M.24).

        Raises InversionError, in the name of `verb`, for pixels without noise.
        """
        images, used = self.as_images(rows, signal)
        variance = self.noise.variance(images, used)[used] + numerical**2
        if not (variance > 0).all():
            count = int(np.sum(~(variance > 0)))
            raise InversionError(
                f"{verb}: {count} pixels that see the surface have no noise, σ = 0. Give a read noise, or in Python "
                "error= > 0 there or a mask."
            )
        return np.sqrt(variance)

    def drawn(
        self, rows: NDArray[np.int64], signal: Array, deviation: Array, size: int, rng: np.random.Generator
    ) -> Array:
        """Random noise (N, size) [W] of the pixels `rows` with a fitted signal [W] and the `deviation` (N,) [W] of it.

        A part of it is the same in several views, see `common`.
        """
        parts = self.common(rows, signal)
        own = np.sqrt(np.maximum(deviation**2 - sum(part.deviation**2 for part in parts), 0))
        found = own[:, None] * rng.standard_normal((len(rows), size))
        for part in parts:
            if part.deviation.any():
                numbers = rng.standard_normal((part.shared.max() + 1, size))
                found += part.deviation[:, None] * numbers[part.shared]
        return found

    def common(self, rows: NDArray[np.int64], signal: Array) -> list[CommonNoise]:
        """Noise of the pixels `rows`, ascending, that images have in common; see `Noise.common`."""
        return self.noise.common(*self.as_images(rows, signal))

    def chi2(self, rows: NDArray[np.int64], signal: Array, sigma: Array) -> Chi2:
        """Σ (noise/σ)² of the pixels `rows` for a fitted signal [W] and its σ [W]."""
        images, used = self.as_images(rows, signal)
        return self.noise.chi2(images, self.as_images(rows, sigma)[0], used)

    def as_images(self, rows: NDArray[np.int64], values: Array) -> tuple[Array, NDArray[np.bool_]]:
        """`values` of the ascending `rows` as (views, h, w), NaN where masked and 0 elsewhere; True on the rows."""
        images, used = np.where(self.mask, np.nan, 0.0), np.zeros(len(self.mask), bool)
        images[rows], used[rows] = values, True
        return images.reshape(self.noise.shot.shape), used.reshape(self.noise.shot.shape)


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    """`values` as an array of this shape where it has it up to the axis of views, else unchanged for a later check."""
    try:
        if np.iscomplexobj(values):
            raise TypeError("they are complex")
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as cause:
        raise InversionError(
            f"invert: images must be numbers of shape {shape}, or one Image a view: {cause}."
        ) from cause
    if array.shape != shape and array.shape != shape[1:]:
        raise InversionError(
            f"invert: images must have the shape {shape} (views, height, width), got {array.shape}. Give one image a "
            "view, of the film that the matrix was made for."
        )
    return array.reshape(shape) if array.size == np.prod(shape) else array


def _mask(matrix: TransportMatrix, images: Sequence[Any], mask: ArrayLike | None) -> NDArray[np.bool_]:
    """(views, height, width), True where the given mask or that of an image leaves a pixel out."""
    shape = matrix.image_shape
    whole = np.zeros(shape, bool)
    if mask is not None:
        given = np.asarray(mask)
        if given.dtype != bool or given.shape not in (shape, shape[1:]):
            raise InversionError(
                f"invert: 'mask' must be True and False of shape {shape}, got {given.dtype} of shape {given.shape}. "
                "Give True for pixels to leave out."
            )
        whole |= given
    if len(images) == shape[0]:
        for number_, image in enumerate(images):
            if isinstance(image, Image) and image.mask is not None and image.shape == shape[1:]:
                whole[number_] |= image.mask
    tell_left_out(whole, "it out of the matrix")
    return whole


def tell_left_out(masks: NDArray[np.bool_], what: str) -> None:
    """Say in a line each on stderr which images (views, h, w) are masked everywhere; `what` to leave out with them."""
    for left_out in np.flatnonzero(masks.all(axis=(1, 2))):
        LOG.warning(
            "fspt: no pixel of image %d counts, as all are masked. If they are saturated, expose for a shorter time. "
            "If it is left out on purpose, leave %s, too.",
            left_out,
            what,
        )


def noise_of(
    shape: tuple[int, int, int],
    images: Sequence[Any],
    error: ArrayLike | None = None,
    sampled: object = False,
    verb: str = "invert",
    sensors: Sequence[int] | None = None,
) -> Noise:
    """Noise of images, one a view, or of an array with its standard `error`, for all views (views, height, width).

    sampled : True for a Monte Carlo; images whose metadata name its `passes` are taken for one by themselves
    sensors : number of the scene's sensor of each view: one is one camera; None: each view may be of another

    Raises InversionError, in the name of `verb`, for images without an error, or numbers outside their range.
    """
    _require_bool(sampled, verb)
    shot, other, relative, frame = (np.zeros(shape) for _ in range(4))
    excess = np.ones(shape[0])
    drawn = np.full(shape[0], bool(sampled))
    if error is not None:
        other[...] = _checked_error(error, shape, verb) ** 2
        return Noise(shot, other, drawn)
    if not images:
        raise InversionError(
            f"{verb}: an array of power says nothing of its noise. Give error=, its standard error [W], or images of "
            "'fspt reduce'."
        )
    for k, image in enumerate(images):
        if not isinstance(image, Image):
            raise InversionError(
                f"{verb}: image {k} says nothing of its noise. Give images of 'fspt reduce'"
                f"{', or in Python error= [W]' if verb == 'invert' else ''}."
            )
        try:
            model = NoiseModel.of(image, f"{verb}: image {k}")
        except ImageError as cause:
            raise InversionError(str(cause)) from cause
        if model is not None:
            if sampled:
                raise InversionError(
                    f"{verb}: image {k} has the noise of electrons, not that of a Monte Carlo. Leave out 'sampled'."
                )
            shot[k], other[k], relative[k], excess[k] = model.shot, model.dark, model.relative, model.excess
            frame[k] = model.frame
        elif image.error is not None:
            other[k] = image.error.astype(np.float64) ** 2
            drawn[k] |= "passes" in image.metadata
        else:
            raise InversionError(
                f"{verb}: image {k} has neither 'electrons_per_watt' nor an error. Reduce it from its counts"
                f"{', or in Python give error= [W]' if verb == 'invert' else ''}."
            )
    responses = [response_of(image) for image in images]
    if sensors is None or len(set(sensors)) > 1:
        _tell_one_camera(verb, [r for k, r in enumerate(responses) if relative[k].any() and not is_known(images[k])])
    detectors = _numbered(responses)
    frames = _numbered([image.metadata.get("frame_digest") for image in images])
    return Noise(shot, other, drawn, relative, excess, detectors, frame, frames, _first(images, verb))


def _require_bool(sampled: object, verb: str) -> None:
    if not isinstance(sampled, (bool, np.bool_)):
        raise InversionError(
            f"{verb}: 'sampled' must be True or False, got {sampled!r}. Give True for images of a Monte Carlo."
        )


def _tell_one_camera(verb: str, responses: Sequence[object]) -> None:
    """Say in one line on stderr that images of detectors without a name, of one response, count as of one camera."""
    if len(set(responses)) < len(responses):
        LOG.warning(
            "fspt: %s: %d images name no detector; those with the same numbers count as of one camera, whose "
            "pixels have one response. Give each camera a 'name', such as its serial number.",
            verb,
            len(responses),
        )


def _numbered(keys: Sequence[object]) -> NDArray[np.int64]:
    """Number of each key, from its digest: the same for equal ones, in other bands, too."""
    digests = (hashlib.sha256(repr(key).encode()).digest() for key in keys)
    return np.array([int.from_bytes(digest[:7], "big") for digest in digests], np.int64)


def _first(images: Sequence[Image], verb: str) -> NDArray[np.int64]:
    """(views, 2) row and column on the film of the first pixel of each image; InversionError for no such number."""
    found = np.zeros((len(images), 2), np.int64)
    for k, image in enumerate(images):
        for axis, name in enumerate(("crop_offset_y", "crop_offset_x")):
            given = number(f"{verb}: image {k}, '{name}'", image.metadata.get(name, 0), InversionError, "0")
            if not abs(given) < WIDEST:
                raise InversionError(f"{verb}: image {k} has '{name}' {given:g}. Give the place on the film, as 0.")
            found[k, axis] = int(given)
    return found


def without_glare(power: Array, noise: Noise, masks: NDArray[np.bool_], glare: float) -> tuple[Array, Noise]:
    """Power (views, h, w) [W] without a veiling glare, the share `glare` of its mean, and its noise (Eq. M.38).

    The mean has far less noise than a pixel. Masked pixels count in it with the median of their neighbours, which is
    told in one line.
    """
    if not glare:
        return power, noise
    filled = power
    if masks.any():
        filled = np.where(masks, np.nan, power)
        for _ in range(max(power.shape)):  # from the rim of a masked part inwards
            if not (left := np.isnan(filled)).any():
                break
            filled = np.where(left, _median_around(filled), filled)
        LOG.warning(
            "fspt: %d masked pixels count in the veiling glare with the median of their neighbours. Expose so "
            "that no pixel saturates.",
            int(masks.sum()),
        )
    level = glare * np.nan_to_num(filled).mean(axis=(1, 2), keepdims=True)
    share, light = 1 - glare, np.maximum(level, 0)
    other = (noise.other + noise.shot * light + (noise.relative * light) ** 2) / share**2
    frame = noise.frame / share**2
    return (power - level) / share, replace(noise, shot=noise.shot / share, other=other, frame=frame)


def _median_around(images: Array) -> Array:
    """Median of the pixels that are not NaN among each pixel and its 8 neighbours, (views, h, w)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pixels without any
        padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
        height, width = images.shape[1:]
        around = [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
        return np.asarray(np.nanmedian(around, axis=0))


def tell_misfit(verb: str, chi2_sum: float, pixels: int, fitted: float, noise: Sequence[Chi2]) -> list[str]:
    """Say in one line on stderr that Σ (residual/σ)² is larger, or smaller, than the stated noise makes it.

    chi2_sum : over the `pixels`, of which the fit of `fitted` numbers takes one each
    noise : of the images of each band

    Returns the lines, none where the sum agrees with the noise.
    """
    free, chance = max(pixels - fitted, 1.0), MISFIT * sum(one.variance for one in noise) ** 0.5
    least, chi2, text = sum(one.mean for one in noise) - fitted, chi2_sum / free, ""
    if chi2_sum > free + chance:
        text = (
            f"chi2 is {chi2:.3g}, the images differ from the fit by more than their noise, which the stated errors do "
            "not contain. Check order of the views, pose, mesh, exit law, background and the detector's numbers."
        )
    elif chi2_sum < least - chance and chi2_sum < WIDE * least:
        text = (
            f"chi2 is {chi2:.3g}, the images differ from the fit by less than their noise: it is stated too large, and "
            f"intervals are about {(least / max(chi2_sum, 1e-300)) ** 0.5:.2g} times too wide. Check where their "
            "errors come from: read noise and gain of a detector, means of several frames, few passes of a Monte Carlo."
        )
    return told(verb, [text] if text else [])


def _checked_error(error: ArrayLike, shape: tuple[int, int, int], verb: str) -> Array:
    """Standard errors [W] that are finite, >= 0 and of this shape, that of one view, or one number."""
    try:
        if np.shape(error) not in ((), shape, shape[1:]):
            raise ValueError("another shape")
        given = np.broadcast_to(np.asarray(error, np.float64), shape)
    except (TypeError, ValueError) as cause:
        raise InversionError(
            f"{verb}: 'error' must be a number or of shape {shape}, got {np.shape(error)}. Give W a pixel."
        ) from cause
    if not (np.isfinite(given).all() and (given >= 0).all()):
        raise InversionError(f"{verb}: 'error' has values that are negative, NaN or infinite. Give W, >= 0.")
    return given
