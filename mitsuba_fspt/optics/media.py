"""Optical coefficients of tissue, and isotropic light sources in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..runtime.errors import FluxError
from .shapes import Shape

LARGEST = 1e6  # 1/mm: a mean free path of 1 nm, far below a wavelength
MOST_FORWARD = 0.99  # largest anisotropy
LARGEST_POWER = 1e30  # W
# µs' [1/mm] above that of soft tissue in light of 500 nm and more: skin has 4.6 at 500 nm, other tissues less (S. L.
# Jacques, Phys. Med. Biol. 58, R37 (2013), table 1). Tables in 1/cm give numbers ten times as large.
UNUSUAL_SCATTERING = 5.0


@dataclass(frozen=True)
class Medium:
    """Absorption `mua` >= 0, reduced scattering `musp` > 0 [1/mm], both <= 1e6; relative refractive index `n` >= 1.

    g : anisotropy of the scattering in [0, 0.99], of the phase function of Henyey and Greenstein; µs = µs'/(1 - g). SP3
        depends on it, diffusion does not

    Raises
    ------
    FluxError : a number is out of its range.
    """

    mua: float
    musp: float
    n: float = 1.37
    g: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.mua <= LARGEST:
            raise FluxError(f"medium: 'mua' must be >= 0 and at most {LARGEST:g}, got {self.mua:g}. Give 1/mm.")
        if not 0 < self.musp <= LARGEST:
            raise FluxError(
                f"medium: 'musp' must be > 0 and at most {LARGEST:g}, got {self.musp:g}. Give 1/mm; diffusion needs "
                "scattering."
            )
        if not (math.isfinite(self.n) and self.n >= 1):
            raise FluxError(f"medium: 'n' must be >= 1 and finite, got {self.n:g}. Give for example 1.37.")
        if not 0 <= self.g <= MOST_FORWARD:
            raise FluxError(f"medium: 'g' must be in [0, {MOST_FORWARD:g}], got {self.g:g}. Give for example 0.9.")

    @property
    def diffusion(self) -> float:
        """D = 1/(3 (µa + µs')) [mm]."""
        return 1 / (3 * (self.mua + self.musp))


def scattering_warning(media: Sequence[Medium]) -> str | None:
    """Warning of a reduced scattering that no soft tissue has, with the number if it is in 1/cm; None for others."""
    musp = max(medium.musp for medium in media)
    if musp <= UNUSUAL_SCATTERING:
        return None
    return (
        f"'musp' = {musp:g} 1/mm is more than soft tissue has from 500 nm on, up to {UNUSUAL_SCATTERING:g} 1/mm. If "
        f"the coefficients are in 1/cm, give a tenth of each, 'musp' = {musp / 10:g}."
    )


@dataclass(frozen=True)
class Source:
    """Isotropic light source of `power` [W] > 0 and <= 1e30, distributed uniformly over the `shape`.

    Raises
    ------
    FluxError : the power is not positive, or above 1e30.
    """

    shape: Shape
    power: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= LARGEST_POWER:
            raise FluxError(f"source: 'power' must be > 0 and at most {LARGEST_POWER:g}, got {self.power:g}. Give W.")
