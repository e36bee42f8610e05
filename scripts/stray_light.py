"""Veiling glare in a picture of front and back: J_n of the nylon cylinder's dark side with and without it in the model.

    python scripts/stray_light.py [--shares 0.01,0.03] [--samples 50] [--exposures 8] [-o docs/stray_light.csv]

scenes/mirror_rig.xml (192 × 64 pixels of 0.135 mm): the side next to the source is seen directly, the dark side by two
mirrors. A typical CCD exposes with the share g of the light spread evenly over the film, 40,000 electrons on the
brightest pixel. `invert` gets the image once with its metadata, which name the glare, and once without them. Table:
for each share and sector of 30 degrees around the axis, |z| < 12 mm, the power that leaves it over the true one, its
90 % interval, and the glare over the sector's light. Sectors count from the source's side; the dark side lies at 180
degrees. With --exposures OUT_exposures.csv takes the table's place: of so many exposures to the first share, the number
of the sectors' intervals that miss the true power.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.reduction import reduced

ROOT = Path(__file__).resolve().parent.parent
SCENE, PHANTOM = ROOT / "scenes/mirror_rig.xml", ROOT / "scenes/nylon_cylinder.ply"
FILM = {"width": 192, "height": 64, "pixel_pitch": 0.135}
LIGHT = {"exposure_time": 60.0, "wavelength_nm": 660.0}
ELECTRONS = 4e4
SECTOR = 30  # degrees
Array = NDArray[np.float64]


def sectors(vertices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Azimuths of the sectors' middles [degree], and for each True (sectors, n) on the vertices of the side in it."""
    azimuth = np.degrees(np.arctan2(vertices[:, 1], vertices[:, 0]))
    side = (np.hypot(vertices[:, 0], vertices[:, 1]) > 14.9) & (np.abs(vertices[:, 2]) < 12)
    middles = np.arange(-180, 180, SECTOR)
    apart = np.abs((azimuth - middles[:, None] + 180) % 360 - 180)
    return middles.astype(float), (apart <= SECTOR / 2) & side


def exposed(power: Array, share: float, seed: int) -> tuple[fspt.Image, float]:
    """Reduced image of a CCD with a share of glare, and the factor by which the power was multiplied."""
    ccd = replace(fspt.Detector.typical_ccd(), pixel_pitch=None, veiling_glare=share)
    metadata = {"pixel_pitch": FILM["pixel_pitch"]}
    watt = ELECTRONS / ccd.expected(fspt.Image(power, metadata=metadata), **LIGHT).mean.max()
    return reduced(ccd.expose(fspt.Image(power * watt, metadata=metadata), **LIGHT, seed=seed)), float(watt)


def misses(matrix: fspt.TransportMatrix, share: float, samples: int, seed: int) -> int:
    """Number of sectors whose interval misses the true power in one exposure."""
    phantom = fspt.Phantom.read(PHANTOM)
    image, watt = exposed(matrix.forward(phantom.exitance)[0], share, seed)
    found, count = fspt.invert(matrix, image, samples=samples, seed=seed), 0
    for part in sectors(phantom.vertices)[1]:
        weights = np.where(part & found.seen, matrix.areas, 0.0)
        low, high = found.interval(weights)
        count += not low <= float(weights @ phantom.exitance) * watt <= high
    return count


def rows_of(matrix: fspt.TransportMatrix, share: float, samples: int) -> tuple[list[list[object]], fspt.Image]:
    """Rows of the table for a share of glare, and the reduced image."""
    phantom = fspt.Phantom.read(PHANTOM)
    power = matrix.forward(phantom.exitance)[0]
    image, watt = exposed(power, share, 1)
    blind = replace(image, metadata={k: v for k, v in image.metadata.items() if "glare" not in k})
    middles, parts = sectors(phantom.vertices)
    found = {"with": fspt.invert(matrix, image, samples=samples, seed=1)}
    found["without"] = fspt.invert(matrix, blind, samples=samples, seed=1)
    rows: list[list[object]] = []
    for middle, part in zip(middles, parts, strict=True):
        weights = np.where(part & found["with"].seen & found["without"].seen, matrix.areas, 0.0)
        true = float(weights @ phantom.exitance) * watt
        light = matrix.forward(weights / matrix.areas.mean())[0]  # pixels that see the sector
        level = float((power * light).sum() / light.sum())
        row: list[object] = [share, int(middle), f"{share * power.mean() / level:.4f}"]
        for result in found.values():
            low, high = result.interval(weights)
            value = float(weights @ np.nan_to_num(result.solution))
            row += [f"{one / true:.4f}" for one in (value, low, high)]
        rows.append(row)
        print(*row, sep="\t", flush=True)
    return rows, image


def draw(rows: list[list[object]], share: float, image: fspt.Image, path: Path) -> None:
    """The picture, and the power of each sector over the true one."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6.4), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(1, 1.3))
    top = float(image.power.max())
    shown = above.imshow(np.maximum(image.power, 1e-4 * top), norm=LogNorm(1e-4 * top, top), cmap="inferno")
    above.set_title(f"nylon cylinder, seen directly and by two mirrors, glare {100 * share:g} %")
    above.set_axis_off()
    figure.colorbar(shown, ax=above, label="W/pixel", shrink=0.9)
    chosen = [[float(str(value)) for value in row] for row in rows if row[0] == share]
    azimuth, glare = (np.array([row[k] for row in chosen]) for k in (1, 2))
    for first, name, colour in ((3, "glare in the model", "C0"), (6, "left out", "C3")):
        value, low, high = (np.array([row[first + k] for row in chosen]) for k in range(3))
        below.errorbar(azimuth, value, [value - low, high - value], fmt="o", ms=4, capsize=3, color=colour, label=name)
    expected = 1 - share + glare
    below.plot(azimuth, expected, "k--", lw=0.8, label="1 - g + glare over the light of the sector")
    below.axhline(1, color="0.5", lw=0.8)
    below.set_xlabel("azimuth from the source's side [degree]; the dark side at ±180")
    below.set_ylabel("power of a sector, over the true one")
    below.legend(fontsize=8)
    below.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shares", default="0.01,0.03", help="of glare, the first one for the picture")
    parser.add_argument("--samples", type=int, default=50, help="random draws of the intervals")
    parser.add_argument("--exposures", type=int, default=0, help="whose intervals are counted; 0: the table instead")
    parser.add_argument("--matrix", type=Path, help="T.npz of an earlier run")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/stray_light.csv")
    options = parser.parse_args()
    shares = [float(text) for text in options.shares.split(",")]
    if options.matrix and options.matrix.is_file():
        matrix = fspt.read_transport(options.matrix)
    else:
        matrix = fspt.transport(SCENE, **FILM, rtol=3e-3)
        if options.matrix:
            matrix.save(options.matrix)
    if options.exposures:
        counts = [[seed, misses(matrix, shares[0], options.samples, seed)] for seed in range(1, options.exposures + 1)]
        path = options.output.with_stem(f"{options.output.stem}_exposures")
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([["seed", "intervals that miss, of 12"], *counts])
        return
    found = [rows_of(matrix, share, options.samples) for share in shares]
    rows = [row for part, _ in found for row in part]
    columns = ["share of glare", "azimuth [degree]", "glare over light"]
    columns += [f"{name}, {what}" for name in ("with", "without") for what in ("power", "low", "high")]
    with options.output.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    draw(rows, shares[0], found[0][1], options.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
