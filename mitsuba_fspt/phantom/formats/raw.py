"""Contents of a mesh file before conversion to a phantom: points, cells and fields; and the choice of one field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError
from ..surface_mesh import Indices, Points, boundary, compact, require_joined
from .table import pick, quoted

LABELS = "medit:"  # prefix of the part numbers of a mesh, which label media and are never values


@dataclass(frozen=True)
class Field:
    """Named values of shape (N,), one `on` each 'vertex', 'cell' (triangle or tetrahedron) or boundary 'face'.

    If `on` is None, the number of values decides. With `by_name` the field is chosen by its name only. `label` is what
    a table calls them, which may state their unit.
    """

    name: str
    values: NDArray
    on: str | None
    by_name: bool = False
    label: str = ""


def scalars(fields: Iterable[Field]) -> tuple[Field, ...]:
    """The fields with one real number per element, as shape (N,)."""
    return tuple(
        replace(f, values=f.values.ravel())
        for f in fields
        if f.values.dtype.kind in "fiu" and f.values.size == len(f.values)
    )


@dataclass(frozen=True)
class RawMesh:
    """Points (V, 3), cells (C, 3) triangles or (C, 4) tetrahedra with indices from 0, and the file's fields.

    quantity : of the values: 'exitance' or 'fluence' [W per square of the file's length unit], or 'power' [W] of each
        face
    point_order : False if the file defines no order of the vertices (STL), so that values cannot refer to it
    parts : number of meshes in a file that leaves their order open (GLB, …), to which values of no other file refer
    index : refractive index at the points (V,), NaN if the parameter file does not contain it; None without such a file
    triangles : of a file of tetrahedra that lists triangles, too (F, 3), in its order; else None
    stated : texts of the file on 'length_unit', 'unit' and 'quantity' of its values, as far as it has them
    """

    points: Points
    cells: Indices
    source: str
    fields: tuple[Field, ...] = ()
    quantity: str = "exitance"
    point_order: bool = True
    parts: int = 1
    index: NDArray[np.float64] | None = None
    triangles: Indices | None = None
    stated: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points, cells = self.points, self.cells
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise FluxError(f"{self.source}: vertices must have shape (V, 3), got {points.shape}. Give x, y and z.")
        if cells.ndim != 2 or cells.shape[1] not in (3, 4) or len(cells) == 0:
            raise FluxError(
                f"{self.source}: cells must be triangles (F, 3) or tetrahedra (T, 4), got shape {cells.shape}. "
                "Split other cells."
            )
        if cells.dtype.kind not in "iu":
            raise FluxError(f"{self.source}: cells must be integers, got {cells.dtype}. Give numbers of vertices.")
        object.__setattr__(self, "points", points.astype(np.float64))
        object.__setattr__(self, "cells", cells.astype(np.int64))
        if cells.min() < 0 or cells.max() >= len(points):
            raise FluxError(
                f"{self.source}: cells name vertices {cells.min()} to {cells.max()} (counted from 0), there "
                f"are {len(points)}. Is the mesh complete, does it count from 0 or from 1?"
            )
        if not np.isfinite(points).all() and not np.isfinite(points[cells]).all():
            raise FluxError(f"{self.source}: vertices of cells must be finite, some are NaN or inf. Fix the mesh.")


@dataclass(frozen=True)
class SurfaceValues:
    """Values on a triangle surface, per 'vertex' (V,) or per 'face' (F,), in the file's units.

    index : refractive index at its vertices (V,), as in `RawMesh`
    label : what the file calls the values: the name of their field, and that of a table's column
    """

    vertices: Points
    faces: Indices
    values: NDArray[np.float64]
    per: str
    name: str
    index: NDArray[np.float64] | None
    label: str = ""


def surface_values(mesh: RawMesh, name: str | None, per: str | None) -> SurfaceValues:
    """Surface of `mesh` (of tetrahedra their boundary, outward) with the chosen field on it.

    `name` chooses the field; `per` ('vertex' or 'face') decides if the name or the number of values is ambiguous.

    Raises
    ------
    FluxError : no field or several fields fit, or the number of values fits neither vertices, faces nor tetrahedra.
    """
    if mesh.cells.shape[1] == 4:
        faces, owner = boundary(mesh.points, mesh.cells)
        require_joined(mesh.points, faces, mesh.source)
    else:
        faces, owner = mesh.cells, np.arange(len(mesh.cells))
    chosen = _choose(mesh, name, per)
    on = chosen.on or _carrier(chosen, mesh, len(faces), per)
    if on == "face" and mesh.triangles is not None:
        _require_same_order(mesh.triangles, faces, chosen.name)
    vertices, faces, kept = compact(mesh.points, faces)
    if on == "vertex":
        if not mesh.point_order:
            raise FluxError(
                f"{mesh.source}: an STL file has no vertices in an order, so that values per vertex fit "
                "nothing. Give values per face, or the mesh as PLY or OBJ."
            )
        values = chosen.values[kept]
    else:
        values = chosen.values if on == "face" else chosen.values[owner]
    per = "vertex" if on == "vertex" else "face"
    index = None if mesh.index is None else mesh.index[kept]
    label = f"{chosen.name} {chosen.label}".strip()
    return SurfaceValues(vertices, faces, values.astype(np.float64), per, chosen.name, index, label)


def _require_same_order(triangles: Indices, faces: Indices, name: str) -> None:
    """Raise FluxError for values of the boundary `faces` of a file that lists as many triangles in another order."""
    if len(triangles) == len(faces) and not np.array_equal(np.sort(triangles, axis=1), np.sort(faces, axis=1)):
        raise FluxError(
            f"{name}: {len(faces)} values fit the boundary faces, tetrahedron by tetrahedron, and the triangles of the "
            "file, which are in another order. Give a mesh of the triangles alone, or of the tetrahedra alone."
        )


def _choose(mesh: RawMesh, name: str | None, per: str | None) -> Field:
    """Field of that name; without a name the only field of real numbers, since whole numbers are labels."""
    fields = [f for f in mesh.fields if not f.name.startswith(LABELS)]
    fitting = [f for f in fields if per is None or f.on is None or (f.on == "vertex") == (per == "vertex")]
    if fields and not fitting:
        stand = "vertices" if per == "face" else "faces"
        raise FluxError(f"{mesh.source}: its values stand on {stand}, not per {per}. Leave out --per.")
    names = {f.name: f.values for f in fitting}
    if name is None:
        real = {f.name: f.values for f in fitting if f.values.dtype.kind == "f" and not f.by_name}
        if names and not real:
            raise FluxError(
                f"{mesh.source}: which field holds the values? All it has are whole numbers or texture coordinates: "
                f"{quoted(names)}. Choose one by --field NAME, or give --values FILE."
            )
        name = pick(real, None, mesh.source)
    else:  # a PLY property jn_x is Mitsuba's attribute jn
        name = pick(names, f"{name}_x" if name not in names and f"{name}_x" in names else name, mesh.source)
    same = [f for f in fitting if f.name == name]
    if len(same) > 1:
        raise FluxError(f"{mesh.source}: '{name}' is on vertices and on faces. Choose by --per vertex or --per face.")
    return same[0]


def _carrier(chosen: Field, mesh: RawMesh, faces: int, per: str | None) -> str:
    """Kind of element that carries the values, by their number: 'vertex', 'face' or 'cell'."""
    counts = {"vertex": len(mesh.points), "face": faces, "cell": len(mesh.cells)}
    if mesh.cells.shape[1] == 3:
        del counts["cell"]
    count = len(chosen.values)
    carriers = [
        carrier
        for carrier, number in counts.items()
        if number == count and (per is None or (carrier == "vertex") == (per == "vertex"))
    ]
    if len(carriers) == 1:
        return carriers[0]
    if per == "face" and carriers:  # as many tetrahedra as boundary faces
        return "face"
    names = {
        "vertex": "vertices",
        "face": "faces" if len(counts) == 2 else "boundary faces",
        "cell": "tetrahedra",
    }
    listed = ", ".join(f"{number} {names[carrier]}" for carrier, number in counts.items())
    if carriers:
        raise FluxError(f"{chosen.name}: {count} values fit {' and '.join(names[c] for c in carriers)}. Give --per.")
    asked = f" (asked for per {per})" if per else ""
    raise FluxError(
        f"{chosen.name}: {count} values fit nothing{asked}, {mesh.source} has {listed}. Give one value for each."
    )
