"""Monte Carlo from the source in the tissue to the CCD against diffusion, the three laws of emission and the integral.

    python scripts/tissue_crosscheck.py [--until-error 0.005] [--batches out/tissue] [-o docs]

The phantom is nylon_cylinder.toml with its source at mid-height, (8, 0, 0), solved once (`fspt flux solve`), and
nylon_cylinder_tissue.xml, the same tissue for Mitsuba's `volpath`, with the same source. Batches of the Monte Carlo
are added to each view until the standard error of Σ P is below `--until-error`; they stay in the folder `--batches`,
from which the next run goes on.

With the source at mid-height the exact images are their own mirror images: top to bottom in every view, in front
and from the back left to right also. ME, CF and the profiles are therefore taken of the mean of the Monte Carlo image
and its mirror images (columns *raw*: without); the ratios of powers are the same with and without.

`ratio` is Σ P/Σ P of the law over the Monte Carlo, `peak` over the pixels above half of the calculated maximum, `limb`
over the outermost pixel that the phantom fills, left and right; each with the standard error of the Monte Carlo.
Images have pixels of 1 mm. A profile is the power along a band 2 mm high about z_d = 0, 2 and 4 mm on the detector
(the paper's Fig. 5), in steps of 1 mm across the CCD's 27 mm; its CF is Pearson's over those 27 values. `noise`: the
CF that an exact law would have, given the standard errors.

*transport* is last_flight on a diffusion equation with the decay constant of transport. The fluence of diffusion falls
as exp(-k r), k = √(3 µa (µa + µs')). In transport with isotropic scattering the decay constant is the root κ of
µs'/κ · artanh(κ/(µa + µs')) = 1 (Case's asymptotic mode). D = µa/κ² in place of 1/(3 (µa + µs')) corrects it.

Writes tissue_crosscheck.csv and .png into the folder `-o` and the tables into its emission.md.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper_common import MAGNIFICATION, SCENES, WHOLE_CONE, Array, Table, figure, fill, photograph, save, write_csv
from tissue_batches import LEFT_RIGHT, TOP_BOTTOM, Batches, mirrored, summed

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.media import Medium
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.tissue.phantom_file import PhantomFile
from mitsuba_fspt.tissue.solution import TissueSolution

ROOT = Path(__file__).resolve().parent.parent
VIEWS = {"front": 0, "left": 90, "back": 180}
SYMMETRY = {"front": (TOP_BOTTOM, LEFT_RIGHT), "left": (TOP_BOTTOM,), "back": (TOP_BOTTOM, LEFT_RIGHT)}
LAWS = ("lambert", "fresnel", "last_flight", "transport")
SOURCE, RADIUS = (8.0, 0.0, 0.0), 15.0  # mm; radius of the cylinder
LENS = {"f_number": 2.8}
FINE, PITCH = 54, 0.5  # pixels a side, mm: 27 mm of the CCD
BIN = 2  # to pixels of 1 mm
HEIGHTS = (0, 2, 4)  # mm on the detector, z_d of Fig. 5; bands of 2 mm

Pictures = dict[str, dict[str, fspt.Image]]


@dataclass(frozen=True)
class Transport(Medium):
    """A medium whose diffusion falls off as transport with isotropic scattering does."""

    @property
    def diffusion(self) -> float:
        """D = µa/κ² [mm]."""
        return self.mua / decay(self.mua, self.musp) ** 2


def decay(mua: float, musp: float) -> float:
    """Transport's decay constant κ [1/mm] for isotropic scattering: µs'/κ artanh(κ/(µa + µs')) = 1, by bisection."""
    low, high = 0.0, mua + musp
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if musp / middle * math.atanh(middle / (mua + musp)) < 1 else (low, middle)
    return (low + high) / 2


def solve(description: PhantomFile, folder: Path) -> TissueSolution:
    """The phantom solved, and in a folder phantom.ply and fluence.vol of it."""
    solution = description.solve()
    solution.phantom(description.surface_edge).write(folder / "phantom.ply")
    solution.volume(description.voxel).write(folder / "fluence.vol")
    return solution


def calculated(folder: Path, law: str, view: str) -> fspt.Image:
    """Image of the solved phantom under a law; its time has the emitters' tables in it."""
    start = time.perf_counter()
    emission = "last_flight" if law == "transport" else law
    image = photograph(folder / "phantom.ply", VIEWS[view], LENS, law=emission, size=FINE, pitch=PITCH)
    image.metadata["wall_time"] = time.perf_counter() - start
    return image


# ---------------------------------------------------------------------- what is compared


def coarse(image: fspt.Image) -> fspt.Image:
    """The image in pixels of 1 mm."""
    parts = [slice(k, k + BIN) for k in range(0, FINE, BIN)]
    return summed(image, parts, parts)


def bands(image: fspt.Image) -> fspt.Image:
    """Power along bands 2 mm high about z_d = 4, 2, 0, -2, -4 mm, from above, in steps of 1 mm."""
    half = round(1 / PITCH)
    rows = [round(FINE / 2 - z / PITCH) for z in (*HEIGHTS[:0:-1], *(-z for z in HEIGHTS))]
    return summed(image, [slice(r - half, r + half) for r in rows], [slice(k, k + BIN) for k in range(0, FINE, BIN)])


def profile(image: fspt.Image, height: float) -> tuple[Array, Array]:
    """Power and error along one of the `bands`."""
    row = len(HEIGHTS) - 1 - HEIGHTS.index(height)
    return np.float64(image.power[row]), np.float64(image.error[row])


def noise_cf(power: Array, error: Array) -> float:
    """CF that independent errors leave of an image without fault, 1/√(1 + ⟨σ²⟩/var P)."""
    return float(1 / math.sqrt(1 + np.square(error).mean() / power.var()))


def ratio(image: fspt.Image, truth: fspt.Image, where: NDArray[np.bool_]) -> tuple[float, float]:
    """Σ P of an image over that of the Monte Carlo on some pixels, and its standard error."""
    monte_carlo = truth.power[where].sum()
    error = math.sqrt((truth.error[where] ** 2).sum())
    value = image.power[where].sum() / monte_carlo
    return value, value * error / monte_carlo


def limb(image: fspt.Image) -> NDArray[np.bool_]:
    """The outermost pixel of each row that the phantom fills, on both sides."""
    full = image.coverage > WHOLE_CONE
    inside = np.zeros_like(full)
    inside[:, 1:-1] = full[:, :-2] & full[:, 2:]
    return full & ~inside


def powers(view: str, law: str, image: fspt.Image, truth: fspt.Image) -> list[str]:
    """A line of the table of powers; of the raw Monte Carlo, whose pixels are independent."""
    places = (image.power >= 0, image.power > image.power.max() / 2, limb(image))
    shares = ("{:.4f} ± {:.4f}".format(*ratio(image, truth, where)) for where in places)
    return [f"{view}, {law}", *shares]


def shapes(view: str, law: str, image: fspt.Image, truth: fspt.Image) -> list[Any]:
    """A line of the table of ME and CF, of images and of profiles; `image` and `truth` in the pixels of the film."""
    axes = SYMMETRY[view]
    raw, even = coarse(truth), mirrored(coarse(truth), axes)
    found = fspt.compare(coarse(image), even)
    line = [f"{view}, {law}", found.me, fspt.compare(coarse(image), raw).cf, found.cf]
    line.append(noise_cf(coarse(image).power, even.error))
    own, others = bands(image), mirrored(bands(truth), axes)
    noise = []
    for height in HEIGHTS:
        power, error = profile(own, height)[0], profile(others, height)[1]
        line.append(float(np.corrcoef(power, profile(others, height)[0])[0, 1]))
        noise.append(noise_cf(power, error))
    return [*line, min(noise)]


def tables(pictures: Pictures) -> list[Table]:
    """Powers, shapes, costs."""
    pairs = [(view, law, images[law], images["volpath"]) for view, images in pictures.items() for law in LAWS]
    share = {"view, law": "", "total": "", "peak": "", "limb": ""}
    shape = {"view, law": "", "ME": ".4f", "CF, raw": ".5f", "CF": ".5f", "noise": ".5f"}
    shape |= {f"profile at {z} mm": ".5f" for z in HEIGHTS} | {"profiles' noise": ".5f"}
    cost = {"view": "", "ΣP [W/W]": ".4e", "standard error": ".1e", "paths": ".2e", "Monte Carlo [s]": ".0f"}
    cost |= {"integral [s]": ".1f", "lines of sight": ".1e"}
    costs = []
    for view, images in pictures.items():
        truth, own = images["volpath"], images["last_flight"]
        total, error = truth.power.sum(), math.sqrt((truth.error**2).sum())
        made = (truth.metadata["spp"] * truth.power.size, truth.metadata["wall_time"])
        costs.append([view, total, error, *made, own.metadata["wall_time"], own.metadata["nodes"]])
    return [
        Table("crosscheck-power", share, [powers(v, law, coarse(i), coarse(t)) for v, law, i, t in pairs]),
        Table("crosscheck-shape", shape, [shapes(*pair) for pair in pairs]),
        Table("crosscheck-cost", cost, costs),
    ]


def decays(medium: Medium, exits: dict[str, float]) -> Table:
    """How fast light falls off, what that makes at the far side, and what leaves the phantom in all."""
    diffusion, transport = math.sqrt(medium.mua / medium.diffusion), decay(medium.mua, medium.musp)
    far = SOURCE[0] + RADIUS
    rows = [
        ["diffusion", diffusion, math.exp(-(diffusion - transport) * far), exits["last_flight"]],
        ["transport", transport, 1.0, exits["transport"]],
    ]
    columns = {"": "", "k [1/mm]": ".5f", f"over {far:g} mm, to transport": ".4f", "exit fraction": ".4f"}
    return Table("crosscheck-decay", columns, rows)


# ---------------------------------------------------------------------- output


def draw(path: Path, pictures: Pictures) -> None:
    """The profile about z_d = 0 in each view, and each law over the Monte Carlo."""
    drawn = figure(4.2 * len(pictures), 6.0)
    axes = drawn.subplots(2, len(pictures), sharex=True)
    x = (np.arange(FINE // BIN) + 0.5 - FINE / BIN / 2) * BIN * PITCH / MAGNIFICATION
    for (view, images), (top, bottom) in zip(pictures.items(), axes.T, strict=True):
        truth = mirrored(bands(images["volpath"]), SYMMETRY[view])
        mean, error = profile(truth, 0)
        seen = truth.coverage[len(HEIGHTS) - 1] > WHOLE_CONE
        top.errorbar(x, mean, error, fmt="k.", capsize=2, label="Monte Carlo, source to CCD")
        noise = error[seen] / mean[seen]
        bottom.fill_between(x[seen], 1 - noise, 1 + noise, color="0.85")
        for law in LAWS:
            line = profile(bands(images[law]), 0)[0]
            top.plot(x, line, label=law)
            bottom.plot(x[seen], line[seen] / mean[seen], label=law)
        top.set_title(view)
        bottom.axhline(1, color="k", linewidth=0.6)
        bottom.set(ylim=(0.7, 1.4), xlim=(-18, 18), xlabel="mm on the virtual detector plane")
    axes[0, 0].set_ylabel("W per mm of the band")
    axes[1, 0].set_ylabel("law / Monte Carlo")
    axes[0, 1].legend(fontsize="small", loc="upper left")
    save(drawn, path, dpi=90)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--until-error", type=float, default=0.005, help="of the power in each view, relative")
    options.add_argument("--batches", type=Path, default=ROOT / "out" / "tissue", help="folder of the Monte Carlo")
    options.add_argument("--spp", type=int, default=2048, help="paths a pixel of (0.5 mm)² in a batch")
    options.add_argument(
        "-o", "--output", type=Path, default=ROOT / "docs", help="folder of the tables and the picture"
    )
    given = options.parse_args()
    backend.ensure_variant()
    film = {"width": FINE, "height": FINE, "pixel_pitch": PITCH, "source_z": SOURCE[2], **LENS}
    pictures: Pictures = {}
    for view, angle in VIEWS.items():
        batches = Batches(given.batches, view, given.spp, film | {"view": angle})
        while (error := batches.error()) > given.until_error:
            print(f"{view}: standard error {error:.2%}", flush=True)
            batches.add()
        pictures[view] = {"volpath": batches.mean()}
    exits = {}
    description = PhantomFile.read(SCENES / "nylon_cylinder.toml")
    source = replace(description.sources[0], shape=replace(description.sources[0].shape, centre=SOURCE))
    description = replace(description, sources=(source,))
    with tempfile.TemporaryDirectory() as folder:
        for medium, laws in ((description.medium, LAWS[:-1]), (Transport(*astuple(description.medium)), LAWS[-1:])):
            solution = solve(replace(description, medium=medium), Path(folder))
            for law in laws:
                exits[law] = solution.solved.exited
                for view, images in pictures.items():
                    images[law] = calculated(Path(folder), law, view)
    made = [*tables(pictures), decays(description.medium, exits)]
    for table in made:
        print(f"\n{table.markdown()}")
    write_csv(made, given.output / "tissue_crosscheck.csv")
    if (text := given.output / "emission.md").exists():
        fill(text, made)
    draw(given.output / "tissue_crosscheck.png", pictures)


if __name__ == "__main__":
    main()
