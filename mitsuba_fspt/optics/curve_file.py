"""Curves over the wavelength, linear between the rows of a CSV file."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FsptError
from ..runtime.wavelength import LONGEST, SHORTEST, meant

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Curve:
    """Values over the wavelength, linear between the rows of a table.

    file : its name, for messages
    wavelengths : of the rows, ascending (n,) [nm]
    values : there (n,)
    """

    file: str
    wavelengths: Array
    values: Array

    def covers(self, first: float, last: float) -> bool:
        """True if the curve is known on all wavelengths from `first` to `last` [nm]."""
        return bool(self.wavelengths[0] <= first and last <= self.wavelengths[-1])

    def on(self, wavelengths: Array) -> Array:
        """Values at wavelengths [nm] that the curve covers."""
        return np.interp(wavelengths, self.wavelengths, self.values)


def read_rows(
    path: str | os.PathLike[str], name: str, error: type[FsptError], columns: str, example: str
) -> tuple[Array, Array]:
    """Wavelengths [nm] and values of a CSV file, a pair a row, in the order of the file.

    One title line and # comments are allowed. `name` is the parameter in messages, `columns` what the two are.

    Raises
    ------
    error : the file cannot be read, or a row is no pair of numbers.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as cause:
        raise error(f"'{name}' = '{path}' cannot be read: {cause.strerror}. Check it.") from cause
    except UnicodeDecodeError as cause:
        raise error(f"'{name}' = '{path}' is no text. Give a CSV of {columns}.") from cause
    rows = [line.partition("#")[0].strip() for line in lines]
    rows = [row for row in rows if row]
    if rows and _is_title(rows[0]):
        rows = rows[1:]
    fix = f"Give rows of {columns.replace(', ', ',')} such as {example}."
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file without rows, which is refused here
            table = np.loadtxt(rows, delimiter=",", ndmin=2, dtype=np.float64)
    except ValueError as cause:
        reason = " ".join(str(cause).split()).partition(" at row")[0]
        raise error(f"'{name}' = '{path}': {reason}. {fix}") from cause
    if table.size == 0 or table.shape[1] != 2:
        raise error(f"'{name}' = '{path}' has {table.shape[1] if table.size else 'no'} columns, must have 2. {fix}")
    wavelengths, values = table.T
    return wavelengths, values


def _is_title(row: str) -> bool:
    """True for a row that does not begin with a number, nor with a digit: that one is a row that went wrong."""
    if row[0].isdigit():
        return False
    try:
        float(row.partition(",")[0])
    except ValueError:
        return True
    return False


def require_range(path: str | os.PathLike[str], name: str, wavelengths: Array, error: type[FsptError]) -> None:
    """Raise `error` for ascending wavelengths [nm] of which none is in the range that is used."""
    if wavelengths[0] > LONGEST or wavelengths[-1] < SHORTEST:
        raise error(
            f"'{name}' = '{path}': wavelengths must be nm, of which {SHORTEST:g} … {LONGEST:g} are "
            f"used, got {wavelengths[0]:g} … {wavelengths[-1]:g}. {meant(wavelengths[0])}"
        )


def ascending_curve(
    path: str | os.PathLike[str], name: str, error: type[FsptError], what: str, example: str, largest: float
) -> Curve:
    """Curve of a CSV file whose rows ascend in nm, with values from 0 to `largest` that are not all 0.

    Raises
    ------
    error : as `read_rows` and `require_range`; rows that do not ascend, one row alone, a value outside the range.
    """
    wavelengths, values = read_rows(path, name, error, f"nm, {what}", example)
    thing = f"'{name}' = '{path}'"
    if len(wavelengths) < 2:
        raise error(f"{thing} has one row. Give at least two, between which the curve is linear.")
    if not (np.isfinite(wavelengths).all() and (np.diff(wavelengths) > 0).all()):
        steps = np.flatnonzero(~(np.diff(wavelengths) > 0))
        at = wavelengths[steps[0] + 1] if steps.size else np.nan
        raise error(f"{thing}: the wavelengths must ascend, got {at:g} nm in row {steps[0] + 2}. Sort the rows.")
    require_range(path, name, wavelengths, error)
    wrong = ~((values >= 0) & (values <= largest) & np.isfinite(values))
    if wrong.any():
        rule = ">= 0" if largest == np.inf else f"in 0 … {largest:g}"
        raise error(
            f"{thing}: the {what} must be {rule}, got {values[wrong][0]:g} at {wavelengths[wrong][0]:g} nm. Correct "
            "that row."
        )
    if not values.any():
        raise error(f"{thing}: the {what} is 0 everywhere. Give another curve.")
    return Curve(str(path), wavelengths, values)
