"""Intervals of `invert` on coarse meshes: how often they contain J_n of a spot, with the error of the mesh and without.

    python scripts/mesh_error.py [--seeds 40] [--electrons 1000] [-o docs/mesh_error.csv]

A sphere of 6 mm radius with a light source 2 mm below its surface, one view of 64 x 64 pixels, electrons on the
brightest pixel as given, 3.5 electrons of read noise. `invert` takes J_n linear on the faces of a mesh of 2562 or
10,242 vertices. The images are those of 40,962 vertices: of the same triangles, divided, with J_n of the point of the
sphere above each vertex, so that only J_n between the vertices differs; or of the sphere, whose shape differs, too.
Regions are the vertices within 10, 15 and 30 degrees of the spot; their true sum is Σ areas · J_n at the vertices.
Columns: `mesh_error` of the result, share of warnings of a coarse mesh; mean difference of the sums from the true ones
and its standard error [%], half-width of their 90 % intervals [%] and share that contains the true sum; both again
without the error of the mesh (Eq. M.42).
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from csv_table import write_rows
from interval_calibration import SCENE
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse import invert
from mitsuba_fspt.inverse.mesh_error import MeshError
from mitsuba_fspt.inverse.surface import Surface

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
RADIUS, DEPTH, SIDE, READ_NOISE = 6.0, 2.0, 64, 3.5
REGIONS = (10, 15, 30)  # degrees
LEVELS = (4, 5)  # subdivisions of an icosahedron: 2562 and 10,242 vertices; images have 6


def sphere(level: int, divided: int = 0) -> trimesh.Trimesh:
    """Icosahedron divided `level` times with its vertices on the sphere, and `divided` times in its planes."""
    found = trimesh.creation.icosphere(subdivisions=level, radius=RADIUS)
    for _ in range(divided):
        found = found.subdivide()
    return found


@cache
def matrix(level: int, divided: int = 0) -> tuple[fspt.TransportMatrix, Surface]:
    """Transport matrix of such a mesh, and its surface."""
    with tempfile.TemporaryDirectory() as folder:
        ply, xml = Path(folder) / "sphere.ply", Path(folder) / "sphere.xml"
        sphere(level, divided).export(ply)
        pitch = '<float name="pixel_pitch" value="{}"/>'
        text = SCENE.format(ply=ply).replace('"16"', f'"{SIDE}"').replace(pitch.format(0.5), pitch.format(8 / SIDE))
        xml.write_text(text)
        found = fspt.transport(xml, view=[0], rtol=1e-3)
        return found, Surface.of(found)


def exitance(vertices: Array) -> Array:
    """J_n [W/mm²] of the spot at the points of the sphere above the vertices."""
    on_sphere = RADIUS * vertices / np.linalg.norm(vertices, axis=1)[:, None]
    distance = np.linalg.norm(on_sphere - [RADIUS - DEPTH, 0, 0], axis=1)
    return 1e-2 * np.exp(-distance / 3) / distance


@contextmanager
def linear() -> Iterator[None]:
    """`invert` without the error of the mesh."""
    own = MeshError.of
    invert.MeshError.of = lambda surface, values: MeshError(np.zeros_like(values), 1.0)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        invert.MeshError.of = own  # type: ignore[attr-defined]


def cases(level: int, truth: str, seeds: int, electrons: float) -> list[dict[str, object]]:
    """One row for each region of one mesh and one kind of images."""
    used, surface = matrix(level)
    of_images, whole = matrix(level, 6 - level) if truth == "same triangles" else matrix(6)
    true, power = exitance(surface.vertices), of_images.forward(exitance(whole.vertices))
    per_watt, sums = electrons / power.max(), np.empty((2, seeds, len(REGIONS), 3))
    angle = np.degrees(np.arccos(surface.vertices[:, 0] / np.linalg.norm(surface.vertices, axis=1)))
    errors, told = [], 0
    for seed in range(seeds):
        rng = np.random.default_rng([seed, level])
        counted = rng.poisson(power * per_watt) + READ_NOISE * rng.standard_normal(power.shape)
        metadata = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE}
        images = [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]
        found = fspt.invert(used, images, samples=200, seed=seed, scene=surface)
        with linear():
            plain = fspt.invert(used, images, samples=200, seed=seed, scene=surface)
        errors.append(found.mesh_error)
        told += any("the mesh is coarse" in line for line in found.warnings)
        for k, one in enumerate((found, plain)):
            for j, region in enumerate(REGIONS):
                weights = np.where(one.seen & (angle < region), used.areas, 0)
                sums[k, seed, j] = np.array([weights @ one.solution, *one.interval(weights)]) / (weights @ true) - 1
    rows = []
    for j, region in enumerate(REGIONS):
        value, low, high = sums[:, :, j].transpose(2, 0, 1)
        inside, half = np.mean((low <= 0) & (high >= 0), axis=1), 100 * np.mean(high - low, axis=1) / 2
        rows.append(
            {
                "vertices": len(surface.vertices),
                "images": truth,
                "region_degrees": region,
                "electrons": electrons,
                "seeds": seeds,
                "mesh_error": round(float(np.mean(errors)), 3),
                "told": told / seeds,
                "difference_percent": round(100 * float(value[0].mean()), 3),
                "standard_error_percent": round(100 * float(value[0].std(ddof=1)) / seeds**0.5, 3),
                "half_width_percent": round(float(half[0]), 3),
                "inside": inside[0],
                "half_width_without_percent": round(float(half[1]), 3),
                "inside_without": inside[1],
            }
        )
        print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    return rows


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--electrons", type=float, default=1000.0)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "mesh_error.csv")
    arguments = parser.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)
    rows = [
        row
        for level in LEVELS
        for truth in ("same triangles", "sphere")
        for row in cases(level, truth, arguments.seeds, arguments.electrons)
    ]
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
