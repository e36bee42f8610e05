"""Numbers as callers give them, NumPy's and arrays without axes among them, as Python's own, which do not overflow."""

from __future__ import annotations

import math
from contextlib import suppress
from decimal import Decimal
from numbers import Real

import numpy as np

from .errors import FsptError


def number(thing: str, value: object, error: type[FsptError], example: str) -> float:
    """`value` as a float, infinite where it is beyond all floats; `error` for what is no real number, True too."""
    value = _without_axes(value)
    if isinstance(value, bool) or not isinstance(value, (Real, Decimal)):
        raise error(f"{thing} must be a number, got {_told(value)}. Give for example {example}.")
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf  # type: ignore[operator]  # numbers.Real has no stub for it


def whole(thing: str, value: object, error: type[FsptError], example: str) -> int:
    """`value` as an int; raises `error` for what is no whole number, True too."""
    value = _without_axes(value)
    with suppress(OverflowError, ValueError):  # infinite, not a number
        if isinstance(value, (Real, Decimal)) and not isinstance(value, bool):
            found = int(value)  # type: ignore[arg-type]  # likewise
            if found == value:
                return found
    raise error(f"{thing} must be a whole number, got {_told(value)}. Give for example {example}.")


def _without_axes(value: object) -> object:
    return value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value


def _told(value: object) -> str:
    return " ".join((str(value) if isinstance(value, Real) else repr(value)).split())
