"""Stray light of lens and detector: a point-spread function, and a veiling glare over the whole film (Eq. M.38).

    P' = (1 − g) K ∗ P + g ⟨P⟩

g is the share of the film's light that is spread evenly over it, ⟨P⟩ the mean power of its pixels, K the kernel, of sum
1. Light that the kernel carries beyond the film is lost.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import convolve

from ..images.comparison import GLARE, PSF
from ..images.formats import Metadata, read_planes
from ..images.frame_file import FIRST, FITS, read_frame, shown_sides, tell_open_rows
from ..images.pixel_axes import CROP
from ..images.recorded_number import recorded_number, recorded_positive
from ..runtime.errors import BackendError, DetectorError, FsptError, ImageError

Array = NDArray[np.float64]
PSF_DIGEST, FILM = "psf_digest", "veiling_glare_film"  # keys of metadata
DIGITS = 16  # of a digest
LOG = logging.getLogger("mitsuba_fspt")
POINTS = 16  # along the side of a kernel's cell that is larger than a pixel


def tell_part(verb: str, metadata: Mapping[str, Any], shape: tuple[int, int]) -> None:
    """Say in one line on stderr that an image (h, w) is a part of its film, so that some of its stray light is missing:
    that which comes from beyond the edges of the part."""
    film = tuple(
        round(recorded_number(metadata, name, side, verb)) for name, side in zip(CROP[:2], shape[::-1], strict=True)
    )
    if film != shape[::-1]:
        LOG.warning(
            "fspt: %s: the image of %d x %d pixels is a part of a film of %d x %d; the stray light that comes from "
            "beyond its edges is missing. Give the whole film where light falls beyond.",
            *(verb, *shape[::-1], *film),
        )


@dataclass(frozen=True, eq=False)
class Kernel:
    """Point-spread function: light of a point (h, w), of sum 1, on cells of `pitch` [mm]; its middle is the point.

    path : absolute name of the file;  digest : first digits of its SHA-256
    """

    path: str
    digest: str
    values: Array
    pitch: float

    @classmethod
    def read(cls, path: str | Path) -> Kernel:
        """Kernel of an image file of this package with `pixel_pitch` in its metadata, or a FITS file with XPIXSZ.

        Raises
        ------
        DetectorError : the file cannot be read, does not state its pitch, or has values that are negative or NaN.
        BackendError : a package that reads the file is not installed.
        """
        path = Path(path).absolute()
        thing = f"detector: 'psf' = '{path}'"
        if not path.is_file():
            raise DetectorError(f"{thing} does not exist. Give an image file with its 'pixel_pitch'.")
        values, pitch = _content(path, thing)
        if pitch is None or not 0 < pitch < math.inf:
            raise DetectorError(
                f"{thing} does not state its pitch. Write it with "
                "fspt.Image(kernel, metadata={'pixel_pitch': 0.0135}), in mm."
            )
        if values.ndim != 2 or values.dtype.kind not in "uif":
            raise DetectorError(f"{thing} must be numbers of shape (h, w), got {values.dtype} of {values.shape}.")
        plane = values.astype(np.float64)
        if not (np.isfinite(plane).all() and (plane >= 0).all() and plane.sum() > 0):
            raise DetectorError(
                f"{thing} must be finite and >= 0, and not 0 everywhere, got {plane.min():g} … {plane.max():g}. "
                "Subtract the background, and set what is negative to 0."
            )
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]
        return cls(str(path), digest, plane / plane.sum(), float(pitch))

    def on(self, pitch: float) -> Array:
        """The kernel on pixels of `pitch` [mm], odd numbers of them, of sum 1.

        The light of a pixel is spread from all of it, as for pixels that are binned. A kernel of the same pitch with
        odd sides stays as it is.
        """
        rows, columns = (_weights(n, self.pitch, pitch) for n in self.values.shape)
        return rows @ self.values @ columns.T


def _content(path: Path, thing: str) -> tuple[NDArray[Any], float | None]:
    """Values and pitch [mm] of a kernel's file."""
    try:
        planes, metadata = read_planes(path)
        pitch = recorded_positive(metadata, "pixel_pitch", thing, DetectorError)
        return next(iter(planes.values())), pitch
    except BackendError:
        raise
    except ImageError as cause:
        if path.suffix.lower() not in FITS:
            raise DetectorError(f"{thing}: {cause}") from cause
    try:
        values, header = read_frame(path, thing)  # a FITS file of another program
    except BackendError:
        raise
    except FsptError as cause:
        raise DetectorError(str(cause)) from cause
    tell_open_rows(thing, header.get("top_row", FIRST))
    if "pixel_sides" in header:
        raise DetectorError(f"{thing}: has pixels of {shown_sides(header['pixel_sides'])}. Give square pixels.")
    return values, header.get("pixel_pitch")


