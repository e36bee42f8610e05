"""Import of the surface flux density J_n from results of other codes: reading, conversion to W/mm², checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..optics.boundary import boundary_a
from ..runtime.errors import ExitanceError, FluxError
from ..runtime.numbers import number
from .formats import MeshLike, RawMesh, SurfaceValues, ValuesLike, read_mesh, surface_values
from .formats.stated_units import LENGTH_UNIT, QUANTITY, UP, VALUE_UNIT, require_density_unit, require_length_unit
from .length_unit import millimetres, own_unit, unit_warning
from .phantom import UNIT, Phantom, require_finite, require_single, shares
from .surface_mesh import closure, face_areas, repeated

TISSUE_INDEX = 1.37
DARK = "exitance is 0 everywhere, the phantom is dark. Check the field's name if it should glow."


def import_flux(
    mesh: MeshLike,
    values: ValuesLike | None = None,
    *,
    field: str | int | None = None,
    per: str | None = None,
    format: str = "auto",
    length_unit: str | None = None,
    a: str | float | None = None,
    n: float | None = None,
    clip: bool = False,
    flip: bool = False,
) -> Phantom:
    """Phantom from a mesh and the values on it in the files or arrays of another code.

    Parameters
    ----------
    mesh : file, or arrays (points (V, 3), cells). Cells are triangles (F, 3) or tetrahedra (T, 4), whose
        boundary becomes the surface; indices count from 0, or from 1 with format 'mmc' or 'nirfast'.
    values : file or array with one value for each vertex, triangle, tetrahedron or boundary face. None: the values
        are in `mesh`.
    field : name of the array, property or column of the values; a column also by its number from 1
    per : 'vertex' or 'face', the elements that carry the values; needed only if the values' number leaves it open
    format : 'auto' (by the file's name) or one of `formats.FORMATS`
    length_unit : 'mm', 'cm' or 'm', unit of the mesh **and** of its values: W per square of it. MMC's values are
        power per face, whatever the unit. None: m of a glTF file (.glb, .gltf) by its standard, else mm.
    a : boundary factor A if the values are fluence phi, J_n = phi/(2A): 'robin', 'haskell' (see `optics.boundary`) or
        a number. None: the values are J_n; but NIRFAST's values are fluence, and None stands for 'robin' there
    n : refractive index of the tissue for A; None: that of the file, else 1.37
    clip : set negative values to 0 and record their power
    flip : reverse the orientation of all faces

    Raises
    ------
    FluxError : the input is unreadable or contradictory, in other units than it states, the faces of a closed surface
        point inward, or twice the same, or their orientations are inconsistent.
    ExitanceError : values are NaN or infinite, or negative without `clip`; J_n beyond single precision.
    BackendError : the format needs an optional package.
    """
    unit = own_unit(mesh) if length_unit is None else length_unit
    scale = millimetres(unit, "flux import")
    if per not in (None, "vertex", "face"):
        raise FluxError(f"flux import: 'per' must be vertex or face, got '{per}'.")
    field = None if field is None else str(field)
    n = None if n is None else number("flux import: 'n'", n, FluxError, "1.37")
    raw = read_mesh(mesh, values, field, format)
    found = surface_values(raw, field if values is None else None, per)
    found = replace(found, vertices=found.vertices * scale, faces=found.faces[:, ::-1] if flip else found.faces)
    require_finite(found.values, found.per)
    source = raw.source if values is not None else f"{raw.source} '{found.name}'"
    with np.errstate(over="ignore"):  # require_single refuses inf
        exitance, provenance = _exitance(raw, found, scale, a, n)
    require_single(exitance)
    provenance = {"source": source, **provenance, **_checked_unit(raw, found, unit, given=length_unit is not None)}
    exitance, negatives, removed = _without_negatives(found, exitance, clip)
    if not exitance.any():
        provenance["warning"] = " ".join([*([provenance["warning"]] if "warning" in provenance else []), DARK])
    phantom = Phantom(found.vertices, found.faces, exitance, found.per, provenance, negatives, removed)
    _require_outward(phantom, flip)
    return phantom


def _checked_unit(raw: RawMesh, found: SurfaceValues, unit: str, given: bool) -> dict[str, str]:
    """Entries of the provenance: the unit of the mesh if it is neither mm nor `given`, its axes, a warning of odd size.

    Raises FluxError where the file states other units.
    """
    require_length_unit(raw.source, raw.stated.get(LENGTH_UNIT), unit)
    for text in (raw.stated.get(VALUE_UNIT, ""), "" if raw.quantity == "power" else found.label):
        require_density_unit(raw.source, text, unit)
    scaled = f"{unit}, by the standard of its format; scaled to mm, values from W/{unit}^2 to W/mm^2"
    entries = {} if given or unit == "mm" else {"mesh_unit": scaled}
    if UP in raw.stated:
        entries["mesh_axes"] = f"as in the file, {raw.stated[UP]} up by its standard; 'view' turns a phantom about z"
    with np.errstate(over="ignore"):  # Phantom refuses vertices so far away
        diagonal = float(np.linalg.norm(np.ptp(found.vertices[found.faces].reshape(-1, 3), axis=0)))
    warning = unit_warning(diagonal, unit)
    return entries | ({"warning": warning} if warning else {})


def _exitance(
    raw: RawMesh, found: SurfaceValues, scale: float, a: str | float | None, n: float | None
) -> tuple[NDArray[np.float64], dict[str, str]]:
    """J_n [W/mm²] from the values in the file's unit, and the provenance of the conversion."""
    if a is None and raw.quantity == "fluence":
        a = "robin"
    if n is not None and a not in ("robin", "haskell"):
        raise FluxError(f"flux import: 'n' = {n:g} goes with 'a' = robin or haskell, got a = {a}. Leave it out.")
    if raw.quantity == "power":
        if a is not None:
            raise FluxError(f"{raw.source}: is the power that leaves each face already, not fluence. Leave out --a.")
        areas = face_areas(found.vertices, found.faces)
        if (flat := (areas == 0) & (found.values != 0)).any():
            raise FluxError(f"{raw.source}: {np.count_nonzero(flat)} faces without area carry power. Repair the mesh.")
        return np.divide(found.values, areas, out=np.zeros_like(areas), where=areas > 0), {}
    values = found.values / scale**2
    if a is None and raw.stated.get(QUANTITY) == "fluence":
        raise FluxError(f"{raw.source}: its values are fluence by the file, they would be taken for J_n. Give --a.")
    if a is None:
        return values, {}
    if raw.stated.get(QUANTITY) == "exitance":
        raise FluxError(f"{raw.source}: its values are J_n by the file, and no fluence. Leave out --a.")
    factor, description = _boundary_factor(a, n, found, raw.source)
    return values / (2 * factor), {"boundary_factor": description}


def _boundary_factor(
    a: str | float, n: float | None, found: SurfaceValues, source: str
) -> tuple[float | NDArray[np.float64], str]:
    """A, as one number or as an array with one for each value, and its description for the provenance."""
    if n is None and found.index is not None and a in ("robin", "haskell"):
        index = found.index if found.per == "vertex" else found.index[found.faces].mean(axis=1)
        if np.isnan(index).any():
            raise FluxError(f"{source}: its .param tells no refractive index n for A. Give --n.")
    else:
        index = np.array([TISSUE_INDEX if n is None else n])
    indices, where = np.unique(index, return_inverse=True)
    factors = np.array([boundary_a(a, float(value)) for value in indices])
    description = " to ".join(f"{f:.6g}" for f in np.unique(factors[[0, -1]]))
    if a in ("robin", "haskell"):
        description += f" ({a}, n = {' to '.join(f'{i:.6g}' for i in np.unique(indices[[0, -1]]))})"
    return (float(factors[0]) if len(factors) == 1 else factors[where.ravel()]), description


def _require_outward(phantom: Phantom, flip: bool) -> None:
    """Raise FluxError for inconsistent orientations and for a closed surface with inward faces: they would be dark.

    Also for faces that are there more than once, each of which would count in the power.
    """
    if again := repeated(phantom.vertices, phantom.faces):
        raise FluxError(
            f"mesh: {again} of its {len(phantom.faces)} faces repeat another one, so that their power would count "
            "again. Remove them, for example by trimesh's mesh.update_faces(mesh.unique_faces())."
        )
    shape = phantom.closure
    if shape.twisted:
        raise FluxError(
            f"mesh: on {shape.twisted} edges the two faces point to opposite sides, each face must point "
            "outward. Repair it, for example by trimesh.repair.fix_winding."
        )
    if shape.inside_out:
        turned = closure(phantom.vertices, phantom.faces[:, ::-1])
        if turned.outward:
            fix = "Leave out" if flip else "Give"
            raise FluxError(f"mesh: the closed surface is inside out, its light would stay inside. {fix} --flip.")
        raise FluxError(
            f"mesh: {shape.inside_out} of its {shape.pieces} closed pieces are inside out. Turn those over in the mesh."
        )


def _without_negatives(
    found: SurfaceValues, exitance: NDArray[np.float64], clip: bool
) -> tuple[NDArray[np.float64], int, float]:
    """J_n [W/mm²] >= 0, the number of values that were negative, and the magnitude of their power [W]."""
    negative = exitance < 0
    count = int(np.count_nonzero(negative))
    if count == 0:
        return exitance, 0, 0.0
    power = shares(found.vertices, found.faces, found.per) * exitance
    removed, kept = -float(power[negative].sum()), float(power[~negative].sum())
    if not clip:
        share = f" ({removed / kept:.3g} of the rest)" if kept > 0 else ""
        raise ExitanceError(
            f"exitance: {count} of {len(exitance)} values are negative, down to {exitance.min():.3g} "
            f"{UNIT}; their power is {-removed:.3g} W{share}. J_n must be >= 0. Set them to 0 by --clip."
        )
    return np.where(negative, 0.0, exitance), count, removed
