"""Reader of NIRFAST: text files with a common stem, without headers; fluence at the nodes of a tetrahedral mesh.

`.node`: `boundary x y z` (boundary 1 or 0; no number of the node, unlike TetGen's `.node`); `.elem`: four
node numbers from 1; `.param` (optional): a line with its kind, then a line per node, `mua kappa n` for kinds stnd
and blt, `mua kappa n mua kappa mua eta tau` for kind fluor; kind spec has no n. Lengths in mm.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError
from ..surface_mesh import Indices, Points
from .raw import RawMesh
from .table import read_table, whole_numbers

# Columns of a .param by its kind; the third one is n.
COLUMNS = {"stnd": 3, "blt": 3, "fluor": 8}
TETGEN = "A TetGen .node has to be converted, for example by meshio to VTU."


def read_nirfast(mesh: Path) -> RawMesh:
    """Mesh of `STEM.node` and `STEM.elem`, and the refractive index at the nodes from `STEM.param`.

    Raises
    ------
    FluxError : a file is missing or of another layout (TetGen's, or a mesh of triangles).
    """
    stem = mesh.with_suffix("") if mesh.suffix.lower() in (".node", ".elem", ".param") else mesh
    file = stem.with_name(f"{stem.name}.node")
    try:
        nodes, _ = read_table(file)
    except FluxError as cause:
        if not file.is_file():
            raise
        # TetGen's first line has as many columns as the others by chance only
        raise FluxError(f"NIRFAST: {cause} {TETGEN}") from cause
    elements, _ = read_table(stem.with_name(f"{stem.name}.elem"))
    if nodes.shape[1] != 4 or not np.isin(nodes[:, 0], (0, 1)).all():
        raise FluxError(
            f"NIRFAST: lines of '{stem}.node' must be 'boundary x y z', boundary 0 or 1, these have "
            f"{nodes.shape[1]} columns. {TETGEN}"
        )
    if elements.shape[1] != 4:
        raise FluxError(
            f"NIRFAST: '{stem}.elem' must have 4 columns (tetrahedra), it has {elements.shape[1]}. Meshes "
            "in the plane and bare surfaces have no exitance to render."
        )
    index = _index(stem.with_name(f"{stem.name}.param"), len(nodes))
    return nirfast_mesh(
        nodes[:, 1:], whole_numbers(elements, f"NIRFAST: node numbers of '{stem}.elem'"), f"NIRFAST {stem.name}", index
    )


def nirfast_mesh(nodes: Points, elements: Indices, source: str, index: NDArray[np.float64] | None = None) -> RawMesh:
    """Mesh of `nodes` (V, 3), `elements` (T, 4) from 1 and refractive `index` (V,); its values are fluence."""
    return RawMesh(nodes, elements - 1, source, quantity="fluence", index=index)


def _index(path: Path, nodes: int) -> NDArray[np.float64] | None:
    """Refractive index at the nodes from a `.param`, shape (V,), NaN if its kind has none; None without a file."""
    if not os.path.exists(path):
        return None
    with path.open(errors="replace") as file:
        kind = file.readline().strip().lower()
    if kind not in COLUMNS:
        return np.full(nodes, np.nan)
    parameters, _ = read_table(path, skip_lines=1)
    if parameters.shape != (nodes, COLUMNS[kind]):
        raise FluxError(
            f"NIRFAST: '{path}' of kind {kind} must have {COLUMNS[kind]} columns and {nodes} lines after its first, "
            f"it has {parameters.shape[1]} and {parameters.shape[0]}. Save it with its mesh anew."
        )
    return parameters[:, 2]
