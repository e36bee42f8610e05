"""Sum and difference of two images of one camera, with their errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import ImageError
from .formats import BESIDE, Metadata
from .image_data import ImageData
from .noise_model import (
    FLAT,
    FRAME,
    NUMBERS,
    PART,
    NoiseModel,
    covariance,
    frame_recorded,
    response_of,
    same_detector_named,
)
from .pixel_axes import PixelAxes
from .recorded_number import recorded_number
from .z_test import is_deterministic

Plane = NDArray[np.float64]
Sum = TypeVar("Sum", bound=ImageData)
SQUARES = ("read_noise", "dark_electrons")  # numbers of the noise that add up, the former in squares


def combined(one: Sum, other: ImageData, sign: int) -> Sum:
    """Sum of two images for `sign` = 1, difference for -1, as of `Image.__add__`."""
    _require_same_film(one, other)
    mask = None if one.mask is None and other.mask is None else ~(one.kept & other.kept)
    power = one.power.astype(np.float64) + sign * other.power.astype(np.float64)
    if mask is not None:
        power[mask] = 0
    coverage = one.coverage if _same(one.coverage, other.coverage) else None
    known = _metadata(one, other) | _source_power(one, other, sign)
    for name in FRAME:  # of which each of the two may have another share
        known.pop(name, None)
    known.pop("gain_error", None)
    gain_error, own = _gain_errors(one, other, sign)
    if gain_error:
        known["gain_error"] = gain_error
    planes: dict[str, Any] = dict.fromkeys(BESIDE)
    error = _error(one, other, sign)
    planes |= {"error": None if error is None else np.hypot(error, own), "coverage": coverage, "mask": mask}
    if sign == 1 and _of_one_detector(one, other):
        noise, dark_noise = _noise_without_light(one, other)
        known |= noise
        planes |= {"flat": one.flat, "flat_error": one.flat_error, "dark_noise": dark_noise}
    else:  # no shot noise of the sum follows from its power: the error alone states it
        for name in ("electrons_per_watt", FLAT, PART, *NUMBERS):
            known.pop(name, None)
    if mask is not None:
        known["masked_pixels"] = int(mask.sum())
    return replace(one, power=power, metadata=known, **planes)


def _gain_errors(one: ImageData, other: ImageData, sign: int) -> tuple[float, NDArray[np.float64] | float]:
    """Gain error of a sum or difference, and the error [W] of its pixels by those of the images that it has not.

    A sum has the larger one, an upper bound. So has a difference of two images that name the same detector with the
    same gain error; other factors are not common to its pixels.
    """
    errors = [image.gain_error or 0.0 for image in (one, other)]
    if sign == 1 or (same_detector_named(one, other) and errors[0] == errors[1]):
        return max(errors), 0.0
    parts = (gain * image.power.astype(np.float64) for gain, image in zip(errors, (one, other), strict=True))
    return 0.0, np.hypot(*parts)


def _of_one_detector(one: ImageData, other: ImageData) -> bool:
    """True for measured images of one detector with the same electrons per watt, excess noise and response."""
    if not all(name in image.metadata for name in ("electrons_per_watt", *SQUARES) for image in (one, other)):
        return False
    same = [name for name in ("electrons_per_watt", *NUMBERS) if name not in SQUARES]
    return (
        all(one.metadata.get(name) == other.metadata.get(name) for name in same)
        and response_of(one) == response_of(other)
        and _same(one.flat, other.flat)
        and _same(one.flat_error, other.flat_error)
    )


def _frames(one: ImageData, other: ImageData) -> tuple[set[str], list[Plane]]:
    """Digests of the subtracted frames, and the variance [e-²] by them in each image, (h, w), 0 without one."""
    found, planes = set(), []
    for image in (one, other):
        digest, model = image.metadata.get("frame_digest"), NoiseModel.of(image)
        if model is None or not model.frame.any():
            planes.append(np.zeros(image.shape))
            continue
        found.add(str(digest))  # there is one, else `frame` is 0
        planes.append(model.frame * (model.excess / model.shot) ** 2)
    return found, planes


def _dark_variance(image: ImageData) -> Plane | float:
    """Variance without light of a measured image [e-²], (h, w), or a number where all pixels have the same."""
    if image.dark_noise is not None:
        return image.dark_noise.astype(np.float64) ** 2
    return float(image.metadata["read_noise"]) ** 2 + float(image.metadata["dark_electrons"])


def _noise_without_light(one: ImageData, other: ImageData) -> tuple[Metadata, Plane | None]:
    """Noise without light of the sum of two measured images: its numbers, and its plane [e-], None if both have none.

    The noise of one frame that was subtracted from both adds up itself, not in squares.
    """
    digests, (first, second) = _frames(one, other)
    both = 2 * np.sqrt(first * second) if len(digests) == 1 else 0 * first
    total = _dark_variance(one) + _dark_variance(other) + both
    read, dark = ([float(image.metadata[name]) for image in (one, other)] for name in SQUARES)
    known: Metadata = {"read_noise": math.hypot(*read), "dark_electrons": sum(dark) + float(np.median(both))}
    if len(digests) == 1:
        known |= frame_recorded(digests.pop(), first + second + both, total)
    alike = one.dark_noise is None and other.dark_noise is None
    return known, None if alike else np.broadcast_to(np.sqrt(total), one.shape)


def _error(one: ImageData, other: ImageData, sign: int) -> Plane | None:
    """Standard errors added in squares, with what reduced images have in common; bounds, of which the integral's are,
    added up. None where one is unknown.

    Monte Carlo images of one seed have noise in common: their errors add up, too, the bound of any correlation.
    """
    if one.error is None or other.error is None:
        return None
    first, second = one.error.astype(np.float64), other.error.astype(np.float64)
    seeds = [image.metadata.get("seed") for image in (one, other)]
    if is_deterministic(one) or is_deterministic(other) or (seeds[0] is not None and seeds[0] == seeds[1]):
        return first + second
    return np.sqrt(np.maximum(first**2 + second**2 + 2 * sign * covariance(one, other, sign), 0))


def _metadata(one: ImageData, other: ImageData) -> Metadata:
    """Entries that both have, and the warnings of either."""
    known = {name: value for name, value in one.metadata.items() if other.metadata.get(name) == value}
    told = dict.fromkeys(str(image.metadata["warnings"]) for image in (one, other) if "warnings" in image.metadata)
    return known | ({"warnings": "; ".join(told)} if told else {})


def _source_power(one: ImageData, other: ImageData, sign: int) -> Metadata:
    """`source_power` of the sum, that of both sources; of a difference, or where one has none, that of the image.

    A sum without it could be scaled again.
    """
    watts = [
        recorded_number(image.metadata, "source_power", 0.0)
        for image in (one, other)
        if "source_power" in image.metadata
    ]
    if not watts:
        return {}
    return {"source_power": sum(watts) if sign == 1 else watts[0]}


def _same(one: NDArray | None, other: NDArray | None) -> bool:
    """True for equal planes, or none in both images."""
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


def _require_same_film(one: ImageData, other: ImageData) -> None:
    """Raise ImageError unless both images have the same pixels."""
    if one.shape != other.shape:
        raise ImageError(f"image: {one.shape} and {other.shape} pixels cannot be added. Give images of one film.")
    places = [_places(image.shape, image.metadata) for image in (one, other)]
    if not all(np.allclose(first, second, rtol=1e-6, atol=1e-9) for first, second in zip(*places, strict=True)):
        raise ImageError(
            "image: the pixels of the two lie at different places on the film, or have another size or magnification. "
            "Add images of one camera and crop window."
        )


def _places(shape: tuple[int, int], known: Mapping[str, object]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres of the columns and rows."""
    axes = PixelAxes.of(shape, known)
    return axes.x, axes.y
