"""What tissue does to light and where light comes from: media and sources."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import FluxError
from .shapes import Shape


@dataclass(frozen=True)
class Medium:
    """Absorption `mua` >= 0, reduced scattering `musp` > 0 [1/mm], relative refractive index `n` >= 1.

    Raises
    ------
    FluxError : a number is out of its range.
    """

    mua: float
    musp: float
    n: float = 1.37

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mua) and self.mua >= 0):
            raise FluxError(f"medium: 'mua' must be >= 0 and finite, got {self.mua:g}. Give 1/mm.")
        if not (math.isfinite(self.musp) and self.musp > 0):
            raise FluxError(
                f"medium: 'musp' must be > 0 and finite, got {self.musp:g}. Give 1/mm; diffusion needs scattering."
            )
        if not (math.isfinite(self.n) and self.n >= 1):
            raise FluxError(f"medium: 'n' must be >= 1 and finite, got {self.n:g}. Give for example 1.37.")

    @property
    def diffusion(self) -> float:
        """D = 1/(3 (µa + µs')) [mm]."""
        return 1 / (3 * (self.mua + self.musp))


@dataclass(frozen=True)
class Source:
    """Isotropic light of `power` [W] > 0, uniform over the `shape`.

    Raises
    ------
    FluxError : the power is not positive and finite.
    """

    shape: Shape
    power: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.power) and self.power > 0):
            raise FluxError(f"source: 'power' must be > 0 and finite, got {self.power:g}. Give W.")
