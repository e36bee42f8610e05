"""Coverage of the intervals of `invert`: simulation-based calibration, and fixed J_n with the default weight.

    python scripts/interval_calibration.py [--replicates 400] [--fixed 500] [--samples 200] [--workers 2]

A sphere of 642 vertices, 4 views of 16 x 16 pixels. The images come from a transport matrix of rtol 1e-4, the
inversion uses one of rtol 3e-3: its numerical error is part of the test. *Prior*: J_n is drawn from the penalty's own
prior (mean 1e-3 W/mm², correlation length 3 mm, standard deviation about 15 %), the weight is given. *Fixed*: three
distributions of J_n, the weight is found. Columns: share of the 90 %
intervals that contain the true value, for vertices, for eight octants, and for the total; with 500 replicates the last
share has a standard deviation of 1.4 %.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from csv_table import write_rows
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.smoothness import Prior, Smoothness
from mitsuba_fspt.inverse.surface import Surface

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
MEAN, LENGTH, DEVIATION = 1e-3, 3.0, 0.15  # [W/mm²], [mm], relative
RADIUS = 6.0
READ_NOISE, GAIN_ERROR = 3.5, 0.001
TRUTHS = ("prior", "spot", "two spots", "gradient")
LEVELS = (30.0, 300.0, 3000.0)  # electrons on the brightest pixel

SCENE = """<scene version="3.0.0">
    <default name="view" value="0"/>
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/><float name="f_number" value="2.8"/>
        <float name="magnification" value="0.5"/><float name="pixel_pitch" value="0.5"/>
        <transform name="to_world"><lookat origin="165, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
            <string name="pixel_format" value="luminance"/></film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="{ply}"/><boolean name="face_normals" value="true"/>
        <transform name="to_world"><rotate z="1" angle="$view"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>
</scene>"""


@dataclass(frozen=True, eq=False)
class Case:
    """Matrix of the images, matrix of the inversion, its surface, penalty, and the weight of the prior [mm²]."""

    true: fspt.TransportMatrix
    used: fspt.TransportMatrix
    surface: Surface
    smooth: Smoothness
    weight: float


@cache
def case(subdivisions: int = 3) -> Case:
    """The case, made once a process."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    with tempfile.TemporaryDirectory() as folder:
        ply, xml = Path(folder) / "sphere.ply", Path(folder) / "sphere.xml"
        sphere.export(ply)
        xml.write_text(SCENE.format(ply=ply))
        views = [0, 90, 180, 270]
        true, used = (fspt.transport(xml, view=views, rtol=rtol) for rtol in (1e-4, 3e-3))
        surface = Surface.of(used)
    # For κ² − Δ on a plane the variance is 1/(4π κ² w): w for the standard deviation wanted.
    weight = LENGTH**2 / (4 * np.pi * DEVIATION**2)
    return Case(true, used, surface, Smoothness.of(surface, LENGTH), weight)


def drawn(found: Case, rng: np.random.Generator) -> Array:
    """J_n (n,) [W/mm²] of the prior: mean + (κ² − Δ)⁻¹ white noise, drawn again where it is not > 0."""
    solve = splu(found.smooth.root.tocsc()).solve
    while True:
        x = 1 + solve(rng.standard_normal(found.surface.unknowns)) / np.sqrt(found.weight)
        if x.min() > 0:
            return MEAN * x[found.surface.number]


def fixed(found: Case, name: str) -> Array:
    """J_n (n,) [W/mm²] of one of the fixed distributions, which are not drawn from a prior."""
    if name == "spot":  # light 3 mm below the surface, in front
        distance = np.linalg.norm(found.surface.vertices - [RADIUS - 3, 0, 0], axis=1)
        return 1e-2 * np.exp(-distance / 3) / distance
    if name == "two spots":
        return sum(  # type: ignore[return-value]
            5e-3 * np.exp(-np.linalg.norm(found.surface.vertices - at, axis=1) / 2.5)
            for at in ([3, 2, 1], [-2, -3, -1])
        )
    return MEAN * (1 + 0.5 * found.surface.vertices[:, 2] / RADIUS)  # "gradient"


def replicate(truth: str, electrons: float, seed: int, samples: int) -> tuple[float, list[bool], bool, float, float]:
    """Coverage of vertices, of octants, of the total; error of the total and half of its interval, over the total."""
    found, rng = case(), np.random.default_rng([seed, int(electrons)])
    exitance = drawn(found, rng) if truth == "prior" else fixed(found, truth)
    power = found.true.forward(exitance)
    per_watt = electrons / power.max()
    gain = 1 + GAIN_ERROR * rng.standard_normal()
    counted = rng.poisson(power * per_watt / gain) + READ_NOISE * rng.standard_normal(power.shape)
    meta = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE, "gain_error": GAIN_ERROR}
    images = [fspt.Image(plane / per_watt, metadata=meta) for plane in counted]
    options = {"weight": found.weight, "prior": Prior(LENGTH, MEAN, MEAN)} if truth == "prior" else {}
    r = fspt.invert(found.used, images, samples=samples, seed=seed, scene=found.surface, **options)
    seen, areas = r.seen, found.used.areas
    inside = float(np.mean(((r.lower <= exitance) & (exitance <= r.upper))[seen]))
    octants = []
    for sign in np.ndindex(2, 2, 2):
        part = seen & ((found.surface.vertices > 0) == np.array(sign, bool)).all(axis=1)
        low, high = r.interval(areas * part)
        octants.append(bool(low <= (areas * part) @ exitance <= high))
    total, (low, high) = areas[seen] @ exitance[seen], r.total_interval
    return inside, octants, bool(low <= total <= high), r.total / total - 1, (high - low) / 2 / total


def table(
    truths: list[str], replicates: int, fixed_replicates: int, samples: int, workers: int
) -> list[dict[str, object]]:
    """One row for each truth and level of light."""
    rows = []
    with ProcessPoolExecutor(workers) as pool:
        for truth in truths:
            count = replicates if truth == "prior" else fixed_replicates
            for electrons in LEVELS:
                jobs = [(truth, electrons, seed, samples) for seed in range(count)]
                results = list(pool.map(replicate, *zip(*jobs, strict=True), chunksize=5))
                inside, octants, total, errors, halves = zip(*results, strict=True)
                rows.append(
                    {
                        "truth": truth,
                        "electrons": electrons,
                        "replicates": count,
                        "vertices": round(float(np.mean(inside)), 4),
                        "regions": round(float(np.mean(octants)), 4),
                        "totals": round(float(np.mean(total)), 4),
                        "total_bias_percent": round(100 * float(np.mean(errors)), 4),
                        "total_half_width_percent": round(100 * float(np.mean(halves)), 4),
                    }
                )
                print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    return rows


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=400)
    parser.add_argument("--truths", default=",".join(TRUTHS), help="Rows of the others are kept.")
    parser.add_argument("--fixed", type=int, default=500)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "interval_calibration.csv")
    arguments = parser.parse_args()
    truths = arguments.truths.split(",")
    kept: list[dict[str, object]] = []
    if arguments.output.exists():
        with arguments.output.open(encoding="utf-8") as file:
            kept = [dict(row) for row in csv.DictReader(file) if row["truth"] not in truths]
    rows = kept + table(truths, arguments.replicates, arguments.fixed, arguments.samples, arguments.workers)
    rows.sort(key=lambda row: TRUTHS.index(str(row["truth"])))
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
