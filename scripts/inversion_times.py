"""CPU seconds of `invert` and `locate` on bodies of many vertices, the transport matrix made before.

    python scripts/inversion_times.py [--phantom FILE.ply] [--only invert,locate] [--cases WORDS]
        [-o docs/inversion_times.csv]

*invert*: an ellipsoid of the size of a mouse, 10,242 vertices with J_n of a source 3.5 mm deep, or the PLY given with
J_n as its first vertex attribute; 96 x 96 pixels a view. *locate*: the phantom of scenes/nylon_cylinder.toml, point
source at (8, 0, -1) mm, 4 views of 64 x 64 pixels, see location_coverage.py. 1000 electrons on the brightest pixel and
3.5 electrons of read noise; "noise only" has the read noise alone. Columns: CPU seconds of all threads, elapsed
seconds, those asked for on two idle cores, chi2, and what `locate` says where it refuses the images; largest memory of
the process until then [GB]. Coefficients known to 10 % are fitted along; nodes are those of the finite elements.
"""

from __future__ import annotations

import argparse
import csv
import logging
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import location_coverage as phantom
import numpy as np
import trimesh
from csv_table import write_rows
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.phantom.formats.ply import write_ply
from mitsuba_fspt.runtime.errors import InversionError
from mitsuba_fspt.tissue.phantom_file import PhantomFile, Spread

Array = NDArray[np.float64]
Row = dict[str, object]
Case = tuple[str, float, Callable[[], Any]]
ROOT = Path(__file__).resolve().parent.parent
READ_NOISE, ELECTRONS = 3.5, 1000.0
AXES = np.array([11.0, 11.0, 40.0])  # mm, of the ellipsoid
BANDS = {"red": (0.5, 0.0138, 0.91), "green": (0.3, 0.05, 1.1), "blue": (0.2, 0.1, 1.3)}  # share, mua, musp [1/mm]


def images(power: Array, per_watt: float, seed: int = 1) -> list[fspt.Image]:
    """Images with Poisson and read noise."""
    rng = np.random.default_rng(seed)
    counted = rng.poisson(power * per_watt) + READ_NOISE * rng.standard_normal(power.shape)
    metadata = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE}
    return [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]


