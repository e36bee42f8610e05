"""Optical coefficients of tissue from its composition at a wavelength, by published tables (Eq. M.46).

    µa = B (S µ_oxy + (1 - S) µ_deoxy) + W µ_water + F µ_fat,   µ_oxy, µ_deoxy = ln 10 ε c,   µs' = s (λ/600 nm)^-b

The files of `absorbers/` state their units and sources; docs/phantom-file.md compares them with other measurements.
S. L. Jacques, Optical properties of biological tissues: a review, Phys. Med. Biol. 58, R37 (2013).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np

from ..optics.curve_file import Curve, ascending_curve
from ..runtime.errors import FluxError

FOLDER = Path(__file__).parent / "absorbers"
HAEMOGLOBIN = 150 / 64500  # mol/l of haemoglobin in whole blood: 150 g/l, 64500 g/mol, as of the table
PER_MM = {  # 1/mm for the unit of each file; a decadic extinction times ln 10 is an absorption coefficient
    "oxyhaemoglobin": math.log(10) * HAEMOGLOBIN / 10,
    "deoxyhaemoglobin": math.log(10) * HAEMOGLOBIN / 10,
    "water": 1 / 10,
    "fat": 1 / 1000,
}
REFERENCE = 600.0  # nm, of `scattering`
RAYLEIGH = 4.0  # power of the scattering by particles far smaller than the wavelength, the largest there is


@dataclass(frozen=True)
class Absorbers:
    """Shares of a tissue's volume in [0, 1]: `blood` of 150 g/l haemoglobin, `water` with that of the blood, `fat`.

    saturation : share of the haemoglobin that has bound oxygen, in [0, 1]; needed with blood

    Raises
    ------
    FluxError : a share is outside [0, 1], water and fat exceed 1 together, or blood has no saturation.
    """

    blood: float = 0.0
    saturation: float | None = None
    water: float = 0.0
    fat: float = 0.0

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if value is not None and not 0 <= value <= 1:
                raise FluxError(f"'{one.name}' must be in [0, 1], got {value:g}. Give a share, for example 0.05.")
        if self.water + self.fat > 1:
            raise FluxError(f"'water' + 'fat' must be at most 1, got {self.water + self.fat:g}. Give shares of volume.")
        if self.blood > 0 and self.saturation is None:
            raise FluxError("'saturation' is missing. Give the share of oxyhaemoglobin in the blood, for example 0.7.")

    def mua(self, wavelength_nm: float) -> float:
        """Absorption coefficient [1/mm] (Eq. M.46).

        Raises
        ------
        FluxError : a table of an absorber with a share > 0 does not contain the wavelength.
        """
        bound = 0.0 if self.saturation is None else self.saturation
        shares: Mapping[str, float] = {
            "oxyhaemoglobin": self.blood * bound,
            "deoxyhaemoglobin": self.blood * (1 - bound),
            "water": self.water,
            "fat": self.fat,
        }
        return sum(share * absorption(name, wavelength_nm) for name, share in shares.items() if share > 0)


def absorption(absorber: str, wavelength_nm: float) -> float:
    """Absorption coefficient of a pure absorber [1/mm], linear between the rows of its table.

    absorber : "oxyhaemoglobin" or "deoxyhaemoglobin", whole blood of 150 g/l with nothing else; "water"; "fat"

    Raises
    ------
    FluxError : no such absorber, or a wavelength outside its table.
    """
    if absorber not in PER_MM:
        raise FluxError(f"absorber '{absorber}' is unknown. Give one of {', '.join(PER_MM)}.")
    curve = _table(absorber)
    first, last = curve.wavelengths[[0, -1]]
    if not curve.covers(wavelength_nm, wavelength_nm):
        raise FluxError(
            f"'wavelength_nm' must be in {first:g} … {last:g} for the table of {absorber}, got {wavelength_nm:g}. "
            "Give 'mua' for other wavelengths."
        )
    return PER_MM[absorber] * float(curve.on(np.array([wavelength_nm]))[0])


def reduced_scattering(scattering: float, scattering_power: float, wavelength_nm: float) -> float:
    """µs' [1/mm] of tissue that has `scattering` [1/mm] at 600 nm, by a power law (Eq. M.46).

    Raises
    ------
    FluxError : `scattering` <= 0, or `scattering_power` outside [0, 4].
    """
    if not (scattering > 0 and math.isfinite(scattering)):
        raise FluxError(f"'scattering' must be > 0 and finite, got {scattering:g}. Give µs' at 600 nm in 1/mm.")
    if not 0 <= scattering_power <= RAYLEIGH:
        raise FluxError(
            f"'scattering_power' must be in [0, 4], got {scattering_power:g}. Give b > 0 where µs' falls with the "
            "wavelength; 4 is Rayleigh's."
        )
    return scattering * (wavelength_nm / REFERENCE) ** -scattering_power


@cache
def _table(absorber: str) -> Curve:
    """Curve of an absorber's file, in the unit of the file."""
    return ascending_curve(FOLDER / f"{absorber}.csv", absorber, FluxError, "value", "600,3200", math.inf)
