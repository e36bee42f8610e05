"""Photon transfer of simulated cameras: mean and variance of counts give back the numbers of the detector.

    python scripts/photon_transfer.py [--side 128] [--frames 40] [--exposures 400] [-o docs/photon_transfer.csv]

Cameras: `Detector.typical_ccd`, `typical_emccd` with the register at a gain of 1 and of 300, and `typical_scmos`, each
with a PRNU. Stacks of `frames` exposures to uniform light, from the dark to saturation, give by EMVA 1288 the variance
in time over the mean signal S [DN]: σ² = (g F²/K) S + (σ_read/K)² + 1/12, with K in e-/DN, and the variance over the
pixels of the mean frame, (PRNU · S)². K follows from the slope without multiplication, g F² from the ratio of the
slopes, g from the ratio of the signals at equal light, the full well from the largest count. Table: put in, found, its
standard error, and the deviation in standard errors.

`chi2`: of `exposures` exposures to an image with structure, reduced from counts, Σ (P − P₀)²/σ²(P₀) over all pixels
over their number, with σ² from the noise model in the reduced image; the standard error is that of the sum. The sCMOS
has all five maps there. The picture is drawn beside the table.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.measurement import noise_of

ROOT = Path(__file__).resolve().parent.parent
Array = NDArray[np.float64]
Found = dict[str, tuple[float, float, float]]  # put in, found, standard error
LIGHT = {"exposure_time": 1.0, "wavelength_nm": 650.0}
ELECTRONS = 1.0 * 650e-9 / (6.62607015e-34 * 299792458.0)  # photons per watt at this exposure
PRNU = 0.01
LEVELS = np.geomspace(3e-4, 0.6, 12)  # signal over the full well
FITTED = 0.7  # of the full well, up to which no pixel of the levels saturates


@dataclass
class Curve:
    """Signal above the dark [DN], variance in time and over the pixels [DN²], and their standard errors, of each level.

    The first level is dark. `light` [W] is the power on a pixel, `largest` the largest count [DN] in saturating light.
    """

    light: Array
    signal: Array
    signal_error: Array
    time: Array
    time_error: Array
    pixels: Array
    pixels_error: Array
    largest: float


def curve_of(camera: fspt.Detector, side: int, frames: int, seed: int) -> Curve:
    """Photon-transfer curve of a camera from `frames` exposures a level of side × side pixels."""
    top = camera.full_well / camera.em_gain / camera.quantum_efficiency / ELECTRONS  # fills the well [W]
    light = np.array([0.0, *(LEVELS * top)])
    rows = []
    for number, power in enumerate(light):
        image = fspt.Image(np.full((side, side), power))
        stack = np.array(
            [camera.expose(image, **LIGHT, seed=seed + 1000 * number + k).counts for k in range(frames)], float
        )
        spread = stack.var(axis=0, ddof=1)
        time, mean = spread.mean(), stack.mean(axis=0)
        pixels = mean.var(ddof=1)
        rows.append(
            (mean.mean(), time, spread.std() / side, pixels - time / frames, pixels * np.sqrt(2) / side)
        )  # the last one of a normal law
    mean, time, time_error, pixels, pixels_error = np.array(rows).T
    full = camera.expose(fspt.Image(np.full((side, side), 3 * top)), **LIGHT).counts.max()
    signal_error = np.sqrt((time + time[0]) / frames) / side
    return Curve(
        light, mean - mean[0], signal_error, time, time_error, pixels, pixels_error, float(full) - camera.mean("bias")
    )


def line(x: Array, y: Array, error: Array) -> tuple[Array, Array]:
    """Slope and intercept of the straight line through points with standard errors, and their covariance."""
    design = np.stack([x, np.ones_like(x)], axis=1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    return covariance @ (design.T @ (y / error)), covariance


def numbers_of(camera: fspt.Detector, curve: Curve, off: Curve | None = None) -> Found:
    """Numbers of a camera from its curve; of an EMCCD `off` is the curve with its register at a gain of 1."""
    (slope, rest), covariance = line(curve.signal, curve.time, curve.time_error)
    found: Found = {}
    if off is None:
        gain, gain_error = 1 / slope, covariance[0, 0] ** 0.5 / slope**2
    else:
        (own, _), other = line(off.signal, off.time, off.time_error)
        gain, gain_error = 1 / own, other[0, 0] ** 0.5 / own**2
        product = slope / own
        error = product * np.hypot(covariance[0, 0] ** 0.5 / slope, gain_error / gain)
        found["em_gain F²"] = camera.em_gain * camera.excess, product, error
        factor, factor_error = ratio(curve, off)
        found["em_gain"] = camera.em_gain, factor, factor_error
        found["F²"] = (
            camera.excess,
            product / factor,
            product / factor * np.hypot(error / product, factor_error / factor),
        )
    found["gain [e-/DN]"] = camera.mean("gain"), gain, gain_error
    dark = camera.excess * camera.em_gain**2 * (camera.mean("dark_current") + camera.spurious_charge)
    read = np.sqrt((rest - 1 / 12) * gain**2 - dark)
    error = np.hypot(covariance[1, 1] ** 0.5 * gain**2 / 2 / read, gain_error / gain * read)
    found["read noise [e-]"] = camera.mean("read_noise"), read, error
    found["full well [e-]"] = camera.full_well, curve.largest * gain, curve.largest * gain_error + gain / 2
    (prnu, _), covariance = line(curve.signal**2, curve.pixels, curve.pixels_error)
    found["PRNU"] = PRNU, prnu**0.5, covariance[0, 0] ** 0.5 / 2 / prnu**0.5
    return found


def ratio(on: Curve, off: Curve) -> tuple[float, float]:
    """Signal per watt with the register over that without it, and its standard error."""
    pairs = []
    for curve in (on, off):
        lit = curve.light > 0
        error = curve.signal_error[lit] / curve.light[lit]
        weight = error**-2.0
        rate = (curve.signal[lit] / curve.light[lit] * weight).sum() / weight.sum()
        pairs.append((rate, weight.sum() ** -0.5))
    (one, one_error), (two, two_error) = pairs
    return one / two, one / two * float(np.hypot(one_error / one, two_error / two))


def maps(folder: Path, side: int) -> dict[str, str]:
    """Names of five maps of an sCMOS: noisy pixels, amplifiers that differ, hot pixels, a response."""
    rng = np.random.default_rng(11)
    planes = {
        "read_noise": rng.lognormal(np.log(1.4), 0.5, (side, side)),
        "gain": 0.46 * rng.normal(1, 0.02, (side, side)),
        "bias": rng.normal(100, 2, (side, side)),
        "dark_current": rng.lognormal(np.log(0.06), 1, (side, side)),
        "prnu": rng.normal(1, PRNU, (side, side)),
    }
    for name, plane in planes.items():
        np.save(folder / f"{name}.npy", plane)
    return {name: str(folder / f"{name}.npy") for name in planes}


def chi2_of(camera: fspt.Detector, exposures: int, side: int, first: int) -> tuple[float, float, float]:
    """Expected and found Σ (P − P₀)²/σ² over all pixels of all exposures, over their number, and its standard error."""
    peak = 0.3 * min(camera.full_well / camera.em_gain, 3000) / camera.quantum_efficiency / ELECTRONS
    power = peak * np.outer(np.linspace(0, 1, side), np.linspace(0.2, 1, side))
    image, used = fspt.Image(power), np.ones((1, side, side), bool)
    total, variance = 0.0, 0.0
    for seed in range(first, first + exposures):
        found = camera.reduce(camera.expose(image, **LIGHT, seed=seed).counts, **LIGHT)
        noise = noise_of((1, side, side), [found])
        sigma = np.sqrt(noise.variance(power[None], used))
        total += float(np.square((found.power - power) / sigma[0]).sum())
        variance += noise.chi2(power[None], sigma, used).variance
    count = exposures * side**2
    return 1.0, total / count, variance**0.5 / count


def draw(curves: dict[str, Curve], path: Path) -> None:
    """Standard deviations in time and over the pixels, over the mean signal."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    axes = figure.subplots()
    for number, (name, curve) in enumerate(curves.items()):
        x, colour = curve.signal[1:], f"C{number}"
        (slope, rest), _ = line(curve.signal, curve.time, curve.time_error)
        axes.loglog(x, np.sqrt(curve.time[1:]), "o", color=colour, ms=4, label=name)
        axes.loglog(x, np.sqrt(slope * x + rest), "-", color=colour, lw=1)
        axes.axhline(curve.time[0] ** 0.5, color=colour, lw=0.7, ls=":")
        seen = curve.pixels[1:] > 3 * curve.pixels_error[1:]
        axes.loglog(x[seen], np.sqrt(curve.pixels[1:][seen]), "^", color=colour, ms=4, mfc="none")
    x = np.array([30, 6e4])
    axes.loglog(x, PRNU * x, "k--", lw=0.8, label=f"{PRNU:g} S, PRNU put in")
    axes.plot([], [], "^", color="0.3", mfc="none", label="over the pixels, mean of the stack")
    axes.set_xlabel("mean signal S above the dark [DN]")
    axes.set_ylabel("standard deviation [DN]")
    axes.set_title("Photon transfer: circles in time, lines fitted, dotted read noise")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=128, help="pixels a side")
    parser.add_argument("--frames", type=int, default=40, help="exposures a level")
    parser.add_argument("--exposures", type=int, default=400, help="of chi2")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/photon_transfer.csv")
    options = parser.parse_args()
    ccd, emccd, scmos = (
        replace(camera(), prnu=PRNU, pixel_pitch=None)
        for camera in (fspt.Detector.typical_ccd, fspt.Detector.typical_emccd, fspt.Detector.typical_scmos)
    )
    cameras = {"CCD": ccd, "EMCCD, gain 1": replace(emccd, em_gain=1), "EMCCD, gain 300": emccd, "sCMOS": scmos}
    seeds = {name: 100000 * (number + 1) for number, name in enumerate(cameras)}  # no noise in common
    curves = {n: curve_of(camera, options.side, options.frames, seeds[n]) for n, camera in cameras.items()}
    rows = []
    for name, camera in cameras.items():
        off = curves["EMCCD, gain 1"] if camera.em_gain > 1 else None
        found = numbers_of(camera, curves[name], off)
        with tempfile.TemporaryDirectory() as folder:
            given = maps(Path(folder), 64) if name == "sCMOS" else {"prnu": 0.0}
            found[f"chi2 of {options.exposures} exposures"] = chi2_of(
                replace(camera, **given), options.exposures, 64, seeds[name] + 50000
            )
        rows += [(name, quantity, *values) for quantity, values in found.items()]
    with options.output.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["camera", "quantity", "put in", "found", "standard error", "deviation"])
        for name, quantity, true, value, error in rows:
            row = (name, quantity, f"{true:.6g}", f"{value:.6g}", f"{error:.2g}", f"{(value - true) / error:.2f}")
            writer.writerow(row)
            print(*row, sep="\t")
    draw(curves, options.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
