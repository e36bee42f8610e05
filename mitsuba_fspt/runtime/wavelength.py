"""Check of a wavelength: in nm, and of light that a camera sees."""

from __future__ import annotations

from .errors import FsptError
from .numbers import number

SHORTEST, LONGEST = 200.0, 2500.0  # nm: from the ultraviolet to the end of the short-wave infrared
UNITS = {"µm": 1e3, "Å": 0.1, "m": 1e9, "mm": 1e6, "cm": 1e7}  # nm in each, to guess which one a number is in


def wavelength(thing: str, value: object, error: type[FsptError]) -> float:
    """`value` [nm] as a float.

    Parameters
    ----------
    thing : name of the argument in the message
    value : 200 … 2500 nm (`SHORTEST`, `LONGEST`), in vacuum
    error : class of the exception

    Raises
    ------
    error : `value` is no number, or outside that range; the message guesses the unit that was meant.
    """
    found = number(thing, value, error, "660")
    if not in_range(found):
        raise error(f"{thing} must be in {SHORTEST:g} … {LONGEST:g} nm, got {found:g}. {meant(found)}")
    return found


def in_range(value: float) -> bool:
    """True for 200 … 2500 nm."""
    return SHORTEST <= value <= LONGEST


def meant(value: float) -> str:
    """The fix for a wavelength outside the range: the value in nm, if it makes sense in another unit."""
    for unit, factor in UNITS.items():
        if in_range(value * factor):
            return f"In {unit} it would be {value * factor:.6g} nm: give that."
    return "Give nm, for example 660."
