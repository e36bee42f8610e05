"""Noise of an image that was reduced from counts, as a function of the light on a pixel (Eq. M.24).

    s²(P) = F² P/(k f) + (σ_d/(k f))² + (ε P)²

with k = `electrons_per_watt` and F² = `excess_noise` of the metadata; the response f, the dark noise σ_d [e⁻] and the
relative error ε of the response are planes of the image or numbers of its metadata.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import ImageError
from ..runtime.numbers import number
from .formats import Metadata
from .image_data import ImageData

Array = NDArray[np.float64]
NUMBERS = ("read_noise", "dark_electrons", "excess_noise", "prnu")  # of the metadata, beside `electrons_per_watt`

SAME_SHARE = 1e-6  # largest range of the share of a frame's noise that counts as one number
FRAME = ("frame_electrons", "frame_share", "frame_digest")  # of the metadata: noise of a subtracted frame
FLAT = "flat_digest"  # of the metadata: digest of the whole flat field at reduction, which parts of the image keep
PART = "flat_part_digest"  # of the metadata of a part: digest of its own planes, without which FLAT is that of others
DIGITS = 16  # of a digest
TYPICAL = "typical, not a data sheet"
UNNAMED = (None, "detector", TYPICAL)  # names of a detector that say nothing of which one it is
TELLING = ("detector_pixel_pitch", "em_gain", "prnu")  # of the metadata: these tell detectors without a name apart


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variance of the power P on a pixel: shot P + dark + (relative P)² [W²], arrays (h, w).

    shot : [W], excess noise F² over the electrons per watt of the pixel
    dark : [W²], variance without light: read-out, dark current, spurious charge, rounding, subtracted frames
    relative : relative standard error of the pixel's response
    excess : F²
    frame : [W²], the part of `dark` by a subtracted frame, which is the same in all images that it was subtracted from;
        0 without a `frame_digest`, which says which one it was
    """

    shot: Array
    dark: Array
    relative: Array
    excess: float
    frame: Array

    @classmethod
    def of(cls, image: ImageData, thing: str = "image") -> NoiseModel | None:
        """Noise model that a reduced image contains; None for any other image.

        Raises ImageError, which calls the image `thing`, for numbers that no detector has.
        """
        if "electrons_per_watt" not in image.metadata:
            return None
        per_watt, *others = (
            number(f"{thing}, '{name}'", image.metadata.get(name, default), ImageError, "1e15")
            for name, default in (("electrons_per_watt", 0.0), *zip(NUMBERS, (0.0, 0.0, 1.0, 0.0), strict=True))
        )
        read, dark, excess, prnu = others
        finite = all(map(math.isfinite, (per_watt, read, dark, excess, prnu)))
        if not (finite and per_watt > 0 and min(read, dark, prnu) >= 0 and excess >= 1):
            raise ImageError(
                f"{thing} has {per_watt:g} electrons a watt, {read:g} electrons of read noise, {dark:g} e-² of dark "
                f"current, an excess noise of {excess:g} and a PRNU of {prnu:g}. Reduce it again from its counts."
            )
        each = np.full(image.shape, per_watt) if image.flat is None else per_watt * image.flat.astype(np.float64)
        noise = math.hypot(read, math.sqrt(dark)) if image.dark_noise is None else image.dark_noise.astype(np.float64)
        error = 0.0 if image.flat_error is None else image.flat_error.astype(np.float64)
        relative, without = np.hypot(error, np.full(image.shape, prnu)), (noise / each) ** 2
        return cls(excess / each, without, relative, excess, _of_frame(image.metadata, thing, without, each))

    def variance(self, power: Array) -> Array:
        """Variance [W²] for the light `power` [W]; that of a negative one is the variance without light."""
        light = np.maximum(power, 0)
        return self.shot * light + self.dark + (self.relative * light) ** 2


def response_of(image: ImageData) -> tuple[object, ...]:
    """What images have in common whose pixels have one response: detector, binning, and the digest of a flat field.

    Detectors without a name are told apart by their numbers, else taken as one. Parts of an image with one flat field
    have the digest of the whole one, in the metadata since its reduction.
    """
    name, binning = image.metadata.get("detector"), image.metadata.get("binning", 1)
    numbers = tuple(image.metadata.get(key) for key in TELLING) if name in UNNAMED else ()
    return name, binning, *numbers, flat_digest(image)


