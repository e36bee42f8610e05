"""Coverage of the intervals of `locate` where optical coefficients are known to 10 %.

    python scripts/optics_coverage.py [--images series,photons] [--coefficients fitted,exact] [--placements 40]
        [--three 40] [--photons 2e6] [--keep FOLDER] [-o CSV]

A point source of 1 W at a random place of a cylinder of 16 by 16 mm, 3 to 7 mm below its side and 4 mm or more below
its caps, in four views of 24² pixels from the side. The true µa and µs' of each band are the nominal ones times
1 + 0.1 N(0, 1), n is 1.37. The images have 300 electrons on the brightest pixel of each band. `locate` has the nominal
coefficients with `mua_sd` and `musp_sd` of 0.1, or without. J_n of the images shares nothing with the solver:

*series* : of the diffusion equation, exact; `locate` solves the same equation, with `model_error=0`, so that noise and
    coefficients alone are unknown
*photons* : one by one (`photon_walk`) in bins of 0.5 mm, between which J_n is linear, both sides of the plane through
    the axis and the source together; `locate` solves SP3, whose own error counts, too, and is in the intervals. At 2e6
    photons their noise is 1 to 2 % on bright pixels, of 6 % or more of the electrons. `--keep` keeps the exit power by
    bins, for another run

Columns: images, placements, and those that `locate` refused; shares of the 90 % intervals that contain x, y, z, the
power, and the coefficients; rms error of the position over all directions [mm] and of the power [%]; rms of the errors
over their stated sd, of positions, of powers and of coefficients; mean chi2; rms error of the coefficients before and
after the fit [%]; median CPU seconds. What is of fitted coefficients is empty where they are taken as exact.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import logging
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tests_folder  # noqa: F401
from csv_table import write_rows
from cylinder_diffusion import Phantom, exitance
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.source_fit import LocationSettings
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.errors import FsptError
from mitsuba_fspt.tissue.phantom_file import Band, CylinderGeometry, PhantomFile, Spread

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from photon_walk import Body, Emitter, Optics, exit_power  # noqa: E402

Array = NDArray[np.float64]
Place = tuple[float, float, float]
Key = tuple[str, int, str]
Truth = Callable[[Array, float, float, Place, int], Array]
ROOT = Path(__file__).resolve().parent.parent
RADIUS, HEIGHT, INDEX = 8.0, 16.0, 1.37
VIEWS = [0, 90, 180, 270]
SD = 0.1
NORMAL_90 = 1.645  # standard deviations from the middle to the ends of a 90 % interval
ELECTRONS, READ_NOISE = 300, 3.5
TURNS, ROWS, RINGS = 50, 32, 16  # bins: half around from the source's side, along the side, across a cap
COEFFICIENTS = {True: "fitted along", False: "taken as exact"}
BANDS = {"red": (0.4, 0.02, 1.1), "green": (0.35, 0.05, 1.0), "blue": (0.25, 0.1, 0.9)}  # share, µa, µs' [1/mm]


@dataclass(frozen=True)
class Setup:
    """Matrix and surface of the cylinder."""

    matrix: fspt.TransportMatrix
    surface: Surface

    @classmethod
    def of(cls, folder: Path) -> Setup:
        """Matrix of the four views."""
        phantom(()).solve().phantom(0.8).write(folder / "cylinder.ply")
        camera = {"focal_length": 55, "f_number": 2.8, "width": 24, "height": 24, "pixel_pitch": 0.4}
        text = fspt.scene_xml(folder / "cylinder.ply", **camera)
        (folder / "cylinder.xml").write_text(text, encoding="utf-8")
        matrix = fspt.transport(folder / "cylinder.xml", view=VIEWS, rtol=1e-3)
        return cls(matrix, Surface.of(matrix))


def phantom(names: tuple[str, ...], spread: Spread = Spread(), model: str = "sp3") -> PhantomFile:  # noqa: B008
    """The cylinder with its nominal coefficients; `spread` of each band's; `model` of its light."""
    bands = {name: Band(BANDS[name][0], (Medium(BANDS[name][1], BANDS[name][2], INDEX),), (spread,)) for name in names}
    return PhantomFile(
        CylinderGeometry(RADIUS, HEIGHT),
        Medium(0.05, 1.0, INDEX),
        (Source(Sphere((0.0, 0.0, 0.0))),),
        edge=1.5,
        bands=bands,
        model=model,
    )


def place(rng: np.random.Generator) -> Place:
    """Random place 3 to 7 mm below the side, and 4 mm or more below the caps."""
    while True:
        x, y, z = (float(value) for value in rng.uniform(-1, 1, 3) * (RADIUS, RADIUS, HEIGHT / 2 - 4))
        if 3 <= RADIUS - math.hypot(x, y) <= 7:
            return x, y, z


