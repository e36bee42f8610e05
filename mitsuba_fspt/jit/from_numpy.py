"""NumPy values as arrays of Dr.Jit that its kernels can read.

Dr.Jit uses the memory of a NumPy array where it is, and its kernels read whole packets of entries, beyond the last one
(Dr.Jit 1.5, LLVM). Where that memory ends with a page and the length is no multiple of a packet, the process ends by a
segmentation fault.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

PACKET = 16  # entries that a kernel reads at once, at the most (AVX-512)
DTYPES = {
    dr.VarType.Bool: np.bool_,
    dr.VarType.Int32: np.int32,
    dr.VarType.UInt32: np.uint32,
    dr.VarType.Int64: np.int64,
    dr.VarType.UInt64: np.uint64,
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
}


def from_numpy(kind: type, values: ArrayLike) -> Any:
    """Array of Dr.Jit of a flat `kind`, such as `mi.Float`, with these values row by row, and a packet behind them.

    ValueError for masked values, which Dr.Jit would take as numbers.
    """
    if np.ma.is_masked(values):
        raise ValueError("from_numpy: the array has masked values. Give numbers for them, as by values.filled(0).")
    flat = np.ravel(values)
    own = np.zeros(len(flat) + PACKET, DTYPES[dr.type_v(kind)])
    own[: len(flat)] = flat
    return kind(own[: len(flat)])
