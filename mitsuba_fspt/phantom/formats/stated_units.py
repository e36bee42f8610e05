"""Units that a file states beside its numbers: in names of arrays and columns, in headers, in comments of a PLY."""

from __future__ import annotations

import re

from ...runtime.errors import LONGEST_TEXT, FluxError, one_line
from ..length_unit import MILLIMETRES

LENGTH_UNIT, VALUE_UNIT, QUANTITY, UP = "length_unit", "unit", "quantity", "up"  # keys of what a file states
LENGTHS = (*MILLIMETRES, "nm", "um", "µm", "dm", "in", "inch")
# Power per area, such as W/mm^2, mW/cm², W cm-2 or W_per_m2, and whether it is per solid angle as well.
DENSITY = re.compile(
    r"(?<![A-Za-z])(?P<prefix>[fpnuµ\u03bcmkM]?)W\s*(?:/|_per_|\s+per\s+|_|·|\.|\*|\s)\s*(?P<open>[({])?\s*"
    r"(?P<length>[mcnuµd]?m)\s*\$?(?:\^|\*\*)?[({]?\s*[-−⁻]?\s*[2²](?!\d)"
    r"(?P<angle>[)}]?\s*(?:/|_per_|_|·|\.|\*|\s)?\s*sr)?(?(open)[)}]?|\$?)"
)


def length_of_name(name: str) -> str | None:
    """Unit of length after the last underscore of a name, 'cm' of 'vertices_cm'; None without one."""
    end = name.rpartition("_")[2].lower()
    return end if "_" in name and end in LENGTHS else None


def require_length_unit(source: str, stated: str | None, unit: str, option: str = "--length-unit {}") -> None:
    """Raise FluxError where a file states another unit of its vertices than the one that it is read in.

    option : by which the unit `{}` is given
    """
    if stated is not None and stated != unit:
        fix = f"Give {option.format(stated)}" if stated in MILLIMETRES else "Scale the mesh to mm, and state so"
        raise FluxError(f"{source}: its vertices are in '{stated}' by the file, they would be taken for {unit}. {fix}.")


def require_density_unit(source: str, text: str, unit: str) -> None:
    """Raise FluxError where a text beside values states another unit than W per square of the length `unit`.

    Passes where it states none, or several.
    """
    found = {match.group("prefix", "length", "angle"): match[0] for match in DENSITY.finditer(text)}
    if len(found) != 1:
        return
    ((prefix, length, angle), shown) = next(iter(found.items()))
    if prefix or angle or length != unit:
        other = not prefix and not angle and length in MILLIMETRES
        fix = f", or give --length-unit {length} if the mesh is in {length}" if other else ""
        raise FluxError(
            f"{source}: its values are in '{shown}' by '{one_line(text, LONGEST_TEXT)}', they would be taken for "
            f"W/{unit}^2. Convert them, and name them so{fix}."
        )