def bin_of(p: mi.Point3f) -> mi.UInt32:
    """Number of the bin of a point of the surface, of a source at y = 0: the side, then the lower and the upper cap."""
    turn = dr.minimum(mi.UInt32(dr.abs(dr.atan2(p.y, p.x)) / dr.pi * TURNS), TURNS - 1)
    row = dr.minimum(mi.UInt32((p.z / HEIGHT + 0.5) * ROWS), ROWS - 1)
    ring = dr.minimum(mi.UInt32(dr.sqrt(p.x * p.x + p.y * p.y) / RADIUS * RINGS), RINGS - 1)
    on_cap = dr.abs(p.z) > HEIGHT / 2 * (1 - 1e-5)
    cap = ROWS * TURNS + (dr.select(p.z > 0, mi.UInt32(RINGS), mi.UInt32(0)) + ring) * TURNS + turn
    return dr.select(on_cap, cap, row * TURNS + turn)


def series_exitance(points: Array, mua: float, musp: float, at: Place, seed: int = 0) -> Array:
    """J_n [W/mm²] of 1 W at the points (V, 3) of the surface, of the diffusion equation; of any seed."""
    body = Phantom(RADIUS, HEIGHT, mua, musp, INDEX, source_x=math.hypot(*at[:2]), source_z=at[2], source_diameter=0.0)
    return exitance(body, points @ turned(at).T)


def turned(at: Place) -> Array:
    """Rotation (3, 3) about z that brings a place to y = 0, x > 0."""
    angle = math.atan2(at[1], at[0])
    return np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def photon_power(mua: float, musp: float, at: Place, seed: int, photons: int, keep: Path | None) -> Array:
    """Exit power [W] of 1 W by bins, of both sides together; kept as a file in the folder `keep`."""
    file = keep / f"half_{photons}_{seed}_{mua:.9g}_{musp:.9g}.npy" if keep else None
    if file and file.exists():
        return np.asarray(np.load(file), np.float64)
    optics, count = Optics(mua, musp, INDEX), (ROWS + 2 * RINGS) * TURNS
    emitter = Emitter((math.hypot(*at[:2]), 0.0, at[2]))
    power = exit_power(Body(RADIUS, HEIGHT), optics, emitter, bin_of, count, photons, seed).mean(axis=0)
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, power)
    return np.asarray(power)


def photon_exitance(
    points: Array, mua: float, musp: float, at: Place, seed: int, photons: int, keep: Path | None
) -> Array:
    """J_n [W/mm²] of 1 W at the points (V, 3) of the surface, linear between the bins' centres."""
    power = photon_power(mua, musp, at, seed, photons, keep)
    points = points @ turned(at).T
    ring = np.pi * RADIUS**2 / RINGS**2 * (2 * np.arange(RINGS) + 1) / TURNS
    area = np.concatenate([np.full(ROWS, 2 * np.pi * RADIUS * HEIGHT / ROWS / TURNS), ring, ring])
    exitance = power.reshape(-1, TURNS) / area[:, None]
    turn = np.abs(np.arctan2(points[:, 1], points[:, 0])) / np.pi * TURNS - 0.5
    on_cap = np.abs(points[:, 2]) > HEIGHT / 2 - 1e-6
    rows = [(~on_cap, 0, ROWS, (points[:, 2] / HEIGHT + 0.5) * ROWS - 0.5)]
    across = np.hypot(points[:, 0], points[:, 1]) / RADIUS * RINGS - 0.5
    for sign, first in ((-1, ROWS), (1, ROWS + RINGS)):
        rows.append((on_cap & (points[:, 2] * sign > 0), first, RINGS, across))
    result = np.empty(len(points))
    for own, first, number, row in rows:
        low = np.clip(np.floor(row[own]).astype(int), 0, number - 2)
        up = row[own] - low  # below 0 and above 1 at the rim: continued linearly
        left = np.floor(turn[own]).astype(int)
        right = turn[own] - left
        ends = np.clip(left, 0, None), np.clip(left + 1, None, TURNS - 1)  # in the plane of symmetry the same twice
        table = exitance[first : first + number]
        near, far = ((1 - right) * table[low + k, ends[0]] + right * table[low + k, ends[1]] for k in (0, 1))
        result[own] = (1 - up) * near + up * far
    return np.maximum(result, 0)


