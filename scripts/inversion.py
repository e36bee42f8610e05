"""J_n of the nylon cylinder from four noisy views, without the inverse crime: tables of error against light and stop.

    python scripts/inversion.py [--spp 1024] [--samples 200] [--tables light,stop,views] [-o docs/inversion.csv]

The pictures are of scenes/nylon_cylinder.ply (45,002 vertices), by Mitsuba's `path`, 96 x 96 pixels a view; counts by
`expose`, with 3.5 electrons of read noise. The inversion uses another mesh of the same cylinder (edges of 1 mm) with
its own transport matrix. Its total is compared over what is seen, its J_n with the fine one at the nearest vertices.

Columns: electrons on the brightest pixel, bias of the seen total [%], half of its 90 % interval [%], relative L2 error
of J_n [%], chi2, seconds without and with samples. *light*: 100, 1e3, 1e4 electrons at f/2.8. *stop*: f/1.4 … f/16 at
the exposure time of 1e3 electrons at f/2.8. *views*: 1, 2, 4, 8 of them at 1e3 electrons.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.phantom.surface_mesh import boundary, compact
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
FINE = ROOT / "scenes" / "nylon_cylinder.xml"
FILM = {"width": 96, "height": 96, "pixel_pitch": 0.288}
WAVELENGTH_NM = 660.0
CCD = replace(fspt.Detector.typical_ccd(), dark_current=0.0, full_well=1e6, bits=16)


def coarse_scene(folder: Path, edge: float) -> Path:
    """Scene file with another mesh of the cylinder in the folder; its J_n has no effect."""
    scene, mesh = folder / f"cylinder_{edge:g}.xml", folder / f"cylinder_{edge:g}.ply"
    solid = cylinder_tetrahedra(15.0, 30.0, edge)
    faces, _ = boundary(solid.vertices, solid.cells)
    vertices, faces, _ = compact(solid.vertices, faces)
    fspt.Phantom(vertices, faces, np.ones(len(vertices)), "vertex").write(mesh)
    scene.write_text(FINE.read_text(encoding="utf-8").replace("nylon_cylinder.ply", mesh.name), encoding="utf-8")
    return scene


@cache
def pictures(f_number: float, views: tuple[int, ...], spp: int) -> tuple[fspt.Image, ...]:
    """Views of the fine mesh by Monte Carlo [W per W of source]."""
    found = []
    for view in views:
        scene = fspt.load(FINE, f_number=f_number, view=view, **FILM)
        image = fspt.render(scene, method="path", spp=spp, seed=1000 + view)
        found.append(fspt.Image(image.power, metadata={"pixel_pitch": FILM["pixel_pitch"]}))
    return tuple(found)


@cache
def matrix_of(scene: Path, f_number: float, views: tuple[int, ...], rtol: float) -> fspt.TransportMatrix:
    """Transport matrix of the coarse mesh."""
    return fspt.transport(scene, view=list(views), f_number=f_number, rtol=rtol, **FILM)


def counted(images: tuple[fspt.Image, ...], watt: float, seed: int) -> list[fspt.Image]:
    """Exposures of one second to the images of a source of so many watts, reduced from their counts."""
    found = []
    for k, image in enumerate(images):
        exposure = CCD.expose(image.scaled(watt), 1.0, WAVELENGTH_NM, seed=seed + k)
        settings = {"exposure_time": 1.0, "wavelength_nm": WAVELENGTH_NM, "pixel_pitch": FILM["pixel_pitch"]}
        found.append(CCD.reduce(exposure.counts, **settings))
    return found


def source_power(images: tuple[fspt.Image, ...], electrons: float) -> float:
    """Source power [W] that puts so many electrons on the brightest pixel in one second."""
    return electrons / max(float(CCD.expected(image, 1.0, WAVELENGTH_NM).mean.max()) for image in images)


def row(matrix: fspt.TransportMatrix, images: list[fspt.Image], watt: float, samples: int) -> dict[str, float]:
    """Errors of the inversion against J_n of the fine mesh."""
    start = time.perf_counter()
    plain = fspt.invert(matrix, images)
    seconds = time.perf_counter() - start
    start = time.perf_counter()
    found = fspt.invert(matrix, images, samples=samples, seed=1)
    with_samples = time.perf_counter() - start
    fine = fspt.Phantom.read(ROOT / "scenes" / "nylon_cylinder.ply")
    surface: Surface = plain.surface
    distance, nearest = cKDTree(fine.vertices).query(surface.vertices, k=4)
    share = 1 / np.maximum(distance, 1e-6) ** 2
    true = watt * (share * fine.exitance[nearest]).sum(axis=1) / share.sum(axis=1)
    seen, areas = plain.seen, matrix.areas
    total = areas[seen] @ true[seen]
    low, high = found.total_interval
    difference = (plain.solution - true)[seen]
    return {
        "bias_percent": 100 * (plain.total / total - 1),
        "half_width_percent": 100 * (high - low) / 2 / total,
        "holds": float(low <= total <= high),
        "l2_percent": 100 * float(np.sqrt(areas[seen] @ difference**2 / (areas[seen] @ true[seen] ** 2))),
        "covered_area": float(areas[seen] @ ((found.lower <= true) & (true <= found.upper))[seen] / areas[seen].sum()),
        "seen": float(areas[seen].sum() / areas.sum()),
        "chi2": plain.chi2,
        "seconds": seconds,
        "seconds_with_samples": with_samples,
    }


def rows(tables: list[str], folder: Path, spp: int, samples: int, edge: float) -> list[dict[str, object]]:
    """Rows of the chosen tables."""
    scene = coarse_scene(folder, edge)
    four = (0, 90, 180, 270)
    cases: list[tuple[str, float, tuple[int, ...], float]] = []
    if "light" in tables:
        cases += [("light", 2.8, four, electrons) for electrons in (1e2, 1e3, 1e4)]
    if "stop" in tables:
        cases += [("stop", f_number, four, np.nan) for f_number in (1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)]
    if "views" in tables:
        cases += [("views", 2.8, tuple(range(0, 360, 360 // n)), 1e3) for n in (1, 2, 4, 8)]
    found: list[dict[str, object]] = []
    for table, f_number, views, electrons in cases:
        images = pictures(f_number, views, spp)
        watt = source_power(images, electrons) if table != "stop" else source_power(pictures(2.8, four, spp), 1e3)
        peak = watt / source_power(images, 1.0)
        matrix = matrix_of(scene, f_number, views, 1e-3)
        numbers = row(matrix, counted(images, watt, 17), watt, samples)
        found.append(
            {"table": table, "f_number": f_number, "views": len(views), "electrons": round(peak)}
            | {name: float(f"{value:.4g}") for name, value in numbers.items()}
        )
        print(found[-1], flush=True)
    return found


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spp", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--edge", type=float, default=1.0)
    parser.add_argument("--tables", default="light,stop,views")
    parser.add_argument("--folder", type=Path, default=Path("out"))
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "inversion.csv")
    arguments = parser.parse_args()
    arguments.folder.mkdir(exist_ok=True)
    table = rows(arguments.tables.split(","), arguments.folder, arguments.spp, arguments.samples, arguments.edge)
    with arguments.output.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, table[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
