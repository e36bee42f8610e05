"""Uncertain factors of the views, normal about 1, which are fitted together with J_n (Eq. M.35 of docs/model.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..images.image import Image
from ..images.recorded_number import recorded_number
from ..runtime.errors import InversionError
from ..runtime.numbers import number

Array = NDArray[np.float64]


def gain_error_of(images: Sequence[Image], verb: str) -> float:
    """Largest `gain_error` of the images' metadata, 0 without one; InversionError where it is outside [0, 1)."""
    each = [
        recorded_number(image.metadata, "gain_error", 0.0, f"{verb}: image {k}", InversionError)
        for k, image in enumerate(images)
    ]
    for k, found in enumerate(each):
        if not 0 <= found < 1:
            raise InversionError(
                f"{verb}: image {k}, 'gain_error' must be in [0, 1), got {found:g}. Give for example 0.05."
            )
    return max(each, default=0.0)


def checked_factor(verb: str, value: object) -> float:
    """δ, a relative standard deviation in [0, 1); raises InversionError in the name of `verb`."""
    found = number(f"{verb}: 'gain_per_view'", value, InversionError, "0.05")
    if not 0 <= found < 1:
        raise InversionError(f"{verb}: 'gain_per_view' must be in [0, 1), got {found:g}. Give for example 0.05.")
    return found


@dataclass(frozen=True, eq=False)
class ViewFactors:
    """Factors of views: their ratios as unknowns g of unit variance, and what they have in common.

    No image separates a factor common to all views from a factor of J_n; only the penalty, lower for smaller J_n,
    would determine it. The V − 1 unknowns are therefore those of f = 1 + δ E g, with orthonormal columns E whose sums
    over the views are 0.

    sd : δ, relative standard deviation of the factor of each view; 0: no unknowns
    view : (N,) number of the view of each pixel;  views : their number V
    """

    sd: float
    view: NDArray[np.int64]
    views: int

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self.views - 1 if self.sd else 0

    @property
    def common(self) -> float:
        """Standard deviation of the mean of the factors, δ/√V."""
        return float(self.sd / self.views**0.5)

    @cached_property
    def basis(self) -> Array:
        """(V, count) orthonormal columns E, whose sums over the views are 0."""
        return np.linalg.qr(np.column_stack([np.ones(self.views), np.eye(self.views)[:, 1:]]))[0][:, 1:][
            :, : self.count
        ]

    def columns(self, signal: Array) -> csr_array:
        """(N, count) change of the power [W] with each unknown, for a signal (N,) [W] of factors 1."""
        return csr_array(self.sd * signal[:, None] * self.basis[self.view])

    def of(self, unknowns: Array) -> Array:
        """(V, …) factors for the unknowns g (count, …)."""
        return np.asarray(1 + self.sd * np.tensordot(self.basis, unknowns, 1))


@dataclass(frozen=True, eq=False)
class PixelNoise:
    """Noise of pixels that are fitted, with what they have in common: covariance σ (I + Σ_k q_k q_kᵀ) σ.

    The q_k are the columns of the views' factors, and `others`.

    sigma : (N,) σ [W]
    common : (N,) q, change over σ of each pixel by one standard deviation of its view's factor; 0 without factors
    view : (N,) number of the view of each pixel
    others : (N, P) change over σ of each pixel by one standard deviation of other uncertain numbers
    """

    sigma: Array
    common: Array
    view: NDArray[np.int64]
    others: Array | None = None

    @cached_property
    def squares(self) -> Array:
        """(views,) |q_v|²."""
        return np.bincount(self.view, self.common**2).astype(np.float64)

    @cached_property
    def all_columns(self) -> Array:
        """(N, views + P) the columns of the views, if they have factors, and the others."""
        others = np.empty((len(self.view), 0)) if self.others is None else self.others
        return np.column_stack([self.columns.toarray(), others]) if self.common.any() else others

    @cached_property
    def _directions(self) -> tuple[Array, Array]:
        """Orthonormal columns U (N, k) and squares s² (k,) with Σ q qᵀ = U s² Uᵀ."""
        left, singular, _ = np.linalg.svd(self.all_columns, full_matrices=False)
        return left, singular**2

    @cached_property
    def columns(self) -> csr_array:
        """(N, views) q_v."""
        entries = self.common, (np.arange(len(self.view)), self.view)
        return csr_array(entries, shape=(len(self.view), len(self.squares)))

    def over(self, values: Array) -> Array:
        """`values` (N, …) [W] over the root of the covariance: (I + q qᵀ)^-½ = I − (1 − (1 + |q|²)^-½) q qᵀ/|q|²."""
        over = (values.T / self.sigma).T
        if self.others is not None:
            left, squares = self._directions
            return np.asarray(over - left @ ((1 - (1 + squares) ** -0.5) * (left.T @ over).T).T)
        if not self.common.any():
            return np.asarray(over)
        share = (1 - (1 + self.squares) ** -0.5) / np.where(self.squares > 0, self.squares, 1.0)
        return np.asarray(over - self.columns @ (share * (self.columns.T @ over).T).T)

    def from_pixels(self, white: Array) -> Array:
        """(N, k) change by each pixel [1/W] of sums with the weights `white` (N, k) of what `over` gives."""
        return np.asarray((self.over((white.T * self.sigma).T).T / self.sigma).T)

    def unknowns(self, residual: Array) -> Array:
        """(views,) most likely g_v for residuals (N,) over σ."""
        return np.asarray((self.columns.T @ residual) / (1 + self.squares))

    def all_unknowns(self, residual: Array) -> Array:
        """(views + P,) most likely unknowns of `all_columns` for residuals (N,) over σ."""
        columns = self.all_columns
        return np.asarray(np.linalg.solve(columns.T @ columns + np.eye(columns.shape[1]), columns.T @ residual))

    @property
    def log_determinant(self) -> float:
        """ln of the determinant of the covariance, σ in W."""
        if self.others is not None:
            return float(2 * np.log(self.sigma).sum() + np.log1p(self._directions[1]).sum())
        return float(2 * np.log(self.sigma).sum() + np.log1p(self.squares).sum())
