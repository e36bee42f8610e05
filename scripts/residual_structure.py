"""What the test of structure in the residuals tells: false alarms on right images, and causes that it finds.

    python scripts/residual_structure.py [--seeds 200] [--wrong 10] [--only invert,locate] [-o CSV]

*invert*: the sphere of interval_calibration.py (642 vertices, 4 views of 16 x 16 pixels; matrices of rtol 1e-4 and
3e-3). *locate*: the small cylinder of tests/cylinder_views.py (4 views of 16 x 16 pixels), or the nylon cylinder of
location_coverage.py (64 x 64 pixels, source 7 mm below the side), J_n of the images from a series. The images have
Poisson noise and 3.5 electrons of read noise. Right images: `told` is the share of false alarms. Wrong ones: one view
times 1.05; the camera 0.5 mm nearer than in the matrix; absorption of the phantom file 10 % too low; an inclusion of
four times the absorption that the phantom file leaves out. Columns: mean of Σ z² over the directions tested; share of
images with a warning of structure; the causes named first, with their number; mean chi2; share of images with a warning
of chi2.
"""

from __future__ import annotations

import argparse
import csv
import logging
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import location_coverage
import numpy as np
import tests_folder  # noqa: F401
from csv_table import write_rows
from cylinder_views import TOML, cylinder_views, exact
from interval_calibration import READ_NOISE, SCENE, case, fixed
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse import fit_warnings, source_fit
from mitsuba_fspt.inverse.structure import Structure
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.optics.media import Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.tissue.diffusion import Tissue
from mitsuba_fspt.tissue.phantom_file import PhantomFile

ROOT = Path(__file__).resolve().parent.parent
Array = NDArray[np.float64]
Row = dict[str, object]
EXACT = source_fit.LocationSettings(model_error=0.0)
SOURCE = (2.5, 1.0, -1.0, 2.0)  # x, y, z [mm], power [W]
INCLUSION = """[[regions]]
shape = "sphere"
centre = [0, 3.5, 0]
radius = 1.5
mua = 0.2
musp = 1.0
"""
FOUND: list[Structure] = []


def kept(test: Callable[..., Structure]) -> Callable[..., Structure]:
    """The same test, whose results are kept in `FOUND`."""

    def tested(*arguments: Any) -> Structure:
        FOUND.append(test(*arguments))
        return FOUND[-1]

    return tested


def images(power: Array, electrons: float, seed: int) -> list[fspt.Image]:
    """Images with this many electrons on the brightest pixel."""
    rng, per_watt = np.random.default_rng([seed, int(electrons)]), electrons / power.max()
    counted = rng.poisson(power * per_watt) + READ_NOISE * rng.standard_normal(power.shape)
    metadata = {"electrons_per_watt": per_watt, "read_noise": READ_NOISE}
    return [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]


@cache
def nearer() -> fspt.TransportMatrix:
    """Matrix of the sphere with the camera 0.5 mm nearer."""
    with tempfile.TemporaryDirectory() as folder:
        ply, xml = Path(folder) / "sphere.ply", Path(folder) / "sphere.xml"
        import trimesh

        trimesh.creation.icosphere(subdivisions=3, radius=6.0).export(ply)
        xml.write_text(SCENE.format(ply=ply).replace("165, 0, 0", "164.5, 0, 0"))
        return fspt.transport(xml, view=[0, 90, 180, 270], rtol=1e-4)


@cache
def cylinder() -> tuple[fspt.TransportMatrix, Surface]:
    """Matrix of the cylinder and its surface."""
    with tempfile.TemporaryDirectory() as folder:
        matrix = cylinder_views(Path(folder))
        return matrix, Surface.of(matrix)


