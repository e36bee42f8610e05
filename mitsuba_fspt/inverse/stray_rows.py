"""Rows of a transport matrix, spread over the pixels of their view by the stray light of a detector (Eq. M.38)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..detector.stray_light import Spread
from ..runtime.errors import TransportError
from ..runtime.memory import available_memory

Array = NDArray[np.float64]
BYTES = 16  # of an entry of a sparse matrix while it is made, at the least


def spread_rows(spread: Spread, rows: csr_array, shape: tuple[int, int]) -> csr_array:
    """Rows (h · w, n) of a view, spread over its pixels (h, w); TransportError if the memory does not suffice."""
    found = rows
    if spread.kernel is not None:
        _require_memory(int(np.count_nonzero(spread.kernel)) * max(rows.nnz, rows.shape[0]) // 4)
        found = csr_array(_convolution(spread.kernel, shape) @ rows)
    if not spread.glare:
        return found
    _require_memory(rows.shape[0] * int(np.count_nonzero(rows.sum(axis=0))))
    even = csr_array(np.asarray(rows.sum(axis=0))[None] / rows.shape[0])
    everywhere = csr_array(np.ones((rows.shape[0], 1)))
    return csr_array((1 - spread.glare) * found + spread.glare * (everywhere @ even))


def _require_memory(entries: int) -> None:
    """Raise TransportError for more entries than the memory holds."""
    free = available_memory()
    if free is not None and BYTES * entries > free:
        raise TransportError(
            f"transport: the matrix behind the detector has some {entries:.2g} entries, more than the memory of "
            f"{free / 1e9:.2g} GB holds. Use its products, T @ J and T.T @ P, a smaller kernel or fewer pixels."
        )


def _convolution(kernel: Array, shape: tuple[int, int]) -> csr_array:
    """Convolution of an image (h, w) with a kernel of odd sides as a sparse matrix (h · w, h · w)."""
    height, width = shape
    rows, columns, values = [], list[NDArray[Any]](), list[Array]()
    pixels = np.arange(height * width).reshape(shape)
    top, left = (n // 2 for n in kernel.shape)
    for (i, j), share in np.ndenumerate(kernel):
        down, right = i - top, j - left
        if share == 0 or abs(down) >= height or abs(right) >= width:
            continue
        source = pixels[max(0, -down) : height - max(0, down), max(0, -right) : width - max(0, right)]
        target = pixels[max(0, down) : height - max(0, -down), max(0, right) : width - max(0, -right)]
        rows.append(target.ravel())
        columns.append(source.ravel())
        values.append(np.full(source.size, share))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csr_array(entries, shape=(height * width, height * width))
