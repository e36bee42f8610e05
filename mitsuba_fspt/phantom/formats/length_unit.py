"""Length units of meshes."""

from __future__ import annotations

from ...runtime.errors import FluxError

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


def millimetres(length_unit: str, where: str) -> float:
    """How many mm one of this unit is; FluxError, which names `where` it stands, for one that is not known."""
    if length_unit not in MILLIMETRES:
        known = ", ".join(MILLIMETRES)
        raise FluxError(f"{where}: 'length_unit' must be one of {known}, got '{length_unit}'. Give one of these.")
    return MILLIMETRES[length_unit]
