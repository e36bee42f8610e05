"""Noise that several images have in common: by the response of a detector's pixels, or by one subtracted frame.

With the standard deviation a_i of such a part, two images i, j of one physical pixel have the covariance a_i a_j (Eq.
M.54). The response counts as the same at all wavelengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

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
        return _numbered(self.origin, self.pixel)

    @cached_property
    def is_shared(self) -> bool:
        """True where it is noise, of pixels of which some are the same."""
        return bool(self.deviation.any()) and int(self.shared.max()) + 1 < len(self.shared)

    def of(self, deviation: Array) -> CommonNoise:
        """Noise of the same pixels with this standard deviation (N,) [W]; `shared` is computed once for all of them."""
        found = replace(self, deviation=deviation)
        if deviation.any():
            vars(found)["shared"] = self.shared
        return found


def _numbered(one: Index, other: Index) -> Index:
    """(N,) number from 0 of each pair of integers, from one integer: NumPy sorts pairs several times longer."""
    firsts = np.unique(one)
    least, most = (int(end) for end in (other.min(initial=0), other.max(initial=0)))
    if len(firsts) * (most - least + 1) >= 1 << 63:
        other = np.unique(other, return_inverse=True)[1].astype(np.int64)
        least, most = 0, int(other.max(initial=0))
    key = np.searchsorted(firsts, one) * (most - least + 1) + other - least
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def joined(bands: Sequence[Sequence[CommonNoise]]) -> list[CommonNoise]:
    """The parts of several bands, which come in the same order, their pixels one after the other."""
    if len(bands) == 1:
        return list(bands[0])
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
        if part.is_shared:
            change = estimate * part.deviation[:, None]
            sums = csr_array((np.ones(len(change)), (part.shared, np.arange(len(change))))) @ change
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
            pairs = one.shared if other is one else _numbered(one.shared, other.shared)
            sums = np.bincount(pairs, both)
            found += (1 if other is one else 2) * float(sums @ sums - both @ both)
    return found
