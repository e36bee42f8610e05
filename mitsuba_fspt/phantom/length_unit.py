"""Length units of meshes."""

from __future__ import annotations

from pathlib import Path

from ..runtime.errors import FluxError

GLTF = (".glb", ".gltf")  # in metres, y up, by the standard of glTF 2.0
# Usual diagonals of the bounding box of phantoms and small animals [mm]. For any other a warning suggests the unit with
# which the diagonal would be usual.
PASSED, USUAL = (5.0, 1000.0), (10.0, 500.0)
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


def millimetres(length_unit: str, where: str) -> float:
    """Length of one `length_unit` [mm]; FluxError for an unknown unit, whose message begins with `where`."""
    if length_unit not in MILLIMETRES:
        known = ", ".join(MILLIMETRES)
        raise FluxError(f"{where}: 'length_unit' must be one of {known}, got '{length_unit}'. Give one of these.")
    return MILLIMETRES[length_unit]


def own_unit(mesh: object) -> str:
    """Unit of a mesh whose unit is not given: m of a glTF file, mm of any other and of arrays."""
    return "m" if isinstance(mesh, str | Path) and Path(mesh).suffix.lower() in GLTF else "mm"


def is_usual(diagonal: float) -> bool:
    """True for a diagonal of the bounding box [mm] that a phantom may have."""
    return PASSED[0] <= diagonal <= PASSED[1]


def likelier_unit(length: float) -> str | None:
    """The unit in which a length without one is usual for the diagonal of a phantom; None if there is none."""
    return next((unit for unit, factor in MILLIMETRES.items() if USUAL[0] <= length * factor <= USUAL[1]), None)


def unit_warning(diagonal: float, length_unit: str, option: str = "--length-unit {}") -> str | None:
    """Warning of a mesh that is too small or too large for a phantom, with a more likely unit; None for a usual size.

    diagonal : of the bounding box [mm], with the mesh in `length_unit`;  option : by which the unit `{}` is given
    """
    if is_usual(diagonal):
        return None
    raw = diagonal / MILLIMETRES[length_unit]
    better = likelier_unit(raw)
    found = f"the mesh is {diagonal:.3g} mm from corner to corner if its unit is {length_unit}"
    if better is None:
        return f"{found}, unusual for a phantom. Check {option.split()[0]}, or scale the mesh."
    size = raw * MILLIMETRES[better]
    return f"{found}, and {size:.3g} mm if it is {better}. If that is right give {option.format(better)}."
