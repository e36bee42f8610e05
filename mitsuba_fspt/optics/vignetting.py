"""Vignetting as measured: the share of a pixel's light that passes beyond Eq. 9 (Eq. M.45), of a curve or an image.

Every pixel has one share, by which its power is multiplied whatever the method: of an image that of the pixel, of a
curve over the image height its mean over the pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import OpticsError

# Gauss nodes along each side of a pixel for the mean of a curve, as many as `WORK` evaluations allow: a kink of the
# curve in a pixel, where the error is largest, matters less the smaller the pixels are.
FEWEST_NODES, MOST_NODES, WORK = 2, 16, 1 << 22
VIGNETTING, DIGEST = "vignetting", "vignetting_digest"  # parameter of `fspt_lens`; entry of the metadata beside it
ROUNDING = 1e-6  # of a height, by which a curve may end before the corner of the film
BEST = 1.0 + 1e-6  # largest share; a file of single precision rounds

Plane = NDArray[np.float64]
Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Vignetting:
    """Shares of the light, of a file.

    file : its absolute name;  digest : first digits of its SHA-256
    heights : image heights of a curve, ascending from 0 (n,) [mm on the film]; None for an image
    shares : at these heights (n,), or on the pixels of the film (h, w), row 0 at the top
    crop : of an image of a crop window alone, width and height of the film and the window's first column and row

    Raises
    ------
    OpticsError : a share is not in (0, 1], heights do not ascend from 0, or an image is no plane.
    """

    file: str
    digest: str
    heights: Plane | None
    shares: Plane
    crop: tuple[Pair, Pair] | None = None
    _known: dict[object, Plane] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        thing = f"'vignetting' = '{self.file}'"
        if self.heights is not None:
            _check_heights(thing, self.heights)
        elif self.shares.ndim != 2 or self.shares.size == 0:
            raise OpticsError(f"{thing} must have the shape (h, w), got {self.shares.shape}. Give one plane.")
        wrong = ~((self.shares > 0) & (self.shares <= BEST))
        if wrong.any():
            index = np.argwhere(wrong)[0]
            place = f"row {index[0]}, column {index[1]}" if self.heights is None else f"{self.heights[index[0]]:g} mm"
            raise OpticsError(
                f"{thing}: a share must be > 0 and at most 1, got {self.shares[tuple(index)]:g} at {place}"
                f"{f' and {int(wrong.sum()) - 1} others' if wrong.sum() > 1 else ''}. Divide by the largest, or "
                "correct it."
            )

    def on_pixels(self, pitch: float, film: Pair, first: tuple[float, float], size: Pair, bins: int = 1) -> Plane:
        """Share of each pixel of a crop window, (h, w).

        pitch : side of a pixel [mm];  film, size : width and height of the film and of the window [pixels]
        first : column and row of the window's first pixel
        bins : pixels of an image along the side of one of these, which then has their mean

        Raises OpticsError where an image has other pixels than the film, or a curve ends inside the window.
        """
        state = (pitch, film, first, size, bins)
        if state not in self._known:
            self._known.clear()  # a slider passes many pitches
            shares = (
                self._of_image(film, first, size, bins)
                if self.heights is None
                else self._of_curve(self.heights, pitch, film, first, size)
            )
            self._known[state] = np.minimum(shares, 1.0)
            self._known[state].flags.writeable = False
        return self._known[state]

    def metadata(self) -> dict[str, str]:
        """Name and digest of the file, as an image's metadata have them."""
        return {VIGNETTING: self.file, DIGEST: self.digest}

    def _of_image(self, film: Pair, first: tuple[float, float], size: Pair, bins: int) -> Plane:
        """Shares of the pixels of a crop window, (h, w)."""
        height, width = self.shares.shape
        whole, corner = ((width, height), (0, 0)) if self.crop is None else self.crop
        if (film[0] * bins, film[1] * bins) != whole:
            raise OpticsError(
                f"'vignetting' = '{self.file}' has {whole[0]} × {whole[1]} pixels, the film {film[0] * bins} × "
                f"{film[1] * bins}. Give an image of the film's shape."
            )
        left, top = (round(start * bins) - its for start, its in zip(first, corner, strict=True))
        if left < 0 or top < 0 or left + size[0] * bins > width or top + size[1] * bins > height:
            raise OpticsError(
                f"'vignetting' = '{self.file}' is that of a crop window of {width} × {height} pixels at {corner[0]}, "
                f"{corner[1]}, outside which the scene's lies in part. Give that of the film."
            )
        part = self.shares[top : top + size[1] * bins, left : left + size[0] * bins]
        return part.reshape(size[1], bins, size[0], bins).mean(axis=(1, 3))

    def _of_curve(self, heights: Plane, pitch: float, film: Pair, first: tuple[float, float], size: Pair) -> Plane:
        """As `_of_image`, by the mean of the curve over each pixel."""
        nodes = int(np.clip(math.isqrt(WORK // math.prod(size)), FEWEST_NODES, MOST_NODES))
        node, weight = np.polynomial.legendre.leggauss(nodes)
        x, y = (
            pitch * (start + np.arange(count) + 0.5 - whole / 2)
            for start, count, whole in zip(first, size, film, strict=True)
        )
        corner = math.hypot(np.abs(x).max() + pitch / 2, np.abs(y).max() + pitch / 2)
        if corner > heights[-1] * (1 + ROUNDING):
            raise OpticsError(
                f"'vignetting' = '{self.file}' ends at an image height of {heights[-1]:g} mm, the film's corner lies "
                f"at {corner:.6g} mm. Give a curve up to there."
            )
        mean = np.zeros((len(y), len(x)))
        for step, a in zip(pitch / 2 * node, weight / 2, strict=True):
            for other, b in zip(pitch / 2 * node, weight / 2, strict=True):
                mean += a * b * np.interp(np.hypot(x[None, :] + step, y[:, None] + other), heights, self.shares)
        return mean


def _check_heights(thing: str, heights: Plane) -> None:
    """Raise OpticsError unless at least two image heights ascend from 0."""
    if len(heights) < 2:
        raise OpticsError(f"{thing} has one row. Give at least two, between which the curve is linear.")
    if not np.isfinite(heights).all() or (np.diff(heights) <= 0).any():
        steps = np.flatnonzero(~(np.diff(heights) > 0))
        at = heights[steps[0] + 1] if steps.size else np.nan
        row = steps[0] + 2 if steps.size else 1
        raise OpticsError(f"{thing}: the image heights must ascend, got {at:g} mm in row {row}. Sort the rows.")
    if heights[0] != 0:
        raise OpticsError(f"{thing} begins at an image height of {heights[0]:g} mm. Give a first row of 0 mm.")