def replicate(
    setup: Setup, names: tuple[str, ...], fitted: bool, truth: Truth, model: str, seed: int
) -> dict[str, Array] | None:
    """Errors of one placement, by `model` from images of J_n of `truth`; None where `locate` refuses it."""
    rng = np.random.default_rng(seed)
    at, images, true = place(rng), {}, dict[str, float]()
    for name in names:
        factors = 1 + SD * rng.standard_normal(2).clip(-3, 3)
        true[f"{name}.mua"], true[f"{name}.musp"] = (float(value) for value in factors * BANDS[name][1:])
    for number, name in enumerate(names):
        lit = truth(setup.surface.vertices, true[f"{name}.mua"], true[f"{name}.musp"], at, 1000 * seed + number)
        power = BANDS[name][0] * setup.matrix.forward(lit)
        per_watt = ELECTRONS / power.max()
        counted = rng.poisson(power * per_watt) + READ_NOISE * rng.standard_normal(power.shape)
        metadata = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE}
        images[name] = [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]
    described = phantom(names, Spread(SD, SD) if fitted else Spread(), model)
    start = time.process_time()
    settings = LocationSettings(model_error=0.0 if model == "diffusion" else 1.0)
    try:
        found = fspt.locate(
            described, dict.fromkeys(names, setup.matrix), images, scene=setup.surface, settings=settings
        )
    except FsptError as error:
        print(f"seed {seed}: {error}", flush=True)
        return None
    source = found.sources[0]
    low, high = source.position_interval
    coefficients = np.array([[BANDS[n][k] for k in (1, 2)] for n in names]).ravel()
    actual = np.array([true[f"{n}.{key}"] for n in names for key in ("mua", "musp")])
    best = np.array([found.optics[name].value for name in true]) if fitted else coefficients
    sd = np.array([found.optics[name].sd for name in true]) if fitted else np.full(len(actual), np.nan)
    return {
        "inside": ((low <= at) & (at <= high)).astype(float),
        "power_inside": np.array([float(source.power_interval[0] <= 1 <= source.power_interval[1])]),
        "position": source.position - at,
        "power": np.array([source.power - 1]),
        "position_z": (source.position - at) / source.position_sd,
        "power_z": np.array([(source.power - 1) / source.power_sd]),
        "coefficients_z": (best - actual) / sd,
        "chi2": np.array([found.chi2]),
        "before": coefficients / actual - 1,
        "after": best / actual - 1,
        "seconds": np.array([time.process_time() - start]),
    }


def rows_of(
    setup: Setup, names: tuple[str, ...], fitted: bool, images: str, truth: Truth, placements: int
) -> Iterator[dict[str, object]]:
    """A line of the table, after each placement anew."""
    model = {"series": "diffusion", "photons": "sp3"}[images]
    kept = list[dict[str, Array]]()
    for seed in range(placements):
        one = replicate(setup, names, fitted, truth, model, seed)
        kept += [one] if one is not None else []
        if kept:
            yield row(names, fitted, images, seed + 1, kept)


def row(
    names: tuple[str, ...], fitted: bool, images: str, placements: int, kept: Sequence[dict[str, Array]]
) -> dict[str, object]:
    """A line of the table."""
    of = {key: np.array([one[key] for one in kept]) for key in kept[0]}

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    numbers = {
        "holds_position": of["inside"].mean(),
        "holds_power": of["power_inside"].mean(),
        "holds_coefficients": (np.abs(of["coefficients_z"]) <= NORMAL_90).mean() if fitted else np.nan,
        "position_mm": math.sqrt(3) * rms(of["position"]),
        "power_percent": 100 * rms(of["power"]),
        "position_over_sd": rms(of["position_z"]),
        "power_over_sd": rms(of["power_z"]),
        "coefficients_over_sd": rms(of["coefficients_z"]),
        "chi2": of["chi2"].mean(),
        "coefficients_before_percent": 100 * rms(of["before"]),
        "coefficients_after_percent": 100 * rms(of["after"]),
        "seconds": float(np.median(of["seconds"])),
    }
    line: dict[str, object] = {"images": images, "bands": len(names), "coefficients": COEFFICIENTS[fitted]}
    line |= {"placements": placements, "refused": placements - len(kept)}
    return line | {name: "" if math.isnan(value) else float(f"{value:.3g}") for name, value in numbers.items()}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--images", default="series,photons", help="what J_n of the images is from")
    options.add_argument("--coefficients", default="fitted,exact", help="how locate takes them; other rows stay")
    options.add_argument("--placements", type=int, default=40, help="with one band")
    options.add_argument("--three", type=int, default=40, help="placements with three bands")
    options.add_argument("--photons", type=float, default=2e6, help="of each image")
    options.add_argument("--keep", type=Path, help="folder in which exit powers of photons are kept")
    options.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "optics_coverage.csv")
    given = options.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)
    rows: dict[Key, dict[str, object]] = {}
    if given.output.exists():
        with given.output.open(encoding="utf-8") as file:
            rows = {(one["images"], int(one["bands"]), one["coefficients"]): dict(one) for one in csv.DictReader(file)}
    fits = [fitted for fitted, name in ((True, "fitted"), (False, "exact")) if name in given.coefficients.split(",")]
    cases = [(names, fitted) for names in (("green",), tuple(BANDS)) for fitted in fits]
    walk = partial(photon_exitance, photons=int(given.photons) // 32 * 32, keep=given.keep)
    truths: dict[str, Truth] = {"series": series_exitance, "photons": walk}
    with tempfile.TemporaryDirectory() as folder:
        setup = Setup.of(Path(folder))
        for images, (names, fitted) in itertools.product(given.images.split(","), cases):
            placements = given.placements if len(names) == 1 else given.three
            for line in rows_of(setup, names, fitted, images, truths[images], placements):
                rows[images, len(names), COEFFICIENTS[fitted]] = line
                print("  ".join(f"{name}={value}" for name, value in line.items()), flush=True)
                write_rows(given.output, rows.values())


if __name__ == "__main__":
    main()
