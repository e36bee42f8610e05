"""Reader of MMC and pmmc: the energy that leaves through each boundary face of a tetrahedral mesh (`dref`).

Files of the command line tool: `node_ID.dat` and `elem_ID.dat` have a header line and then lines `i x y z` and
`i a b c d region`, numbered from 1; `SESSION_dref.dat` has lines `face value`, one time gate after the other.
Values are energy through the face divided by the energy launched: W per W of the source, not per area.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError
from ..surface_mesh import Indices, Points, boundary
from .raw import Field, RawMesh
from .table import read_table, whole_numbers

TEXT = (".dat", ".txt")


def read_mmc(mesh: Path, values: Path | None) -> RawMesh:
    """Mesh and dref of the files `node_ID.dat` (or `elem_ID.dat`) and `SESSION_dref.dat`.

    Raises
    ------
    FluxError : a file is missing or not in MMC's layout; the values are not text, not normalised, or of another mesh.
    """
    kind, _, session = mesh.stem.partition("_")
    if kind not in ("node", "elem") or not session:
        raise FluxError(f"MMC: '{mesh}' is no node_ID.dat. Name the mesh so, beside its elem_ID.dat.")
    if values is None:
        raise FluxError(f"MMC: '{mesh}' needs the exitance of its faces. Give --values SESSION_dref.dat.")
    nodes, _ = read_table(mesh.with_name(f"node_{session}.dat"), skip_lines=1)
    elements, _ = read_table(mesh.with_name(f"elem_{session}.dat"), skip_lines=1)
    if nodes.shape[1] != 4 or elements.shape[1] not in (5, 6):
        raise FluxError(
            f"MMC: node and elem files must have 4 and 6 columns after their first line, '{mesh}' has "
            f"{nodes.shape[1]} and {elements.shape[1]}. Linear tetrahedra are read only."
        )
    # MMC does not reorder the elements if it finds one of these files beside them.
    kept = any(mesh.with_name(f"{part}_{session}.dat").exists() for part in ("facenb", "velem"))
    tetrahedra = whole_numbers(elements[:, 1:5], f"MMC: node numbers of the elements of '{mesh}'")
    return mmc_mesh(nodes[:, 1:], tetrahedra, _read_dref(values), f"MMC {values.name}", turn=not kept)


def mmc_mesh(nodes: Points, elements: Indices, dref: NDArray, source: str, turn: bool = True) -> RawMesh:
    """Mesh with dref on its boundary faces.

    Parameters
    ----------
    nodes : array, shape (V, 3)
    elements : array, shape (T, 4 or more), node numbers from 1
    dref : array, shape (F,), (F, gates) or (gates · F,); summed over the gates
    source : origin of the values, for messages and provenance
    turn : True if MMC exchanged the last two nodes of each element whose (2−1)·(3−1)×(4−1) is positive before it
        numbered the faces, which it does unless the files velem or facenb exist
    """
    tetrahedra = elements[:, :4].astype(np.int64) - 1
    RawMesh(nodes, tetrahedra, source)  # checks the numbers of the nodes
    if turn:
        edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
        positive = np.linalg.det(edges) > 0
        tetrahedra[positive] = tetrahedra[positive][:, [0, 1, 3, 2]]
    faces = len(boundary(nodes, tetrahedra)[0])
    if dref.ndim not in (1, 2) or dref.size == 0 or dref.shape[0] % faces or dref.dtype.kind not in "fiu":
        raise FluxError(
            f"{source}: values of shape {dref.shape} do not fill time gates of {faces} boundary faces. Is "
            "it the _dref of this mesh, and not its fluence?"
        )
    energy = dref.sum(axis=1) if dref.ndim == 2 else dref.reshape(-1, faces).sum(axis=0)
    if np.isfinite(energy).all() and energy.sum() > 1 + 1e-3:
        raise FluxError(
            f"{source}: {energy.sum():.6g} times the launched energy leaves the mesh, at most 1 can. The values are "
            "not normalised, or not dref; run mmc with -U 1."
        )
    field = Field("dref", energy, "face")
    return RawMesh(nodes, tetrahedra, f"{source} per 1 W of source power", (field,), "power")


def _read_dref(path: Path) -> NDArray[np.float64]:
    """Second column of a `_dref.dat`, shape (N,); FluxError unless the first one numbers the faces."""
    if path.suffix.lower() not in TEXT:
        raise FluxError(
            f"MMC: '{path}' is not a text _dref.dat. In its binary and JNIfTI files MMC appears to store the "
            "fluence in place of dref; run mmc with its default text output (no -F)."
        )
    try:
        table, _ = read_table(path)
    except FluxError as cause:
        raise FluxError(f"MMC: {cause} A binary _dref appears to hold the fluence; run mmc without -F.") from cause
    if table.shape[1] != 2:
        raise FluxError(
            f"MMC: '{path}' has {table.shape[1]} columns, a _dref.dat of one source has 2: face and value. "
            "Run one source at a time."
        )
    number = table[:, 0]
    starts = np.flatnonzero(number == 1)
    period = starts[1] if len(starts) > 1 else len(number)
    if len(number) % period or not np.array_equal(number, np.arange(len(number)) % period + 1):
        raise FluxError(
            f"MMC: the first column of '{path}' must count faces from 1, once for each time gate. Give the file as mmc "
            "wrote it."
        )
    return table[:, 1]
