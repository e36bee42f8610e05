"""Sparse rows of the transport matrix (Eq. M.20) of one view, with the estimated error of their product with J_n."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.sparse import csr_array

from ..quadrature import FLOAT32_FLOOR

SAFETY = 2.0  # error over the largest change of a pixel and its neighbours, of which one may be small by chance
NEIGHBOURS = 3  # pixels across that share their errors

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SparseRows:
    """Rows (h · w, n) of one view, those of the crop window's pixels of `shape` (h, w), row by row from the top left.

    count : number n of columns, those of one mesh after the other
    values : entries [mm²]
    columns, starts : their columns, and the first entry of each row, as in a csr_array
    change : by how much many more cells, pieces or lines of sight would change each entry, over the entry
    row_error : error of each row's sum [mm²], (h · w)
    """

    shape: tuple[int, int]
    count: int
    values: NDArray[np.float32]
    columns: NDArray[np.int32]
    starts: NDArray[np.integer]
    change: NDArray[np.float16]
    row_error: NDArray[np.float32]

    @cached_property
    def matrix(self) -> csr_array:
        """The rows in double precision."""
        return self._csr(self.values.astype(np.float64))

    def error(self, exitance: Array) -> Array:
        """Estimated error (h, w) [W] of `matrix @ exitance` (n,) [W/mm²]."""
        power = self.matrix @ exitance
        changed = self._csr(self.values * self.change.astype(np.float64)) @ exitance
        light, sums = self.matrix @ np.abs(exitance), self.matrix.sum(axis=1)
        mean = self._spread(np.divide(light, sums, out=np.zeros_like(light), where=sums > 0))
        least = FLOAT32_FLOOR * np.abs(power).max(initial=0.0) * (self._spread(np.abs(power)) > 0)
        return np.maximum(SAFETY * self._spread(np.abs(changed)) + self.row_error * mean, least).reshape(self.shape)

    @property
    def relative_row_error(self) -> Array:
        """`row_error` over the largest sum of a row, (h · w); 0 where nothing is seen."""
        counts = np.diff(self.starts)
        sums = np.zeros(len(counts))
        sums[counts > 0] = np.add.reduceat(self.values, self.starts[:-1][counts > 0], dtype=np.float64)
        return self.row_error / sums.max() if sums.any() else sums

    def _spread(self, values: Array) -> Array:
        """The largest value of each pixel and its neighbours, (h · w)."""
        return maximum_filter(values.reshape(self.shape), NEIGHBOURS).ravel()

    def _csr(self, values: NDArray[np.floating]) -> csr_array:
        return csr_array((values, self.columns, self.starts), shape=(len(self.starts) - 1, self.count))