def described(change: tuple[str, str] = ("", ""), more: str = "") -> PhantomFile:
    """Phantom file of the cylinder, with one text in place of another, and more tables."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cylinder.toml"
        head, rest = TOML.split("[bands.red]")[0], TOML.split("[[sources]]")[1]  # one band, without a name
        path.write_text((head + "[[sources]]" + rest).replace(*change, 1) + more)
        return PhantomFile.read(path)


def invert_case(truth: str, cause: str) -> Callable[[float, int], Any]:
    """Function of electrons and seed that inverts images of the sphere."""
    found = case()
    power = (nearer() if cause == "distance" else found.true).forward(fixed(found, truth))
    if cause == "factor":
        power = power * np.array([1.0, 1.0, 1.05, 1.0])[:, None, None]
    return lambda electrons, seed: fspt.invert(found.used, images(power, electrons, seed), scene=found.surface)


def nylon_case(cause: str) -> Callable[[float, int], Any]:
    """Function of electrons and seed that locates a source in the nylon cylinder."""
    matrix, surface = location_coverage.matrix(location_coverage.ALL_ROUND)
    lit = location_coverage.Case("", (location_coverage.NEAR,), location_coverage.ALL_ROUND, 1.0)
    phantom, power = replace(location_coverage.described(2.0), bands={}), location_coverage.power(lit, None)
    if cause == "absorption":
        phantom = replace(phantom, medium=replace(phantom.medium, mua=0.9 * phantom.medium.mua))
    return lambda electrons, seed: fspt.locate(
        phantom, matrix, images(power, electrons, seed), scene=surface, settings=EXACT
    )


def locate_case(truth: str, cause: str) -> Callable[[float, int], Any]:
    """Function of electrons and seed that locates a source in a cylinder."""
    if truth == "nylon":
        return nylon_case(cause)
    matrix, surface = cylinder()
    phantom = described(("mua = 0.05", "mua = 0.045")) if cause == "absorption" else described()
    exitance = exact(surface.vertices, [SOURCE])
    if cause == "inclusion":
        other = described(more=INCLUSION)
        tissue = Tissue(other.checked_mesh(), other.band(None).media, model=other.model, a=other.a, order=other.order)
        exitance = SOURCE[3] * tissue.solve([Source(Sphere(SOURCE[:3]))]).exitance_at(surface.vertices)
    power = matrix.forward(exitance)
    if cause == "factor":
        power = power * np.array([1.0, 1.0, 1.0, 1.05])[:, None, None]
    return lambda electrons, seed: fspt.locate(
        phantom, matrix, images(power, electrons, seed), scene=surface, settings=EXACT
    )


def row(verb: str, truth: str, cause: str, electrons: float, seeds: int) -> Row:
    """Numbers of one case over its seeds."""
    run = invert_case(truth, cause) if verb == "invert" else locate_case(truth, cause)
    FOUND.clear()
    results = [run(electrons, seed) for seed in range(seeds)]
    first = Counter(f"{one.causes[0].kind} {one.causes[0].where}" for one in FOUND if one.causes)
    return {
        "verb": verb,
        "truth": truth,
        "cause": cause,
        "electrons": electrons,
        "images": seeds,
        "z2": round(float(np.mean([one.chi2_sum / one.directions for one in FOUND])), 3),
        "directions": round(float(np.mean([one.directions for one in FOUND]))),
        "told": round(float(np.mean([bool(one.causes) for one in FOUND])), 4),
        "first": "; ".join(f"{name}: {count}" for name, count in first.most_common(3)),
        "chi2": round(float(np.mean([one.chi2 for one in results])), 3),
        "chi2_told": round(float(np.mean([any("chi2" in line for line in one.warnings) for one in results])), 4),
    }


def cases(seeds: int, wrong: int) -> Sequence[tuple[str, str, str, float, int]]:
    """Verb, truth, cause, electrons on the brightest pixel and number of images of each case."""
    right = [("invert", truth, "none", level, seeds) for truth in ("spot", "gradient") for level in (100.0, 1000.0)]
    right += [("locate", "source", "none", 1000.0, seeds), ("locate", "nylon", "none", 1000.0, seeds // 5)]
    bad = [("invert", "gradient", cause, 1e4, wrong) for cause in ("factor", "distance")]
    bad += [("locate", "nylon", "absorption", 1000.0, wrong)]
    return right + bad + [("locate", "source", cause, 1e4, wrong) for cause in ("factor", "absorption", "inclusion")]


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--wrong", type=int, default=10, help="Images with each cause.")
    parser.add_argument("--only", default="invert,locate", help="Verbs; rows of the others are kept.")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "residual_structure.csv")
    arguments = parser.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)
    fit_warnings.structure = kept(fit_warnings.structure)  # type: ignore[attr-defined]
    source_fit.structure = kept(source_fit.structure)  # type: ignore[attr-defined]
    verbs = arguments.only.split(",")
    rows: list[Row] = []
    if arguments.output.exists():
        with arguments.output.open(encoding="utf-8") as file:
            rows = [dict(one) for one in csv.DictReader(file) if one["verb"] not in verbs]
    for one in cases(arguments.seeds, arguments.wrong):
        if one[0] in verbs and one[-1] > 0:
            rows.append(row(*one))
            print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    rows.sort(key=lambda one: str(one["verb"]))
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
