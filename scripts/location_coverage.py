"""Coverage of the intervals of `locate`: how often they contain the true position and power of a source.

    python scripts/location_coverage.py [--seeds 60] [--edge 3] [--workers 2] [-o docs/location_coverage.csv]

The phantom is that of scenes/nylon_cylinder.toml with a point source at (8, 0, -1) mm, or two; the camera that of
scenes/nylon_cylinder.xml at f/2.8 with 64 x 64 pixels. J_n of the images is an exact series for the cylinder
(tests/cylinder_diffusion.py), that of `locate` from finite elements; the equation is the same, and `locate` takes it as
exact. The images have Poisson noise, 3.5 electrons of read noise and as many electrons on the brightest pixel as the
table says; a band "green" has more absorption than the phantom file's own coefficients. Columns: share of the 90 %
intervals that contain the true value, of x, y, z and the power, and of all; mean of z² = ((value − true)/sd)²; mean sd
of x, y, z [mm] and of power [%]; mean chi2; median time of `locate` [s], other processes at work.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import tests_folder  # noqa: F401
from csv_table import write_rows
from cylinder_diffusion import Phantom, exitance
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.source_fit import LocationSettings
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.optics.media import Medium
from mitsuba_fspt.tissue.phantom_file import Band, PhantomFile

ROOT = Path(__file__).resolve().parent.parent

Array = NDArray[np.float64]
Row = dict[str, object]
SCENE = ROOT / "scenes" / "nylon_cylinder.xml"
CAMERA = {"f_number": 2.8, "width": 64, "height": 64, "pixel_pitch": 0.432}
READ_NOISE = 3.5
ALL_ROUND, FRONT = (0, 90, 180, 270), (0,)
BANDS: Mapping[str, tuple[float, float, float]] = {"red": (0.6, 0.0138, 0.91), "green": (0.4, 0.05, 1.1)}
NEAR, OTHER = (8.0, 0.0, -1.0, 2.0), (6.0, 4.0, 3.0, 1.0)  # x, y, z [mm], power [W]


@dataclass(frozen=True)
class Case:
    """Sources (x, y, z [mm], power [W]), views [degree], electrons on the brightest pixel, names of the bands."""

    name: str
    sources: tuple[tuple[float, float, float, float], ...]
    views: tuple[int, ...]
    electrons: float
    bands: tuple[str, ...] = ()


CASES = (
    Case("4 views, 30 electrons", (NEAR,), ALL_ROUND, 30),
    Case("4 views, 1000 electrons", (NEAR,), ALL_ROUND, 1000),
    Case("4 views, 1000 electrons, 2 sources", (NEAR, OTHER), ALL_ROUND, 1000),
    Case("1 view, 1000 electrons", (NEAR,), FRONT, 1000),
    Case("1 view, 1000 electrons, 2 bands", (NEAR,), FRONT, 1000, ("red", "green")),
)


def described(edge: float) -> PhantomFile:
    """The phantom, with bands and an edge [mm] of the tetrahedra."""
    bands = {name: Band(share, (Medium(mua, musp, 1.37),)) for name, (share, mua, musp) in BANDS.items()}
    return replace(PhantomFile.read(SCENE.with_suffix(".toml")), edge=edge, bands=bands)


@cache
def matrix(views: tuple[int, ...]) -> tuple[fspt.TransportMatrix, Surface]:
    """Transport matrix of the views, and its surface; made once a process."""
    found = fspt.transport(SCENE, view=list(views), rtol=1e-3, **CAMERA)
    return found, Surface.of(found)


@cache
def power(case: Case, band: str | None) -> Array:
    """(views, h, w) [W] on the pixels, from the exact series."""
    transport, surface = matrix(case.views)
    share, mua, musp = BANDS[band] if band else (1.0, 0.0138, 0.91)
    total = np.zeros(len(surface.vertices))
    for x, y, z, watts in case.sources:
        far, angle = np.hypot(x, y), np.arctan2(y, x)
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        phantom = Phantom(mua=mua, musp=musp, source_x=far, source_z=z, source_diameter=0.0)
        total += share * watts * exitance(phantom, surface.vertices @ turn.T)
    return transport.forward(total)


def replicate(case: Case, edge: float, seed: int) -> tuple[Array, Array, float, float]:
    """Differences from the true values and their sd, (K, 4) each, chi2, and seconds of one `locate`."""
    rng = np.random.default_rng(seed)
    transport, surface = matrix(case.views)
    per_watt = case.electrons / max(power(case, band).max() for band in case.bands or (None,))
    metadata = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE}
    images = {}
    for band in case.bands or (None,):
        true = power(case, band)
        counted = rng.poisson(true * per_watt) + READ_NOISE * rng.standard_normal(true.shape)
        images[band] = [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]
    start = time.perf_counter()
    found = fspt.locate(
        described(edge),
        dict.fromkeys(case.bands, transport) if case.bands else transport,
        images if case.bands else images[None],
        sources=len(case.sources),
        scene=surface,
        settings=LocationSettings(model_error=0.0),
    )
    seconds = time.perf_counter() - start
    values = np.array([[*source.position, source.power] for source in found.sources])
    deviations = np.array([[*source.position_sd, source.power_sd] for source in found.sources])
    return values - np.array(case.sources), deviations, found.chi2, seconds


def row(case: Case, results: list[tuple[Array, Array, float, float]]) -> Row:
    """Numbers of one case."""
    differences, deviations, chi2, seconds = (np.array(one) for one in zip(*results, strict=True))
    ratios = (differences / deviations).reshape(-1, 4)
    inside = np.abs(ratios) < 1.6449
    numbers = {
        f"holds_{name}": share for name, share in zip(("x", "y", "z", "power"), inside.mean(axis=0), strict=True)
    }
    numbers |= {"holds": inside.mean(), "z2": (ratios**2).mean()}
    sd = deviations.reshape(-1, 4).mean(axis=0)
    numbers |= {f"sd_{name}_mm": value for name, value in zip("xyz", sd[:3], strict=True)}
    watts = np.array(case.sources)[:, 3]
    numbers |= {"sd_power_percent": 100 * (deviations[..., 3] / watts).mean()}
    numbers |= {"chi2": chi2.mean(), "seconds": np.median(seconds)}
    return {"case": case.name, "replicates": len(chi2)} | {n: float(f"{value:.4g}") for n, value in numbers.items()}


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--edge", type=float, default=3.0, help="Of the tetrahedra [mm].")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "location_coverage.csv")
    arguments = parser.parse_args()
    rows = []
    with ProcessPoolExecutor(arguments.workers) as pool:
        for case in CASES:
            jobs = [(case, arguments.edge, seed) for seed in range(arguments.seeds)]
            rows.append(row(case, list(pool.map(replicate, *zip(*jobs, strict=True)))))
            print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
