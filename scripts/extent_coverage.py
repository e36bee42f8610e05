"""Coverage of the intervals of `locate` for a source that glows uniformly over a sphere, `--shape sphere`.

    python scripts/extent_coverage.py [--seeds 40] [-o docs/extent_coverage.csv]

A sphere of 2 W at (2.5, 1, -1) mm, 3 mm below the surface of a cylinder of 12 by 8 mm, in four views of 16² pixels and
two bands, in which light of diffusion falls off with 1/k = 2.5 and 1.3 mm. J_n of the images is an exact series of the
diffusion equation for a point (tests/cylinder_diffusion.py) times the power of the point that the sphere looks like,
that of `locate` from finite elements; the equation is the same, and `locate` takes it as exact. The images have Poisson
noise, 3.5 electrons of read noise and as many electrons on the brightest pixel as the table says. Columns: radius [mm];
share of the 90 % intervals that contain the true value, of the radius, x, y, z, the power, and of the last four; share
of the intervals of the radius that start at 0; median ends of the interval of the radius [mm]; rms error of the power
[%]; mean chi2; median CPU seconds of `locate`.
"""

from __future__ import annotations

import argparse
import logging
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tests_folder  # noqa: F401
from csv_table import write_rows
from cylinder_views import COEFFICIENTS, cylinder_views, exact, tetrahedra_made_once
from numpy.typing import NDArray
from sphere_views import noisy

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.source_fit import LocationSettings
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.tissue.phantom_file import PhantomFile

ROOT = Path(__file__).resolve().parent.parent
Array = NDArray[np.float64]
BANDS = ("red", "green")
TRUE = np.array((2.5, 1.0, -1.0, 2.0))  # x, y, z [mm], power [W]
CASES = ((0.5, 300), (1.5, 1000), (2.5, 1000))  # radius [mm], electrons on the brightest pixel of each band


@dataclass(frozen=True)
class Setup:
    """Phantom file, matrix and surface of the cylinder."""

    described: PhantomFile
    matrix: fspt.TransportMatrix
    surface: Surface

    @classmethod
    def of(cls, folder: Path) -> Setup:
        """Those of the files that are written into the folder."""
        matrix = cylinder_views(folder)
        return cls(PhantomFile.read(folder / "cylinder.toml"), matrix, Surface.of(matrix))


def apparent(radius: float, band: str) -> float:
    """Power of the point that a sphere of 1 W looks like from outside: the mean of sinh(kr)/(kr) over the sphere."""
    _, mua, musp = COEFFICIENTS[band]
    x = radius * math.sqrt(3 * mua * (mua + musp))
    return 3 * (x * math.cosh(x) - math.sinh(x)) / x**3


def replicate(setup: Setup, radius: float, electrons: float, seed: int) -> dict[str, Array]:
    """Ends of the intervals of radius, x, y, z and power, (2, 5), and other numbers of one `locate`."""
    images = {
        name: noisy(
            setup.matrix,
            apparent(radius, name) * exact(setup.surface.vertices, [tuple(TRUE)], name),
            electrons,
            len(BANDS) * seed + k,
        )
        for k, name in enumerate(BANDS)
    }
    start = time.process_time()
    found = fspt.locate(
        setup.described,
        dict.fromkeys(BANDS, setup.matrix),
        images,
        scene=setup.surface,
        shape="sphere",
        settings=LocationSettings(model_error=0.0),
    )
    source = found.sources[0]
    ends = zip(source.radius_interval, source.position_interval, source.power_interval, strict=True)
    return {
        "ends": np.array([[own, *place, power] for own, place, power in ends]),
        "power": np.array(source.power),
        "chi2": np.array(found.chi2),
        "seconds": np.array(time.process_time() - start),
    }


def row(radius: float, electrons: float, results: list[dict[str, Array]]) -> dict[str, object]:
    """A line of the table."""
    of = {name: np.array([one[name] for one in results]) for name in results[0]}
    low, high = of["ends"][:, 0], of["ends"][:, 1]
    true = np.array([radius, *TRUE])
    inside = (low <= true) & (true <= high)
    numbers = {f"holds_{n}": s for n, s in zip(("radius", *"xyz", "power"), inside.mean(axis=0), strict=True)}
    numbers |= {"holds_values": inside[:, 1:].mean(), "from_0": (low[:, 0] == 0).mean()}
    numbers |= {"low_mm": np.median(low[:, 0]), "high_mm": np.median(high[:, 0])}
    numbers |= {"power_percent": 100 * np.sqrt(np.mean((of["power"] / TRUE[3] - 1) ** 2))}
    numbers |= {"chi2": of["chi2"].mean(), "seconds": np.median(of["seconds"])}
    line: dict[str, object] = {"radius_mm": radius, "electrons": electrons, "replicates": len(results)}
    return line | {name: float(f"{value:.4g}") for name, value in numbers.items()}


def main() -> None:
    """Write the table as CSV and print it."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seeds", type=int, default=40)
    options.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "extent_coverage.csv")
    given = options.parse_args()
    logging.getLogger("mitsuba_fspt").setLevel(logging.ERROR)
    rows = []
    with tempfile.TemporaryDirectory() as folder, tetrahedra_made_once():
        setup = Setup.of(Path(folder))
        for radius, electrons in CASES:
            results = [replicate(setup, radius, electrons, seed) for seed in range(given.seeds)]
            rows.append(row(radius, electrons, results))
            print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
            write_rows(given.output, rows)


if __name__ == "__main__":
    main()
