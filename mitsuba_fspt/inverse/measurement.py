"""What the pictures of all views say: power, its noise as a function of the signal, and the pixels that count."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..detector.reduction import flat_variance, measured, responses
from ..images.exposure import Exposure
from ..images.image import Image
from ..runtime.errors import InversionError
from ..runtime.numbers import number
from .transport_matrix import TransportMatrix

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
MISFIT = 4.0  # standard deviations of Σ (residual/σ)² by chance: more happens in one fit of 30,000


@dataclass(frozen=True, eq=False)
class Measurement:
    """Images of all views, pixel by pixel in the order of the rows of the matrix, (N,).

    power : [W], 0 where masked
    shot : [W], variance of the shot noise over the power: 1/(electrons per watt), 0 where `other` holds all the noise
    other : [W²], variance that does not depend on the signal: read-out, dark current, a given error
    mask : True where a pixel is left out
    gain_error : relative standard deviation of a factor common to all pixels
    """

    power: Array
    shot: Array
    other: Array
    mask: NDArray[np.bool_]
    gain_error: float

    @classmethod
    def of(
        cls,
        matrix: TransportMatrix,
        images: ArrayLike | Sequence[Image | Exposure | str | os.PathLike[str]] | Image | Exposure | os.PathLike[str],
        error: ArrayLike | None,
        mask: ArrayLike | None,
        gain_error: float | None,
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
        listed = isinstance(images, (list, tuple))
        planes: Any = [measured(image) for image in images] if listed else images  # type: ignore[union-attr,arg-type]
        masks = _mask(matrix, planes if listed else [], mask)
        if not listed:
            planes = np.where(masks, 0.0, _numbers(planes, masks.shape))
        power = matrix.images(planes)
        shot, other = variances(matrix.image_shape, planes if listed else [], error)
        shot = np.where(masks, 0, shot)
        found = (
            float("nan") if gain_error is None else number("invert: 'gain_error'", gain_error, InversionError, "0.05")
        )
        if gain_error is None:
            found = max(
                (float(i.metadata.get("gain_error", 0.0)) for i in planes if isinstance(i, Image)) if listed else [0.0],
                default=0.0,
            )
        if not 0 <= found < 1:
            raise InversionError(f"invert: 'gain_error' must be in [0, 1), got {found:g}. Give for example 0.05.")
        if masks.all():
            raise InversionError("invert: every pixel is masked or saturated. Expose for a shorter time.")
        return cls(np.where(masks, 0, power).ravel(), shot.ravel(), other.ravel(), masks.ravel(), found)

    def sigma(self, rows: NDArray[np.int64], signal: Array, numerical: Array, verb: str) -> Array:
        """Standard deviation [W] of the pixels `rows` for a fitted signal and its numerical error [W] (Eq. M.24).

        Raises InversionError, in the name of `verb`, for pixels without noise.
        """
        variance = self.shot[rows] * np.maximum(signal, 0) + self.other[rows] + numerical**2
        if not (variance > 0).all():
            count = int(np.sum(~(variance > 0)))
            raise InversionError(
                f"{verb}: {count} pixels that see the surface have no noise, σ = 0. Give a read noise, or in Python "
                "error= > 0 there or a mask."
            )
        return np.sqrt(variance)


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
    return whole


def variances(
    shape: tuple[int, int, int], images: Sequence[Any], error: ArrayLike | None = None, verb: str = "invert"
) -> tuple[Array, Array]:
    """`shot` [W] and `other` [W²], (views, height, width), of a Measurement: σ² = shot · signal + other.

    Raises InversionError, in the name of `verb`, for images without an error, or numbers outside their range.
    """
    shot, other = np.zeros(shape), np.zeros(shape)
    if error is not None:
        try:
            given = np.asarray(error, np.float64)
            other[...] = given**2
        except (TypeError, ValueError) as cause:
            raise InversionError(
                f"{verb}: 'error' must be a number or of shape {shape}, got {np.shape(error)}. Give W a pixel."
            ) from cause
        if not (np.isfinite(given).all() and (given >= 0).all()):
            raise InversionError(f"{verb}: 'error' has values that are negative, NaN or infinite. Give W, >= 0.")
        return shot, other
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
        if "electrons_per_watt" in image.metadata:
            per_watt, read, dark = (
                number(f"{verb}: image {k}, '{name}'", image.metadata.get(name, 0.0), InversionError, "1e15")
                for name in ("electrons_per_watt", "read_noise", "dark_electrons")
            )
            if not (0 < per_watt < np.inf and 0 <= read < np.inf and 0 <= dark < np.inf):
                raise InversionError(
                    f"{verb}: image {k} has {per_watt:g} electrons a watt and {read:g} electrons of read noise. Reduce "
                    "it again from its counts."
                )
            each = per_watt * responses(image)
            shot[k], other[k] = 1 / each, (read**2 + dark) / each**2 + flat_variance(image)
        elif image.error is not None:
            other[k] = image.error.astype(np.float64) ** 2
        else:
            raise InversionError(
                f"{verb}: image {k} has neither 'electrons_per_watt' nor an error. Reduce it from its counts"
                f"{', or in Python give error= [W]' if verb == 'invert' else ''}."
            )
    return shot, other


def tell_misfit(verb: str, chi2_sum: float, free: float) -> None:
    """Say in one line on stderr that Σ (residual/σ)² over `free` pixels is larger than noise makes it."""
    free = max(free, 1.0)
    if chi2_sum > free + MISFIT * (2 * free) ** 0.5:
        LOG.warning(
            "fspt: %s: chi2 is %.3g, the images differ from the fit by more than their noise, which the stated errors "
            "do not contain. Check order of the views, pose, mesh, exit law, background and the detector's numbers.",
            verb,
            chi2_sum / free,
        )
