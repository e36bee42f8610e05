"""Readers of meshes with values from other codes, chosen by format; each returns a `RawMesh`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError
from ...runtime.numbers import require_unmasked
from .meshio_files import FORMATS as MESHIO
from .meshio_files import read_meshio
from .mmc import mmc_mesh, read_mmc
from .nirfast import nirfast_mesh, read_nirfast
from .ply import read_ply
from .raw import Field, RawMesh, SurfaceValues, surface_values
from .stated_units import LENGTH_UNIT, UP
from .surface_files import read_arrays, read_obj, read_off, read_trimesh
from .table import column, labelled_values

MeshLike = str | os.PathLike[str] | tuple[NDArray, NDArray]
ValuesLike = str | os.PathLike[str] | NDArray

READERS: dict[str, Callable[[Path], RawMesh]] = {
    "nirfast": read_nirfast,
    "meshio": read_meshio,
    "trimesh": read_trimesh,
    "ply": lambda path: read_ply(path)[0],
    "obj": read_obj,
    "off": read_off,
    "npz": read_arrays,
}
FORMATS = ("auto", "mmc", *READERS)

__all__ = [
    "FORMATS",
    "Field",
    "MeshLike",
    "RawMesh",
    "SurfaceValues",
    "ValuesLike",
    "read_mesh",
    "surface_values",
]


def read_mesh(mesh: MeshLike, values: ValuesLike | None, field: str | None, format: str) -> RawMesh:
    """Mesh of a file or of arrays (points, cells); `values`, if given, become its only field.

    Raises
    ------
    FluxError : the format is unknown, or its reader refuses the input.
    """
    if format not in FORMATS:
        raise FluxError(f"flux import: 'format' must be one of {', '.join(FORMATS)}, got '{format}'.")
    if isinstance(mesh, tuple):
        return _from_arrays(mesh, values, field, format)
    if not isinstance(mesh, (str, os.PathLike)):
        raise FluxError(
            f"flux import: the mesh must be the name of a file or (points, cells), got {type(mesh).__name__}. Give for "
            "example (mesh.vertices, mesh.faces)."
        )
    path = Path(mesh)
    if format == "auto" and not os.path.exists(path) and os.path.isfile(path.with_name(f"{path.name}.node")):
        format = "nirfast"
    if not os.path.exists(path) and format != "nirfast":  # a NIRFAST name may lack the suffix
        raise FluxError(f"mesh '{path}' does not exist. Check the name.")
    if format == "auto" and path.is_dir():
        raise FluxError(f"mesh '{path}' cannot be read: it is a folder. Check the name.")
    if format == "auto":
        format = _detect(path)
    if format == "mmc":
        if field is not None or isinstance(values, np.ndarray):
            raise FluxError(f"MMC: '{path}' goes with a file SESSION_dref.dat and no field. Give --values.")
        return read_mmc(path, None if values is None else Path(values))
    raw = READERS[format](path)
    return raw if values is None else _with_values(raw, values, field)


def _detect(path: Path) -> str:
    """Format of a file, from its name."""
    suffix = path.suffix.lower()
    if suffix == ".dat" and path.name.startswith(("node_", "elem_")):
        return "mmc"
    if suffix in (".node", ".elem"):
        return "nirfast"
    if suffix in (".ply", ".obj", ".off", ".npz"):
        return suffix[1:]
    return "meshio" if suffix in MESHIO else "trimesh"


def _from_arrays(mesh: tuple[NDArray, NDArray], values: ValuesLike | None, field: str | None, format: str) -> RawMesh:
    """Mesh of points and cells in memory; cells of MMC and NIRFAST count from 1, all others from 0."""
    points, cells = np.asarray(mesh[0], np.float64), np.asarray(mesh[1])
    if values is None:
        raise FluxError("flux import: a mesh in memory needs 'values'. Give one for each vertex or face.")
    if format == "mmc":
        if field is not None or not isinstance(values, np.ndarray):
            raise FluxError("MMC: a mesh in memory has no fields. Give dref in memory, (faces, gates).")
        return mmc_mesh(points, cells, values, "MMC dref")
    if format == "nirfast":
        return _with_values(nirfast_mesh(points, cells, "NIRFAST mesh"), values, field)
    if format != "auto":
        raise FluxError(f"flux import: format '{format}' reads files. Give auto, mmc or nirfast to a mesh in memory.")
    return _with_values(RawMesh(points, cells, "arrays"), values, field)


def _with_values(raw: RawMesh, values: ValuesLike, field: str | None) -> RawMesh:
    """Mesh with `values` in place of its own fields; FluxError for a file of several meshes without an order."""
    if raw.parts > 1:
        raise FluxError(
            f"{raw.source}: it holds {raw.parts} meshes, whose order its format leaves open, so that values of another "
            "file fit nothing. Save them as one mesh, for example as PLY."
        )
    if isinstance(values, (str, os.PathLike)):
        with np.errstate(over="ignore", invalid="ignore"):  # Phantom refuses vertices so far away
            places = raw.points, raw.points[raw.cells].mean(axis=1)
            name, (array, label) = Path(values).name, labelled_values(Path(values), field, places)
    else:
        require_unmasked("flux import: 'values'", values, FluxError, "Fill it, for example with zeros.")
        name, array, label = "values", column(np.asarray(values), [], field, "values"), ""
    source = f"{raw.source} with {name}" + (f" '{field}'" if field else "")
    stated = {key: text for key, text in raw.stated.items() if key in (LENGTH_UNIT, UP)}
    return replace(raw, source=source, fields=(Field(name, array, None, label=label),), stated=stated)
