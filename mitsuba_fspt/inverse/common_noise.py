"""Noise that images have in common: of the response of a detector's pixels, of a frame subtracted from all of them.

With the standard deviation a_i of such a part, two images i, j of one physical pixel have the covariance a_i a_j.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class CommonNoise:
    """One part of the noise of N pixels.

    deviation : (N,) its standard deviation [W]
    origin : (N,) number of the detector, or of the subtracted frame
    pixel : (N,) number of the pixel on the film
    """

    deviation: Array
    origin: Index
    pixel: Index

    @cached_property
    def shared(self) -> Index:
        """(N,) number from 0, the same for the same pixel of one origin."""
        _, origin = np.unique(self.origin, return_inverse=True)
        _, pixel = np.unique(self.pixel, return_inverse=True)
        return np.unique(origin * (pixel.max(initial=0) + 1) + pixel, return_inverse=True)[1].astype(np.int64)


def joined(bands: Sequence[Sequence[CommonNoise]]) -> list[CommonNoise]:
    """The parts of several bands, which come in the same order, their pixels one after the other."""
    return [
        CommonNoise(
            *(np.concatenate([getattr(one, name) for one in parts]) for name in ("deviation", "origin", "pixel"))
        )
        for parts in zip(*bands, strict=True)
    ]


def beyond_independent(parts: Sequence[CommonNoise], estimate: Array) -> Array:
    """(k, k) covariance of results by noise in common, less that by as much noise that is independent.

    estimate : (N, k) change of the results by each pixel [1/W]
    """
    extra = np.zeros((estimate.shape[1], estimate.shape[1]))
    for part in parts:
        if part.deviation.any():
            change = estimate * part.deviation[:, None]
            sums = np.zeros((part.shared.max() + 1, change.shape[1]))
            np.add.at(sums, part.shared, change)
            extra += sums.T @ sums - change.T @ change
    return extra


def squared_correlations(parts: Sequence[CommonNoise], sigma: Array) -> float:
    """Sum over all ordered pairs of pixels of (covariance/(σσ'))²; σ (N,) [W]."""
    found = 0.0
    for k, one in enumerate(parts):
        for other in parts[: k + 1]:
            both = one.deviation * other.deviation / sigma**2
            if not both.any():
                continue
            pairs = (
                one.shared
                if other is one
                else np.unique(np.stack([one.shared, other.shared]), axis=1, return_inverse=True)[1].ravel()
            )
            sums = np.bincount(pairs, both)
            found += (1 if other is one else 2) * float(sums @ sums - both @ both)
    return found
