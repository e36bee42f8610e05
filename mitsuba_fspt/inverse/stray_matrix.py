"""The transport matrix behind the stray light of a detector: S T, with the kernel and the glare of Eq. M.38."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack

from ..detector.stray_light import Spread, StrayLight
from ..runtime.errors import TransportError
from ..runtime.memory import available_memory
from .transport_matrix import TransportMatrix

if TYPE_CHECKING:
    import os

Array = NDArray[np.float64]
BYTES = 16  # of an entry of a sparse matrix while it is made, at the least


class StrayMatrix(TransportMatrix):
    """T behind the point-spread function and the veiling glare of a detector, as `TransportMatrix.through` makes it.

    Its interface is that of T. The products spread images and their transpose; `matrix` has all entries, of which a
    glare fills every row. `base` is T, `stray` the stray light; the metadata record it.
    """

    def __init__(self, base: TransportMatrix, stray: StrayLight) -> None:
        self.base, self.stray = base, stray
        self.spreads = [stray.on(float(lens["pixel_pitch"])) for lens in base.metadata["lenses"]]
        metadata = base.metadata | stray.recorded(base.image_shape[1:])
        lit = np.stack([spread.backward(np.ones(base.image_shape[1:])) for spread in self.spreads])
        super().__init__(base.blocks, metadata, base.areas, base.rmatvec(lit.ravel()))

    @cached_property
    def matrix(self) -> csr_array:
        """All views as one sparse matrix, (views · height · width, n).

        Raises TransportError if the memory does not suffice.
        """
        shape = self.image_shape[1:]
        views = zip(self.spreads, self.blocks, strict=True)
        return csr_array(vstack([spread_rows(spread, block.matrix, shape) for spread, block in views], format="csr"))

    @property
    def entries(self) -> int:
        """Number of entries that are not 0."""
        return int(self.matrix.nnz)

    def error(self, exitance: ArrayLike) -> Array:
        """Estimated absolute error of `forward(exitance)`, (views, height, width) [W]: that of T, spread likewise."""
        return self._spread(self.base.error(exitance))

    def through(self, detector: object) -> TransportMatrix:
        """TransportError: the stray light of a detector is applied once."""
        raise TransportError(
            "transport: the matrix has the stray light of a detector already. Apply 'through' to the matrix without it."
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """TransportError: the file is that of T."""
        raise TransportError(
            f"transport: '{Path(path)}' is not written: a matrix behind a detector is not stored. Save the matrix "
            "itself, and apply 'through' to what 'read_transport' returns."
        )

    # ------------------------------------------------------------------ SciPy's interface

    def _matvec(self, x: Array) -> Array:
        return self._spread(self.base.forward(np.ravel(x))).ravel()

    def _rmatvec(self, x: Array) -> Array:
        return self.base.rmatvec(self._gathered(self._finite_images(x)).ravel())

    def _matmat(self, x: Array) -> Array:
        return np.stack([self._matvec(column) for column in np.asarray(x, np.float64).T], axis=1)

    def _rmatmat(self, x: Array) -> Array:
        return np.stack([self._rmatvec(column) for column in np.asarray(x, np.float64).T], axis=1)

    def _finite_images(self, x: Array) -> Array:
        """A vector of all pixels as images (views, height, width); TransportError for values that are not finite."""
        return self.images(np.asarray(x, np.float64).reshape(self.image_shape))

    def _spread(self, images: Array) -> Array:
        return np.stack([spread.forward(image) for spread, image in zip(self.spreads, images, strict=True)])

    def _gathered(self, images: Array) -> Array:
        return np.stack([spread.backward(image) for spread, image in zip(self.spreads, images, strict=True)])

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, behind stray light)"


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


def stray_light_of(matrix: TransportMatrix, images: Sequence[Any], verb: str) -> StrayLight:
    """The stray light that the images of all views have, by their metadata or by that of the matrix.

    Raises
    ------
    TransportError : images, or images and the matrix, have different ones.
    DetectorError : as `StrayLight.of`.
    """
    from ..images.image import Image

    own = matrix.stray if isinstance(matrix, StrayMatrix) else StrayLight(None, 0.0)
    found = [StrayLight.of(image.metadata, image.shape) for image in images if isinstance(image, Image)]
    for number, one in enumerate(found):
        if not one.same(found[0]):
            raise TransportError(
                f"{verb}: image {number} has other stray light than image 0, 'psf' or 'veiling_glare' of its metadata. "
                "Give images of one detector."
            )
    if not found or not found[0]:
        return own
    if own and not own.same(found[0]):
        raise TransportError(
            f"{verb}: the images have other stray light than the detector of 'through'. Give the matrix without it: "
            "the images say which they have."
        )
    return found[0]


def without_glare_of(matrix: TransportMatrix, stray: StrayLight) -> TransportMatrix:
    """T behind the kernel of the stray light alone: the matrix of images of which the glare was taken."""
    base = matrix.base if isinstance(matrix, StrayMatrix) else matrix
    return base if stray.kernel is None else StrayMatrix(base, StrayLight(stray.kernel, 0.0))
