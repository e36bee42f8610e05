"""Problem and fit of `invert` as the files below it see them, which judge a fit."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..runtime.progress_bar import Progress
from .fit_settings import Settings
from .measurement import Measurement
from .nonnegative import Solve
from .surface import Surface
from .transport_matrix import TransportMatrix

Array = NDArray[np.float64]


class Fit(Protocol):
    """Members of `invert.Fit`, which describes them."""

    @property
    def x(self) -> Array: ...

    @property
    def sigma(self) -> Array: ...

    @property
    def numerical(self) -> Array: ...

    @property
    def correction(self) -> Array: ...

    @property
    def weight(self) -> float: ...

    @property
    def determined(self) -> float: ...

    @property
    def converged(self) -> bool: ...


class Problem(Protocol):
    """Members of `invert.Problem`, which describes them."""

    @property
    def matrix(self) -> TransportMatrix: ...

    @property
    def measurement(self) -> Measurement: ...

    @property
    def rows(self) -> NDArray[np.int64]: ...

    @property
    def bounds(self) -> NDArray[np.bool_]: ...

    @property
    def settings(self) -> Settings: ...

    def free_on(self, surface: Surface, /) -> Problem: ...

    def fit(self, weight: float | None, report: Progress, /, *, rough: bool) -> Fit: ...

    def signal(self, x: Array, /) -> Array: ...

    def design(self, x: Array, /) -> csr_array: ...

    def hessian(self, design: csr_array, sigma: Array, weight: float, /) -> csr_array: ...

    def normal(self, design: csr_array, sigma: Array, weight: float, /) -> tuple[csr_array, Solve]: ...

    def between(self, x: Array, /) -> tuple[Array, float]: ...