def _weights(count: int, cell: float, pixel: float) -> Array:
    """Share of each of `count` cells [mm] along an axis that falls on each pixel [mm], (odd, count); columns sum to 1.

    The light starts anywhere on a pixel, which gives the hat function of the distance; a cell larger than a pixel is
    spread over what it has more.
    """
    centres = (np.arange(count) - (count - 1) / 2) * cell
    spread = max(cell - pixel, 0.0) * ((np.arange(POINTS) + 0.5) / POINTS - 0.5)
    reach = math.ceil((np.abs(centres).max() + np.abs(spread).max()) / pixel - 1e-9)
    pixels = np.arange(-reach, reach + 1)
    distance = (centres[:, None] + spread) / pixel - pixels[:, None, None]
    shares: Array = np.maximum(1 - np.abs(distance), 0).mean(axis=-1)
    return shares / shares.sum(axis=0)


@dataclass(frozen=True, eq=False)
class StrayLight:
    """What spreads light over the film: a kernel or None, and the share `glare` of the veiling glare."""

    kernel: Kernel | None
    glare: float

    def __bool__(self) -> bool:
        return self.kernel is not None or self.glare > 0

    def same(self, other: StrayLight) -> bool:
        """True if both have the same kernel, by its digest, and the same glare."""
        mine, theirs = (None if one.kernel is None else one.kernel.digest for one in (self, other))
        return mine == theirs and self.glare == other.glare

    def on(self, pitch: float | None) -> Spread:
        """The stray light on pixels of `pitch` [mm]; DetectorError for a kernel without it."""
        if self.kernel is None:
            return Spread(None, self.glare)
        if pitch is None:
            raise DetectorError(
                "detector: 'psf' needs the image's 'pixel_pitch', which its metadata do not have. Give it, in mm: "
                "fspt.Image(power, metadata={'pixel_pitch': 0.0135})."
            )
        return Spread(self.kernel.on(pitch), self.glare)

    def recorded(self, shape: tuple[int, int]) -> Metadata:
        """Entries of the metadata of an image (h, w) that has this stray light."""
        found: Metadata = {}
        if self.kernel is not None:
            found |= {PSF: self.kernel.path, PSF_DIGEST: self.kernel.digest}
        return found | ({GLARE: self.glare, FILM: f"{shape[1]} x {shape[0]}"} if self.glare else {})

    @classmethod
    def of(cls, metadata: Mapping[str, Any], shape: tuple[int, int]) -> StrayLight:
        """Stray light that an image (h, w) with these metadata has.

        Raises
        ------
        DetectorError : its kernel cannot be read or has changed, or the image is only a part of the film over which the
            glare was spread.
        """
        kernel, glare = None, recorded_number(metadata, GLARE, 0.0, "detector: the image", DetectorError)
        if PSF in metadata:
            kernel = Kernel.read(str(metadata[PSF]))
            if kernel.digest != metadata.get(PSF_DIGEST):
                raise DetectorError(
                    f"detector: 'psf' = '{kernel.path}' is not the kernel of the image, its digest is {kernel.digest}, "
                    f"not {metadata.get(PSF_DIGEST)}. Restore that file, or reduce the counts again."
                )
        if not 0 <= glare < 1:
            raise DetectorError(f"detector: '{GLARE}' of the image must be in [0, 1), got {glare:g}. Reduce it again.")
        if glare and metadata.get(FILM) != f"{shape[1]} x {shape[0]}":
            raise DetectorError(
                f"detector: the image of {shape[1]} x {shape[0]} pixels is a part of the film, {metadata.get(FILM)}, "
                "over which its glare is spread. Give the whole image."
            )
        return cls(kernel, glare)


@dataclass(frozen=True, eq=False)
class Spread:
    """Stray light on given pixels: linear maps of images (…, h, w); `kernel` of odd sides, or None."""

    kernel: Array | None
    glare: float

    def forward(self, images: Array) -> Array:
        """Images with the stray light (Eq. M.38)."""
        return self._mixed(self._convolved(images, self.kernel), images)

    def backward(self, images: Array) -> Array:
        """The transpose: each pixel gathers from where its light goes."""
        return self._mixed(self._convolved(images, None if self.kernel is None else self.kernel[::-1, ::-1]), images)

    def _mixed(self, spread: Array, images: Array) -> Array:
        """(1 − g) · `spread` + g · the mean of `images`."""
        if not self.glare:
            return spread
        return (1 - self.glare) * spread + self.glare * images.mean(axis=(-2, -1), keepdims=True)

    @staticmethod
    def _convolved(images: Array, kernel: Array | None) -> Array:
        """Images convolved with a kernel, dark beyond the film."""
        if kernel is None:
            return images
        planes = images.reshape(-1, *images.shape[-2:])
        height, width = planes.shape[1:]
        top, left = (n // 2 for n in kernel.shape)
        whole = np.stack([convolve(plane, kernel, mode="full") for plane in planes])
        return whole[:, top : top + height, left : left + width].reshape(images.shape)
