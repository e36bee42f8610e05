"""J_n of the nylon cylinder from noisy views: tables of the error against light, f-number and further conditions.

    python scripts/inversion.py [--spp 1024] [--samples 200] [--seeds 3] [--pixels 96] [--tables light,stop]
        [-o docs/inversion.csv]

Images and inversion share neither mesh nor method. The images are of scenes/nylon_cylinder.ply (45,002 vertices), by
Mitsuba's `path`, on 96 x 96 pixels per view (or `--pixels`) of the same field; `expose` makes counts of them, with 3.5
electrons of read noise. The inversion uses another mesh of the same cylinder (edges of 1 mm) and its transport matrix.
The total is compared over the seen part of the surface, J_n with that of the fine mesh at the nearest vertices.

Columns: electrons on the brightest pixel, bias of the seen total [%], half of its 90 % interval [%], share of the
intervals that contain the total, relative L2 error of J_n [%], chi2; for *light* also the processor time [s] without
and with random draws. Values are means over the seeds of the counts. *light*: 100, 1e3, 1e4 electrons at f/2.8. *stop*:
f/1.4 … f/16 at the exposure time of 1e3 electrons at f/2.8. *views*: 1, 2, 4, 8 views. *gain*: counts that are too high
by 1 and 3 %, with `gain_error` 0 or the same value. *pose*: a matrix of views turned by 0.1, 0.3 and 1 degrees from the
true ones. *law*: images with Fresnel's exit law, a matrix with Lambert's. The last four are at 1e3 electrons and f/2.8.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from csv_table import write_rows
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.phantom.surface_mesh import boundary, compact
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
FINE = ROOT / "scenes" / "nylon_cylinder.xml"
FIELD = 27.648  # mm: the detector's width
FILM = {"width": 96, "height": 96, "pixel_pitch": FIELD / 96}
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
def pictures(f_number: float, views: tuple[int, ...], spp: int, law: str = "lambert") -> tuple[fspt.Image, ...]:
    """Views of the fine mesh by Monte Carlo [W per W of source]."""
    text = FINE.read_text(encoding="utf-8").replace("nylon_cylinder.ply", str(FINE.with_suffix(".ply")))
    lines = f'<emitter type="fspt_surface"> <string name="emission" value="{law}"/>'
    text = text.replace(
        '<emitter type="fspt_surface">', lines + ' <float name="int_ior" value="1.37"/>' * (law != "lambert")
    )
    found = []
    for view in views:
        scene = fspt.load(text, f_number=f_number, view=view, **FILM)
        image = fspt.render(scene, method="path", spp=spp, seed=1000 + view)
        found.append(fspt.Image(image.power, metadata={"pixel_pitch": FILM["pixel_pitch"]}))
    return tuple(found)


@cache
def matrix_of(scene: Path, f_number: float, views: tuple[float, ...], rtol: float) -> fspt.TransportMatrix:
    """Transport matrix of the coarse mesh."""
    return fspt.transport(scene, view=list(views), f_number=f_number, rtol=rtol, **FILM)


def counted(images: tuple[fspt.Image, ...], watt: float, seed: int, gain: float, error: float) -> list[fspt.Image]:
    """Exposures of one second to the images of a source of so many watts, reduced from their counts.

    The powers are `gain` times too large; `error` is the gain error that they state.
    """
    found = []
    for k, image in enumerate(images):
        exposure = CCD.expose(image.scaled(watt), 1.0, WAVELENGTH_NM, seed=seed + k)
        settings = {"exposure_time": 1.0, "wavelength_nm": WAVELENGTH_NM, "pixel_pitch": FILM["pixel_pitch"]}
        reduced = CCD.reduce(exposure.counts, **settings)
        metadata = reduced.metadata | {"electrons_per_watt": reduced.metadata["electrons_per_watt"] / gain}
        found.append(fspt.Image(gain * reduced.power, metadata=metadata | {"gain_error": error}, mask=reduced.mask))
    return found


def source_power(images: tuple[fspt.Image, ...], electrons: float) -> float:
    """Source power [W] that puts so many electrons on the brightest pixel in one second."""
    return electrons / max(float(CCD.expected(image, 1.0, WAVELENGTH_NM).mean.max()) for image in images)


def row(matrix: fspt.TransportMatrix, images: list[fspt.Image], watt: float, samples: int) -> dict[str, float]:
    """Errors of the inversion against J_n of the fine mesh."""
    start = time.process_time()
    plain = fspt.invert(matrix, images)
    seconds = time.process_time() - start
    start = time.process_time()
    found = fspt.invert(matrix, images, samples=samples, seed=1)
    with_samples = time.process_time() - start
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
        "cpu_seconds": seconds,
        "cpu_seconds_with_samples": with_samples,
    }


@dataclass(frozen=True)
class Case:
    """One row: views, light, and the errors of the matrix or of the counts.

    electrons : on the brightest pixel; None: at the exposure time of 1e3 electrons at f/2.8
    turned : degrees by which the views of the matrix differ;  gain : factor on the powers, `gain_error` stated for it
    """

    table: str
    f_number: float = 2.8
    views: tuple[int, ...] = (0, 90, 180, 270)
    electrons: float | None = 1e3
    turned: float = 0.0
    gain: float = 1.0
    gain_error: float = 0.0
    law: str = "lambert"


CASES = (
    *(Case("light", electrons=electrons) for electrons in (1e2, 1e3, 1e4)),
    *(Case("stop", f_number=f_number, electrons=None) for f_number in (1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)),
    *(Case("views", views=tuple(range(0, 360, 360 // n))) for n in (1, 2, 4, 8)),
    *(Case("gain", gain=1 + wrong, gain_error=stated) for wrong in (0.01, 0.03) for stated in (0.0, wrong)),
    *(Case("pose", turned=turned) for turned in (0.0, 0.1, 0.3, 1.0)),
    *(Case("law", law=law) for law in ("lambert", "fresnel")),
)


def numbers_of(case: Case, scene: Path, spp: int, samples: int, seeds: int, report: Path | None) -> dict[str, object]:
    """One row of a table, means over the seeds of the counts."""
    images = pictures(case.f_number, case.views, spp, case.law)
    if case.electrons is None:
        watt = source_power(pictures(2.8, case.views, spp), 1e3)
    else:
        watt = source_power(images, case.electrons)
    matrix = matrix_of(scene, case.f_number, tuple(view + case.turned for view in case.views), 1e-3)
    if report and case == Case("light"):
        fspt.invert(matrix, counted(images, watt, 17, 1.0, 0.0)).report(report)
    each = [
        row(matrix, counted(images, watt, 17 + 100 * seed, case.gain, case.gain_error), watt, samples)
        for seed in range(seeds)
    ]
    numbers = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
    if case.table != "light":
        numbers = {name: value for name, value in numbers.items() if not name.startswith("cpu_seconds")}
    setting = {name: value for name, value in asdict(case).items() if name not in ("views", "electrons")}
    peak = round(watt / source_power(images, 1.0))
    found = setting | {"views": len(case.views), "electrons": peak, "seeds": seeds}
    return found | {name: float(f"{value:.4g}") for name, value in numbers.items()}


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spp", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--edge", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pixels", type=int, default=FILM["width"], help="a side")
    parser.add_argument("--tables", default="light", help="Among light, stop, views, gain, pose, law.")
    parser.add_argument("--report", type=Path, help="Picture of the row of 1e3 electrons of `light`, .png.")
    parser.add_argument("--folder", type=Path, default=Path("out"))
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "inversion.csv")
    arguments = parser.parse_args()
    FILM.update(width=arguments.pixels, height=arguments.pixels, pixel_pitch=FIELD / arguments.pixels)
    arguments.folder.mkdir(exist_ok=True)
    scene, table = coarse_scene(arguments.folder, arguments.edge), []
    for case in (case for case in CASES if case.table in arguments.tables.split(",")):
        table.append(numbers_of(case, scene, arguments.spp, arguments.samples, arguments.seeds, arguments.report))
        print(table[-1], flush=True)
    write_rows(arguments.output, table)


if __name__ == "__main__":
    main()