def body(ply: Path | None) -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices [mm], faces and J_n [W/mm²] of a file, or of the ellipsoid."""
    if ply is not None:
        mesh = trimesh.load(ply, process=False)
        data = mesh.metadata["_ply_raw"]["vertex"]["data"]
        name = next(name for name in data.dtype.names if name not in ("x", "y", "z", "nx", "ny", "nz"))
        return np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(data[name], float).ravel()
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    vertices = mesh.vertices * AXES
    distance = np.linalg.norm(vertices - [AXES[0] - 3.5, 0, 5.0], axis=1)
    return vertices, mesh.faces, 1e-2 * np.exp(-distance / 3) / distance


def inverted(ply: Path | None, views: list[int]) -> tuple[fspt.TransportMatrix, Surface, Array]:
    """Matrix of the body in these views, its surface and the power on the pixels."""
    vertices, faces, exitance = body(ply)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.ply"
        write_ply(path, vertices, faces, {"exitance_x": exitance}, "vertex", {})
        scene = fspt.scene_xml(path, focal_length=50, f_number=2.8, width=96, height=96)
        matrix = fspt.transport(scene, view=views, rtol=1e-3)
        return matrix, Surface.of(matrix, scene), matrix.forward(exitance)


@cache
def located() -> tuple[fspt.TransportMatrix, Surface]:
    """Matrix of the cylinder in four views."""
    return phantom.matrix(phantom.ALL_ROUND)


def lit(band: str | None) -> Array:
    """Power on the pixels by the source in the cylinder."""
    return phantom.power(phantom.Case("", (phantom.NEAR,), phantom.ALL_ROUND, ELECTRONS), band)


def invert_rows(ply: Path | None) -> Iterator[Case]:
    """Two views without draws, four with 100."""
    for views, samples, asked in (([0, 90], 0, 20), ([0, 90, 180, 270], 100, 60)):
        matrix, surface, power = inverted(ply, views)
        given = images(power, ELECTRONS / power.max())
        name = f"invert, {len(surface.vertices)} vertices, {len(views)} views, {samples} draws"
        yield name, asked, lambda m=matrix, g=given, s=surface, n=samples: fspt.invert(m, g, scene=s, samples=n)


def locate_rows() -> Iterator[Case]:
    """One source, noise only, three bands, two sources where there is one."""
    matrix, surface = located()
    power = lit(None)
    per_watt = ELECTRONS / power.max()
    given, none = images(power, per_watt), images(0 * power, per_watt)
    phantom.BANDS = BANDS  # type: ignore[misc]
    coarse, fine = phantom.described(3.0), phantom.described(1.5)
    brightest = max(lit(band).max() for band in BANDS)
    several = {band: images(lit(band), ELECTRONS / brightest, k) for k, band in enumerate(BANDS)}
    matrices = dict.fromkeys(BANDS, matrix)
    yield "locate, 1 source", 15, lambda: fspt.locate(coarse, matrix, given, scene=surface)
    yield "locate, noise only", 30, lambda: fspt.locate(coarse, matrix, none, scene=surface)
    yield "locate, 3 bands", 60, lambda: fspt.locate(coarse, matrices, several, scene=surface)
    for name, mesh in (("edge 3 mm", coarse), ("edge 1.5 mm", fine)):
        name = f"locate, 2 sources on 1, {name}"
        yield name, 60, lambda mesh=mesh: fspt.locate(mesh, matrix, given, sources=2, scene=surface)
    known = Spread(0.1, 0.1)
    bands = {name: replace(band, spreads=(known,)) for name, band in coarse.bands.items()}
    for edge, model in ((1.5, "diffusion"), (1.5, "sp3"), (0.77, "diffusion")):
        mesh = replace(coarse, edge=edge, bands=bands, model=model)
        name = f"locate, 3 bands, coefficients known to 10 %, {model}, {nodes_of(mesh)} nodes"
        yield name, 180, lambda mesh=mesh: fspt.locate(mesh, matrices, several, scene=surface)


def nodes_of(described: PhantomFile) -> int:
    """Number of the nodes of its finite elements: vertices and middles of edges of the tetrahedra."""
    cells = np.sort(described.mesh().cells, axis=1)
    edges = np.concatenate([cells[:, [i, j]] for i in range(4) for j in range(i + 1, 4)])
    count = int(cells.max()) + 1
    return count + (len(np.unique(edges @ [count, 1])) if described.order == 2 else 0)


def timed(name: str, asked: float, work: Callable[[], Any]) -> Row:
    """One row: times of `work`, the result's chi2, or the message where it refuses."""
    cpu, elapsed = time.process_time(), time.perf_counter()
    try:
        chi2, refused = f"{work().chi2:.3f}", ""
    except InversionError as error:
        chi2, refused = "", str(error)
    row: Row = {
        "case": name,
        "cpu_seconds": round(time.process_time() - cpu, 1),
        "elapsed_seconds": round(time.perf_counter() - elapsed, 1),
        "asked_seconds": asked,
        "chi2": chi2,
        "refused": refused,
        "memory_gigabytes": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9, 2),
    }
    print("  ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    return row


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--phantom", type=Path, help="PLY with J_n on its vertices, in place of the ellipsoid.")
    parser.add_argument("--only", default="invert,locate", help="Verbs; rows of the others are kept.")
    parser.add_argument("--cases", default="", help="Text that the names of the cases contain; other rows are kept.")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "inversion_times.csv")
    arguments = parser.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)
    verbs = arguments.only.split(",")
    rows: dict[str, Row] = {}
    if arguments.output.exists():
        with arguments.output.open(encoding="utf-8") as file:
            rows = {
                row["case"]: {**row, "memory_gigabytes": row.get("memory_gigabytes", "")}
                for row in csv.DictReader(file)
            }
    made = {"invert": lambda: invert_rows(arguments.phantom), "locate": locate_rows}
    chosen = (case for verb in verbs for case in made[verb]() if arguments.cases in case[0])
    for row in (timed(*case) for case in chosen):
        rows[str(row["case"])] = row
        write_rows(arguments.output, rows.values())


if __name__ == "__main__":
    main()
