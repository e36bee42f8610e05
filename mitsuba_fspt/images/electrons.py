"""Data of one read-out of a detector: electrons and counts of every pixel, and metadata."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .formats import Metadata


@dataclass(frozen=True, eq=False)
class Electrons:
    """Planes and metadata of a read-out, as `Exposure` describes them; `Exposure` adds pictures and files."""

    electrons: NDArray[np.float32]
    counts: NDArray[np.uint16]
    metadata: Metadata

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width (h, w) [pixels]."""
        return self.electrons.shape  # type: ignore[return-value]

    @property
    def total(self) -> float:
        """Sum over all pixels [e-]."""
        return float(self.electrons.sum(dtype=np.float64))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[np.floating]:
        """The electrons, shape (h, w) [e-], for `np.asarray(exposure)`."""
        return np.array(self.electrons, dtype=dtype, copy=copy)  # None: if needed