def is_known(image: ImageData) -> bool:
    """True where the image says of which pixels its response is: by the name of the detector, or by a flat field."""
    return image.flat is not None or image.metadata.get("detector") not in UNNAMED


def flat_digest(image: ImageData) -> str | None:
    """Digest of the whole flat field at reduction, of which the image may be a part; None without one.

    The one in the metadata holds for the planes at reduction and for parts of them. Of others, such as planes that were
    replaced since, it is the digest of these planes.
    """
    planes = [np.asarray(one, np.float32) for one in (image.flat, image.flat_error) if one is not None]
    if not planes:
        return None
    own, whole = digest_of(planes, image.metadata), image.metadata.get(FLAT)
    return str(whole) if whole is not None and own == image.metadata.get(PART, whole) else own


def part_recorded(part: ImageData, whole: str | None) -> Metadata:
    """Metadata by which a part of an image keeps the digest of its whole flat field, `whole`; none without one."""
    planes = [np.asarray(one, np.float32) for one in (part.flat, part.flat_error) if one is not None]
    return {} if whole is None else {FLAT: whole, PART: digest_of(planes, part.metadata)}


def same_detector_named(one: ImageData, other: ImageData) -> bool:
    """True for two images that name one detector. Without a name they may be of two cameras."""
    name = one.metadata.get("detector")
    return name not in UNNAMED and name == other.metadata.get("detector")


def covariance(one: ImageData, other: ImageData, sign: int) -> Array:
    """Covariance (h, w) [W²] of two images of the same pixels: by one frame subtracted from both, and by the response.

    sign : 1 for a sum, -1 for a difference, whose error it makes smaller. There the response counts only where both
        name their detector: without a name each choice is the one with the larger error

    0 for images that were not reduced. Raises ImageError as `NoiseModel.of`.
    """
    found, models = np.zeros(one.shape), [NoiseModel.of(image) for image in (one, other)]
    if models[0] is None or models[1] is None:
        return found
    if one.metadata.get("frame_digest") == other.metadata.get("frame_digest"):  # without one, `frame` is 0
        found += np.sqrt(models[0].frame * models[1].frame)
    parts = [m.relative * np.maximum(image.power, 0) for m, image in zip(models, (one, other), strict=True) if m]
    alike = response_of(one) == response_of(other) and (sign == 1 or same_detector_named(one, other))
    if alike and all(part.any() for part in parts):
        found += parts[0] * parts[1]
    return found


def digest_of(planes: Sequence[NDArray[Any]], metadata: Mapping[str, Any]) -> str:
    """Digest of a frame or flat field (h, w) at the reduction of an image with this metadata.

    It contains the place of the first pixel on the film: pixels of two images with one digest and one place on the film
    are the same elements of the frame.
    """
    places = [str(metadata.get(f"crop_offset_{axis}", 0)).removesuffix(".0") for axis in "yx"]
    texts = [(plane + 0.0).tobytes() for plane in planes]  # + 0: of -0, too
    return hashlib.sha256(b"".join([*texts, repr(places).encode()])).hexdigest()[:DIGITS]


def frame_recorded(digest: str, common: Array | float, total: Array | float) -> Metadata:
    """Metadata of the noise by a subtracted frame: its share of the variance without light, where all pixels have the
    same, else its variance on the median pixel.

    common, total : variances by the frame and in all [e-²], (h, w) or numbers
    """
    share = np.asarray(common / total)
    if np.ptp(share) <= SAME_SHARE:
        return {"frame_digest": digest, "frame_share": float(np.mean(share))}
    return {"frame_digest": digest, "frame_electrons": float(np.median(common))}


def _of_frame(metadata: Mapping[str, Any], thing: str, dark: Array, each: Array) -> Array:
    """Part [W²] of the variance `dark` by a subtracted frame, 0 without a digest; `each`: electrons per watt.

    Raises ImageError for numbers that are no variance and no share.
    """
    share, most = (
        number(f"{thing}, '{name}'", metadata.get(name, 0.0), ImageError, "0.5")
        for name in ("frame_share", "frame_electrons")
    )
    if not (0 <= share <= 1 and 0 <= most < math.inf):
        raise ImageError(
            f"{thing} has {most:g} e-² of a subtracted frame, or its share {share:g}, outside 0 to 1. Reduce it again "
            "from its counts."
        )
    if metadata.get("frame_digest") is None:
        return np.zeros(each.shape)
    return np.minimum(share * dark + most / each**2, dark)
