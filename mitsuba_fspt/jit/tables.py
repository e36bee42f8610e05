"""Tables of named columns that kernels read."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .from_numpy import from_numpy


class Table:
    """Columns of equally many numbers, read by their names; `columns` in their order.

    Kernels receive the numbers and their count as data, so that tables of all lengths use the same compiled kernels.
    """

    def __init__(self, columns: Mapping[str, NDArray[np.float64]]) -> None:
        self._numbers = {name: number for number, name in enumerate(columns)}
        self._values = from_numpy(mi.Float, np.concatenate(list(columns.values())))
        self.rows = dr.opaque(mi.UInt32, len(next(iter(columns.values()))))

    def gather(self, name: str, row: mi.UInt32) -> mi.Float:
        """Values of a column in these rows."""
        return dr.gather(mi.Float, self._values, self._numbers[name] * self.rows + row)

    def gather_either(self, which: mi.Bool, name: str, other: str, row: mi.UInt32) -> mi.Float:
        """Values of the column `name` where `which` is True, of the column `other` elsewhere."""
        number = dr.select(which, mi.UInt32(self._numbers[name]), self._numbers[other])
        return dr.gather(mi.Float, self._values, number * self.rows + row)
