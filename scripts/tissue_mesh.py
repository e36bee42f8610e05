"""SP3 and the diffusion equation against photons one by one in a body of one's own: a closed surface mesh.

    python scripts/tissue_mesh.py MESH --source X,Y,Z [--mua 0.03] [--musp 1] [--n 1.37] [--g 0] [--photons 4e6]
        [--edge 1.5] [--bin 2]

MESH is a closed surface with outward normals [mm], of any format of `fspt flux import`, filled by the mesher fTetWild
(pip install 'mitsuba-fspt[mesher]'). Prints the exit power of 1 W by photons with its standard error, and for both
models the deviations [%] of the total and of J_n by bins: parts of the surface in shells of `--bin` [mm] of the
distance from the source, whose standard error is below 1 %; of these the brightest, and the largest deviation beyond
twice the standard error.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.phantom.formats import read_mesh
from mitsuba_fspt.phantom.surface_mesh import face_areas
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.tissue.diffusion import solve
from mitsuba_fspt.tissue.light_models import MODELS
from mitsuba_fspt.tissue.mesher import tetrahedralize

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from photon_walk import BATCHES, Emitter, Filled, Optics, exit_power  # noqa: E402

Array = NDArray[np.float64]
Index = NDArray[np.int64]
KNOWN = 0.01  # largest relative standard error of a bin that counts
PARTS = 4  # of an edge: each face is PARTS² triangles, whose centres are the nodes of ∫ J_n dS


def surface_nodes(vertices: Array, faces: Index) -> tuple[Array, Array]:
    """Points (N, 3) [mm] on the faces and their areas (N,) [mm²]."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(PARTS) for j in range(PARTS - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(PARTS - 1) for j in range(PARTS - 1 - i)]
    local = np.array(up + down) / PARTS
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    x, y = local.T[:, :, None, None]
    points = first + x * (second - first) + y * (third - first)
    return points.reshape(-1, 3), np.tile(face_areas(vertices, faces) / len(local), len(local))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("mesh", type=Path, help="closed surface [mm]")
    options.add_argument("--source", required=True, help="position of the point source, X,Y,Z [mm]")
    options.add_argument("--mua", type=float, default=0.03, help="[1/mm]")
    options.add_argument("--musp", type=float, default=1.0, help="[1/mm]")
    options.add_argument("--n", type=float, default=1.37)
    options.add_argument("--g", type=float, default=0.0)
    options.add_argument("--photons", type=float, default=4e6)
    options.add_argument("--edge", type=float, default=1.5, help="of the tetrahedra [mm]")
    options.add_argument("--bin", type=float, default=2.0, help="thickness of the shells [mm]")
    given = options.parse_args()
    raw = read_mesh(given.mesh, None, None, "auto")
    at = tuple(float(value) for value in given.source.split(","))
    points, areas = surface_nodes(raw.points, raw.cells)
    distance = np.linalg.norm(points - at, axis=1)
    count, own = int(distance.max() / given.bin) + 2, (distance / given.bin).astype(int)
    centre = mi.Point3f(*(dr.opaque(mi.Float, value) for value in at))

    def bin_of(p: mi.Point3f) -> mi.UInt32:
        return dr.minimum(mi.UInt32(dr.norm(p - centre) / given.bin), count - 1)

    photons, start = int(given.photons) // BATCHES * BATCHES, time.process_time()
    optics = Optics(given.mua, given.musp, given.n, given.g)
    batches = exit_power(Filled.of(raw.points, raw.cells), optics, Emitter(at), bin_of, count, photons)
    power, error = batches.mean(axis=0), batches.std(axis=0, ddof=1) / math.sqrt(BATCHES)
    total, total_error = batches.sum(axis=1).mean(), batches.sum(axis=1).std(ddof=1) / math.sqrt(BATCHES)
    known = np.flatnonzero(error < KNOWN * power)
    area = np.bincount(own, areas, count)
    brightest = known[np.argmax(power[known] / area[known])]
    print(f"{photons} photons: exit power {total:.5f} ± {total_error:.5f}, nearest point of the surface", end=" ")
    print(f"{distance.min():.2f} mm, {len(known)} bins, {time.process_time() - start:.0f} CPU s", flush=True)
    start = time.process_time()
    mesh = tetrahedralize(raw.points, raw.cells, given.edge)
    print(f"{len(mesh.cells)} tetrahedra, {time.process_time() - start:.0f} CPU s", flush=True)
    for model in MODELS:
        start = time.process_time()
        medium = Medium(given.mua, given.musp, given.n, given.g)
        solution = solve(mesh, [medium], [Source(Sphere(at))], model=model)
        seconds = time.process_time() - start
        values = np.bincount(own, areas * solution.exitance_at(points), count)
        deviation = 100 * (values[known] / power[known] - 1)
        beyond = np.maximum(np.abs(deviation) - 200 * error[known] / power[known], 0) * np.sign(deviation)
        print(f"{model}: total {100 * (solution.solved.exited / total - 1):+.1f} %", end=", ")
        print(f"brightest bin {deviation[list(known).index(brightest)]:+.1f} %", end=", ")
        print(f"bins {beyond[np.argmax(np.abs(beyond))]:+.1f} %, {seconds:.0f} CPU s", flush=True)
        print(f"  J_n by bins [%] {np.round(deviation, 1).tolist()}", flush=True)


if __name__ == "__main__":
    main()
