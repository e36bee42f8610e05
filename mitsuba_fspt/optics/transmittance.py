"""Transmittance τ of a lens with its filters: one number, or a curve over the wavelength, read from a file."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import OpticsError
from ..runtime.wavelength import LONGEST, SHORTEST, meant
from ..runtime.wavelength import wavelength as checked

NUMBERS = ("transmittance", "wavelength_nm")  # of `fspt_lens`


@dataclass(frozen=True, eq=False)
class Curve:
    """Transmittance over the wavelength, linear between the rows of a table.

    file : its name, for messages
    wavelengths : of the rows, ascending (n,) [nm]
    values : τ there (n,), in [0, 1]
    """

    file: str
    wavelengths: NDArray[np.float64]
    values: NDArray[np.float64]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Curve:
        """Curve from a CSV file with a wavelength [nm] and τ in each row, in any order. One title line and # comments
        are allowed.

        Raises
        ------
        OpticsError : the file cannot be read, or a row is no pair of numbers, is given twice or lies outside the range.
        """
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except OSError as cause:
            raise OpticsError(
                f"'transmittance_curve' = '{path}' cannot be read: {cause.strerror}. Check it."
            ) from cause
        except UnicodeDecodeError as cause:
            raise OpticsError(
                f"'transmittance_curve' = '{path}' is no text. Give a CSV of nm, transmittance."
            ) from cause
        rows = [line.partition("#")[0].strip() for line in lines]
        rows = [row for row in rows if row]
        if rows and not rows[0][0].isdigit():
            rows = rows[1:]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without rows, which is refused here
                table = np.loadtxt(rows, delimiter=",", ndmin=2, dtype=np.float64)
        except ValueError as cause:
            reason = " ".join(str(cause).split()).partition(" at row")[0]
            raise OpticsError(
                f"'transmittance_curve' = '{path}': {reason}. Give rows of nm,transmittance such as 600,0.92."
            ) from cause
        if table.size == 0 or table.shape[1] != 2:
            raise OpticsError(
                f"'transmittance_curve' = '{path}' has {table.shape[1] if table.size else 'no'} columns, must have 2. "
                "Give rows of nm,transmittance such as 600,0.92."
            )
        wavelengths, values = table[np.argsort(table[:, 0])].T
        _check(path, wavelengths, values)
        if wavelengths[0] > LONGEST or wavelengths[-1] < SHORTEST:
            raise OpticsError(
                f"'transmittance_curve' = '{path}': wavelengths must be nm, of which {SHORTEST:g} … {LONGEST:g} are "
                f"used, got {wavelengths[0]:g} … {wavelengths[-1]:g}. {meant(wavelengths[0])}"
            )
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
    wavelength_nm : of the light [nm], for which τ holds; None without a curve
    """

    transmittance: float = 1.0
    curve: str | None = None
    wavelength_nm: float | None = None

    @classmethod
    def of(cls, numbers: Mapping[str, float], curve: Curve | None) -> Filters:
        """Filters from the numbers of an `fspt_lens` and its curve, checked as in `transmittance_of`."""
        passed = transmittance_of(numbers, curve)
        return cls(passed, curve.file if curve else None, numbers.get("wavelength_nm"))

    def numbers(self, f_number: float) -> dict[str, float | str]:
        """Transmittance, T-stop of a lens with this f-number, and the curve with its wavelength, by name."""
        found: dict[str, float | str] = {
            "transmittance": self.transmittance,
            "t_stop": t_stop(f_number, self.transmittance),
        }
        if self.curve is not None and self.wavelength_nm is not None:
            found |= {"transmittance_curve": self.curve, "wavelength_nm": self.wavelength_nm}
        return found


def transmittance_of(numbers: Mapping[str, float], curve: Curve | None) -> float:
    """τ, in (0, 1], from `transmittance`, or from a curve at `wavelength_nm`; 1 if none of them is given.

    Raises
    ------
    OpticsError : a curve and a number, a curve without a wavelength or a wavelength without a curve, or a τ that is not
        in (0, 1].
    """
    given, wavelength = numbers.get("transmittance"), numbers.get("wavelength_nm")
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
        if wavelength is None:
            raise OpticsError("'transmittance_curve' needs 'wavelength_nm'. Give it in nm, for example 660.")
        wavelength = checked("'wavelength_nm'", wavelength, OpticsError)
        found, where = curve.at(wavelength), f" at {wavelength:g} nm in '{curve.file}'"
    if not 0 < found <= 1:
        raise OpticsError(f"'transmittance' must be > 0 and at most 1, got {found:g}{where}. Give for example 0.9.")
    return found


def t_stop(f_number: float, transmittance: float) -> float:
    """T-stop N/√τ: f-number of the lens without losses that gives the same power."""
    return f_number / math.sqrt(transmittance)
