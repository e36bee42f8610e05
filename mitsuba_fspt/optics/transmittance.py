"""Transmittance τ of a lens with its filters: one number, or a curve over the wavelength, read from a file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import OpticsError
from ..runtime.wavelength import wavelength as checked
from . import curve_file
from .light import SURFACE, Light

NUMBERS = ("transmittance", "wavelength_nm")  # of `fspt_lens`
CURVE, SPECTRUM = "transmittance_curve", "spectrum"  # names of its files


class Curve(curve_file.Curve):
    """Transmittance τ over the wavelength, in [0, 1], linear between the rows of a table."""

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Curve:
        """Curve from a CSV file with a wavelength [nm] and τ in each row, in any order. One title line and # comments
        are allowed.

        Raises
        ------
        OpticsError : the file cannot be read, or a row is no pair of numbers, is given twice or lies outside the range.
        """
        path = Path(path)
        wavelengths, values = curve_file.read_rows(path, CURVE, OpticsError, "nm, transmittance", "600,0.92")
        order = np.argsort(wavelengths)
        wavelengths, values = wavelengths[order], values[order]
        _check(path, wavelengths, values)
        curve_file.require_range(path, CURVE, wavelengths, OpticsError)
        return cls(str(path), wavelengths, values)

    def at(self, wavelength_nm: float) -> float:
        """τ at a wavelength [nm], by linear interpolation; OpticsError outside the curve."""
        first, last = self.wavelengths[[0, -1]]
        if not first <= wavelength_nm <= last:
            raise OpticsError(
                f"'wavelength_nm' = {wavelength_nm:g} is outside '{self.file}', which has {first:g} … {last:g} nm. "
                "Give another wavelength or curve."
            )
        return float(np.interp(wavelength_nm, self.wavelengths, self.values))


def _check(path: Path, wavelengths: NDArray[np.float64], values: NDArray[np.float64]) -> None:
    """Raise OpticsError for a wavelength that is not > 0 or occurs twice, and for a τ outside [0, 1]."""
    wrong = ~((wavelengths > 0) & np.isfinite(wavelengths))
    if wrong.any():
        nm = wavelengths[wrong][0]
        raise OpticsError(
            f"'transmittance_curve' = '{path}': wavelengths must be > 0 nm, got {nm:g}. Correct that row."
        )
    if (twice := wavelengths[1:][np.diff(wavelengths) == 0]).size:
        raise OpticsError(f"'transmittance_curve' = '{path}' has {twice[0]:g} nm twice. Leave one row out.")
    wrong = ~((values >= 0) & (values <= 1))
    if wrong.any():
        raise OpticsError(
            f"'transmittance_curve' = '{path}': the transmittance must be in 0 … 1, got {values[wrong][0]:g} at "
            f"{wavelengths[wrong][0]:g} nm. Divide percent by 100."
        )


@dataclass(frozen=True)
class Filters:
    """What lens and filters let through.

    transmittance : share τ of the power, in (0, 1]
    curve : name of the file of the transmittance over the wavelength; None where τ is given as a number
    light : behind the filters, for which τ holds; None without a curve or a spectrum
    surface_nm : mean wavelength [nm] of a spectrum before the filters, which the surface emits; None without both
    """

    transmittance: float = 1.0
    curve: str | None = None
    light: Light | None = None
    surface_nm: float | None = None

    @classmethod
    def of(cls, numbers: Mapping[str, float], curve: Curve | None, spectrum: curve_file.Curve | None = None) -> Filters:
        """Filters from the numbers of an `fspt_lens`, its curve and its spectrum, checked as in `transmittance_of`."""
        passed = transmittance_of(numbers, curve, spectrum)
        file = curve.file if curve else None
        if spectrum is not None:
            light = Light(None, spectrum)
            if curve is None:
                return cls(passed, file, light)
            return cls(passed, file, light.through(curve), light.mean_wavelength_nm)
        return cls(passed, file, Light(numbers["wavelength_nm"], None) if curve else None)

    @property
    def wavelength_nm(self) -> float | None:
        """Wavelength [nm] of the light, of a spectrum its mean; None where it is not known."""
        return self.light.mean_wavelength_nm if self.light else None

    def numbers(self, f_number: float) -> dict[str, float | int | str]:
        """Transmittance, T-stop of a lens with this f-number, and the curve with its light, by name."""
        found: dict[str, float | int | str] = {
            "transmittance": self.transmittance,
            "t_stop": t_stop(f_number, self.transmittance),
        }
        found |= {} if self.curve is None else {CURVE: self.curve}
        found |= {} if self.surface_nm is None else {SURFACE: self.surface_nm}
        return found | (self.light.metadata() if self.light else {})


def transmittance_of(
    numbers: Mapping[str, float], curve: Curve | None, spectrum: curve_file.Curve | None = None
) -> float:
    """τ, in (0, 1]: `transmittance`, or that of a curve at `wavelength_nm` or over a `spectrum`; 1 without any.

    The mean over the spectrum, which is that before the filters, is weighted by power (Eq. M.43).

    Raises
    ------
    OpticsError : a curve and a number, a curve without its light, a wavelength without a curve, a wavelength and a
        spectrum, a curve that does not cover the spectrum, or a τ that is not in (0, 1].
    """
    given, wavelength = numbers.get("transmittance"), numbers.get("wavelength_nm")
    if wavelength is not None and spectrum is not None:
        raise OpticsError(f"'wavelength_nm' = {wavelength:g} and 'spectrum' exclude each other. Give one of them.")
    if curve is None:
        if wavelength is not None:
            raise OpticsError(
                f"'wavelength_nm' = {wavelength:g} goes with 'transmittance_curve', which is missing. Give it, or "
                "leave the wavelength out."
            )
        found, where = 1.0 if given is None else given, ""
    else:
        if given is not None:
            raise OpticsError(f"'transmittance' = {given:g} and 'transmittance_curve' exclude each other. Give one.")
        found, where = _mean(curve, wavelength, spectrum)
    if not 0 < found <= 1:
        raise OpticsError(f"'transmittance' must be > 0 and at most 1, got {found:g}{where}. Give for example 0.9.")
    return found


def _mean(curve: Curve, wavelength: float | None, spectrum: curve_file.Curve | None) -> tuple[float, str]:
    """τ of a curve for its light, and the light for messages."""
    if spectrum is not None:
        light = Light(None, spectrum)
        light.require_cover(curve, CURVE, OpticsError)
        return light.mean(curve), f" over '{spectrum.file}' in '{curve.file}'"
    if wavelength is None:
        raise OpticsError("'transmittance_curve' needs 'wavelength_nm'. Give it in nm, for example 660, or 'spectrum'.")
    wavelength = checked("'wavelength_nm'", wavelength, OpticsError)
    return curve.at(wavelength), f" at {wavelength:g} nm in '{curve.file}'"


def t_stop(f_number: float, transmittance: float) -> float:
    """T-stop N/√τ: f-number of the lens without losses that gives the same power."""
    return f_number / math.sqrt(transmittance)
