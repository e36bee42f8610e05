"""Checks of numeric arguments. NumPy scalars and arrays without axes become Python numbers, which do not overflow."""

from __future__ import annotations

import math
from contextlib import suppress
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np

from .errors import FsptError


def number(thing: str, value: object, error: type[FsptError], example: str) -> float:
    """`value` as a float; ±inf if it is beyond the range of floats.

    Parameters
    ----------
    thing : name of the argument in the message
    value : real number, NumPy scalar, Decimal or array without axes; bool is refused
    error : class of the exception
    example : valid value for the message

    Raises
    ------
    error : `value` is no real number.
    """
    value = _without_axes(value)
    if isinstance(value, bool) or not isinstance(value, (Real, Decimal)):
        raise error(f"{thing} must be a number, got {_shown(value)}. Give for example {example}.")
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf  # type: ignore[operator]  # numbers.Real has no stub for it


def whole(thing: str, value: object, error: type[FsptError], example: str) -> int:
    """`value` as an int; parameters as for `number`.

    Raises
    ------
    error : `value` is no whole number; bool is refused too.
    """
    value = _without_axes(value)
    with suppress(OverflowError, ValueError):  # infinite, not a number
        if isinstance(value, (Real, Decimal)) and not isinstance(value, bool):
            found = int(value)  # type: ignore[arg-type]  # likewise
            if found == value:
                return found
    raise error(f"{thing} must be a whole number, got {_shown(value)}. Give for example {example}.")


def require_unmasked(thing: str, values: object, error: type[FsptError], fix: str) -> None:
    """Raise `error` for a masked array that hides values: as a plain array it would show what is under its mask."""
    if np.ma.is_masked(values):
        raise error(f"{thing} is a masked array that hides {np.ma.count_masked(values)} values. {fix}")


def stacked(values: Any) -> Any:
    """A list of arrays of one shape of which some hide values as one masked array; anything else unchanged."""
    if not isinstance(values, (list, tuple)) or not all(isinstance(value, np.ndarray) for value in values):
        return values
    alike = len({value.shape for value in values}) == 1
    return np.ma.stack(values) if alike and any(map(np.ma.is_masked, values)) else values


def _without_axes(value: object) -> object:
    """The element of an array without axes; any other value unchanged."""
    return value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value


def _shown(value: object) -> str:
    """`value` as text on one line."""
    return " ".join((str(value) if isinstance(value, Real) else repr(value)).split())
