"""Coverage of the intervals of `calibrate`: how often value ± 1.645 sd holds the true value.

    python scripts/calibrate_coverage.py [--seeds 120] [--direct 24] [-o docs/calibrate_coverage.csv]

The scene is scenes/nylon_cylinder.xml at f/2.8 on 32 x 32 pixels. View, distance and magnification are free; the fit
starts 0.7 degrees, 0.3 mm and 5e-4 from the true values. The images are counts of 300 and 3000 electrons on the
brightest pixel, exposed and reduced like those of a camera, and Monte Carlo images of 512 samples per pixel with the
standard error of their passes.

*expansion*: the fit of `calibrate`, in which a second-order expansion about the true values, from 19 images of the
integral, replaces rendering; this makes many replicates possible. *direct*: `calibrate` itself. Columns: share of the
90 % intervals that contain the true value, for each parameter and for all together; mean of z² = ((value − true)/sd)²,
of chi2, and of sd.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from csv_table import write_rows
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.calibrate import measured_of
from mitsuba_fspt.inverse.calibration_fit import CalibrationFit, CalibrationSettings

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "scenes" / "nylon_cylinder.xml"
CAMERA = {"width": 32, "height": 32, "pixel_pitch": 0.864, "f_number": 2.8}
TRUE = {"view": 0.7, "distance": 180.3, "magnification": 0.5005}
CCD = replace(fspt.Detector.typical_ccd(), dark_current=0.0, full_well=1e6, bits=16)
EXPOSURE = {"exposure_time": 1.0, "wavelength_nm": 660.0}
CASES = ("300 electrons", "3000 electrons", "path, 512 spp")
ACCURACY = CalibrationSettings(rtol=3e-4)
Row = dict[str, object]
Result = tuple[list[float], list[float], float]
Array = NDArray[np.float64]


@cache
def picture() -> fspt.Image:
    """Image of the true values without noise [W per W of source], to a tenth of the accuracy of the fit."""
    found = fspt.render(fspt.load(SCENE, **CAMERA, **TRUE), method="integral", rtol=1e-5)
    return fspt.Image(found.power, metadata={"pixel_pitch": CAMERA["pixel_pitch"]})


def measured(case: str, seed: int) -> fspt.Image:
    """One noisy image of a case."""
    if case.startswith("path"):
        scene = fspt.load(SCENE, **CAMERA, **TRUE)
        return fspt.render(scene, method="path", spp=int(case.split()[1]), seed=1000 + seed)
    electrons = float(case.split()[0])
    brightest = float(CCD.expected(picture(), 1.0, EXPOSURE["wavelength_nm"]).mean.max())
    exposure = CCD.expose(picture().scaled(electrons / brightest), **EXPOSURE, seed=seed)
    reduced = CCD.reduce(exposure.counts, **EXPOSURE, pixel_pitch=CAMERA["pixel_pitch"])
    per_watt = reduced.metadata["electrons_per_watt"] * electrons / brightest  # of the light of 1 W of source
    return fspt.Image(
        reduced.power * brightest / electrons, metadata=reduced.metadata | {"electrons_per_watt": per_watt}
    )


@cache
def expansion() -> tuple[Array, Array, Array]:
    """Steps (p,), and first (p, 1, h, w) and second differences (p, p, 1, h, w) of the image about the true values.

    A step changes the image by about 3 %.
    """
    steps = np.array([1.0, 2.0, 5e-3])
    zero = power_at(np.zeros(3))
    one = np.eye(3)
    high, low = (np.array([power_at(sign * steps * e) for e in one]) for sign in (1, -1))
    second = np.empty((3, 3, *zero.shape))
    for i in range(3):
        second[i, i] = high[i] + low[i] - 2 * zero
        for j in range(i):
            corners = [a * b * power_at(steps * (a * one[i] + b * one[j])) for a in (1, -1) for b in (1, -1)]
            second[i, j] = second[j, i] = sum(corners) / 4
    return steps, (high - low) / 2, second


def power_at(change: Array) -> Array:
    """Power (1, h, w) [W per W] of the integral with the parameters changed from the true ones."""
    values = {n: v + d for (n, v), d in zip(TRUE.items(), change, strict=True)}
    return fspt.render(fspt.load(SCENE, **CAMERA, **values), method="integral", rtol=1e-5).power[None].astype(float)


def expanded(values: Array) -> tuple[Array, Array]:
    """Power and numerical error (1, h, w) of the expansion at these values."""
    steps, slopes, second = expansion()
    y = (values - np.array(list(TRUE.values()))) / steps
    power = picture().power[None] + np.einsum("i,i...->...", y, slopes) + np.einsum("i,j,ij...->...", y, y, second) / 2
    return power, np.zeros_like(power)


def by_expansion(case: str, seed: int) -> Result:
    """Fitted minus true values, their sd, and chi2, by `calibrate`'s fit with the expansion in place of rendering."""
    image = measured(case, seed)
    start = np.array(list(TRUE.values())) - np.array([0.7, 0.3, 5e-4])
    data = measured_of([image], [{}], [picture()], len(TRUE))
    fit = CalibrationFit(tuple(TRUE), start, data, expanded, CalibrationSettings().for_noise(1e-4)).solved()
    deviations = np.sqrt(np.diag(fit.covariance))
    return list(fit.values - start - [0.7, 0.3, 5e-4]), list(deviations), fit.chi2_sum / (int(data.used.sum()) - 3)


def directly(case: str, seed: int) -> Result:
    """The same by `calibrate`."""
    found = fspt.calibrate(SCENE, measured(case, seed), free=list(TRUE), settings=ACCURACY, **CAMERA)
    return [found.values[n] - TRUE[n] for n in TRUE], [found.sd[n] for n in TRUE], found.chi2


def row(case: str, results: list[Result]) -> Row:
    """Numbers of one case, or of several together."""
    differences, deviations, chi2 = (np.array(one) for one in zip(*results, strict=True))
    inside = np.abs(differences / deviations) < 1.6449
    numbers = {f"holds_{name}": share for name, share in zip(TRUE, inside.mean(axis=0), strict=True)}
    numbers |= {"holds": inside.mean(), "z2": ((differences / deviations) ** 2).mean(), "chi2": chi2.mean()}
    numbers |= {f"sd_{name}": sd for name, sd in zip(TRUE, deviations.mean(axis=0), strict=True)}
    return {"case": case, "replicates": len(chi2)} | {n: float(f"{value:.4g}") for n, value in numbers.items()}


def table(seeds: int, direct: int) -> list[Row]:
    """One row a case and way, and one of all of a way."""
    rows = []
    ways: list[tuple[str, Callable[[str, int], Result], Iterable[int]]] = [
        ("expansion", by_expansion, range(seeds)),
        ("direct", directly, range(6000, 6000 + direct)),
    ]
    for way, find, numbers in ways:
        every = []
        for case in CASES:
            results = list(map(partial(find, case), numbers))
            rows.append(row(f"{way}, {case}", results))
            every += results
            print(rows[-1], flush=True)
        rows.append(row(f"{way}, all", every))
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=120)
    parser.add_argument("--direct", type=int, default=24)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "calibrate_coverage.csv")
    arguments = parser.parse_args()
    rows = table(arguments.seeds, arguments.direct)
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
