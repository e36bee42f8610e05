"""Reader of meshio's formats with point and cell data: VTU, legacy VTK, Gmsh, XDMF, MEDIT, Abaqus (extra `mesh`)."""

from __future__ import annotations

import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from ...runtime.errors import BackendError, FluxError, one_line
from ..surface_mesh import Indices
from .gmsh import put_in_order
from .raw import Field, RawMesh, scalars
from .table import require_file

FORMATS = {
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".msh": "gmsh",
    ".xdmf": "xdmf",
    ".xmf": "xdmf",
    ".mesh": "medit",
    ".inp": "abaqus",
}
# Types of cells and their number of corner nodes; the other nodes of second-order cells are ignored.
TRIANGLES = {"triangle": 3, "triangle6": 3, "triangle7": 3}
TETRAHEDRA = {"tetra": 4, "tetra10": 4}
IGNORED = ("vertex", "line", "line3")
LABELS = "gmsh:"  # prefix of meshio's names for Gmsh's part numbers


def read_meshio(path: Path) -> RawMesh:
    """Tetrahedra of the file, or its triangles if it has none, with its scalar point and cell data.

    Cell data of a file with both kinds is ignored; `source` states so.

    Raises
    ------
    FluxError : the file cannot be read, or holds other cells.
    BackendError : meshio is not installed, or h5py for an XDMF or MEDIT file with HDF5 data.
    """
    mesh = _load(path)
    if path.suffix.lower() == ".vtu":
        _require_one_piece(path)
    kinds = {block.type for block in mesh.cells}
    wanted = TETRAHEDRA if kinds & set(TETRAHEDRA) else TRIANGLES
    other = kinds - set(TRIANGLES) - set(TETRAHEDRA) - set(IGNORED)
    if other or not kinds & set(wanted):
        listed = ", ".join(sorted(other or kinds)) or "no cells"
        raise FluxError(f"'{path}' holds {listed}; triangles or tetrahedra are read. Split its cells first.")
    if FORMATS.get(path.suffix.lower()) == "gmsh" and _has_values(mesh):
        put_in_order(mesh, path)
    blocks = [k for k, block in enumerate(mesh.cells) if block.type in wanted]
    cells = _corners(mesh, wanted)
    fields = [Field(name, values, "vertex") for name, values in mesh.point_data.items()]
    source, triangles = path.name, None
    if kinds & set(TRIANGLES) and kinds & set(TETRAHEDRA):
        triangles = _corners(mesh, TRIANGLES)
        # Either kind may carry the values; a guess could be wrong.
        source += " (its cell data passed over: both on triangles and on tetrahedra)"
    else:
        for name, data in mesh.cell_data.items():
            if not name.startswith(LABELS):
                fields.append(Field(name, np.concatenate([data[k] for k in blocks]), "cell"))
    return RawMesh(np.asarray(mesh.points, np.float64), cells, source, scalars(fields), triangles=triangles)


def _corners(mesh: Any, kinds: dict[str, int]) -> Indices:
    """Corner nodes of the cells of these kinds, in the order of the file."""
    found = [block.data[:, : kinds[block.type]] for block in mesh.cells if block.type in kinds]
    return np.concatenate(found).astype(np.int64)


def _has_values(mesh: Any) -> bool:
    """True if the mesh has data besides labels."""
    return not all(name.startswith(LABELS) for name in (*mesh.point_data, *mesh.cell_data))


def _require_one_piece(path: Path) -> None:
    """Raise FluxError for a VTU of several pieces, of which meshio keeps the cells of the last only."""
    pieces = len(re.findall(rb"<Piece[\s>/]", path.read_bytes()))
    if pieces > 1:
        raise FluxError(
            f"'{path}' has {pieces} pieces, only one can be read. Save them as one, for example by ParaView."
        )


def _load(path: Path):
    """meshio's mesh of a file; a failure or exit of meshio, with its printed text, becomes a FluxError."""
    try:
        import meshio
    except ImportError as cause:
        raise BackendError(
            f"flux import: meshio, which reads '{path.name}', is not installed. pip install 'mitsuba-fspt[mesh]'."
        ) from cause
    require_file(path)
    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            return meshio.read(path, file_format=FORMATS.get(path.suffix.lower()))
    except ImportError as cause:
        raise BackendError(
            f"flux import: '{path.name}' needs {cause.name or 'h5py'}, which is not installed. "
            f"pip install {cause.name or 'h5py'}."
        ) from cause
    except (Exception, SystemExit) as cause:  # a damaged file makes meshio's readers raise anything, or exit
        reason = " ".join(printed.getvalue().split()) or one_line(cause)
        raise FluxError(f"'{path}' cannot be read by meshio: {reason[:200].rstrip('.')}. Save it anew.") from cause
