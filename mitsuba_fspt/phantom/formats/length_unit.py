"""Length units of meshes."""

from __future__ import annotations

from ...runtime.errors import FluxError

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


def millimetres(length_unit: str, where: str) -> float:
    """Length of one `length_unit` [mm]; FluxError for an unknown unit, whose message begins with `where`."""
    if length_unit not in MILLIMETRES:
        known = ", ".join(MILLIMETRES)
        raise FluxError(f"{where}: 'length_unit' must be one of {known}, got '{length_unit}'. Give one of these.")
    return MILLIMETRES[length_unit]
