"""Part of scripts/paper.py: the integral against Monte Carlo at f/8 (the paper's Table 1 and Fig. 5)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from paper_common import SCENES, Array, Table, binned, figure, panel, photograph, places, save
from tissue_batches import LEFT_RIGHT, mirrored
from tissue_crosscheck import VIEWS, ratio, solve

import mitsuba_fspt as fspt
from mitsuba_fspt.tissue.phantom_file import PhantomFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FINE, COARSE = 243, 27  # pixels a side on 27 mm of the CCD; both have a row at every whole mm
BIN = FINE // COARSE
HEIGHTS = (0, 2, 4)  # mm on the detector, z_d of Fig. 5
PRINTED = {"front": (0.0104, 0.9968), "left": (0.0179, 0.9844), "back": (0.0468, 0.9606)}
TISSUE_SHARE = {"front": 0.7, "left": 1.0, "back": 1.3}  # of the paths: most where the light is least
PHOTONS = 1e8  # of the paper's Monte Carlo

Pictures = dict[str, fspt.Image]


def agreement(folder: Path, output: Path, tissue_spp: int) -> list[Table]:
    """Tables of the distances and powers; writes the figure paper_fig5.png into `output`.

    `folder`: for the solved phantom; `tissue_spp`: paths a pixel of 1 mm for the Monte Carlo from the source on.
    """
    solve(PhantomFile.read(SCENES / "nylon_cylinder.toml"), folder)
    pictures = {}
    for view, angle in VIEWS.items():
        pictures[view] = _pictures(folder, view, angle, tissue_spp)
    _draw(pictures, output / "paper_fig5.png")
    return [_free_space(pictures), _tissue(pictures), _total(pictures)]


def _pictures(folder: Path, view: str, angle: float, tissue_spp: int) -> Pictures:
    """One view by the integral, by Monte Carlo from J_n on and by Monte Carlo from the source on."""
    phantom, lens = folder / "phantom.ply", {"f_number": 8.0}
    fine, coarse = {"size": FINE, "pitch": 1 / BIN}, {"size": COARSE, "pitch": 1.0}
    film = {"width": COARSE, "height": COARSE, "pixel_pitch": 1.0, "f_number": 8.0}
    tissue = fspt.load(SCENES / "nylon_cylinder_tissue.xml", view=angle, **film)
    truth = fspt.render(tissue, spp=round(tissue_spp * TISSUE_SHARE[view]), seed=3)
    integral = photograph(phantom, angle, lens, **fine)
    return {
        "integral": integral,
        "binned": binned(integral, BIN),
        "path": photograph(phantom, angle, lens, **fine, method="path", spp=512, seed=1),
        "ptracer": photograph(phantom, angle, lens, **coarse, method="ptracer", spp=2048, seed=2),
        "counted": truth,
        "tissue": truth if view == "left" else mirrored(truth, [LEFT_RIGHT]),
        "last flight": photograph(phantom, angle, lens, law="last_flight", **coarse),
    }


def _free_space(pictures: dict[str, Pictures]) -> Table:
    """The same J_n through the lens, the integral against `path` on fine pixels and `ptracer` on those of 1 mm."""
    rows = []
    for view, images in pictures.items():
        for method, mine in (("path", "integral"), ("ptracer", "binned")):
            found = fspt.compare(images[mine], images[method])
            chi2 = found.z_test.chi2 if found.z_test else None
            rows.append((f"{view}, {method}", found.me, found.cf, found.ratio - 1, chi2))
    columns = {"view, Monte Carlo from J_n": "", "ME": ".5f", "CF": ".6f", "ΣP/ΣP − 1": "+.1e", "χ²/pixel": ".2f"}
    return Table("free-space", columns, rows)


def _tissue(pictures: dict[str, Pictures]) -> Table:
    """Pixels of 1 mm, the integral against Monte Carlo from the source on, beside the paper's Table 1."""
    rows = []
    for view, images in pictures.items():
        truth = images["tissue"]
        for name, image in (("Lambert", images["binned"]), ("last flight", images["last flight"])):
            found = fspt.compare(image, truth)
            row = (*PRINTED[view], found.me, found.cf, *noise_of(truth, image))
            counted = photon_noise(image) if name == "Lambert" else (None, None)
            rows.append((f"{view}, {name}", *row, *counted))
    columns = {"view, emission": "", "ME printed": ".4f", "CF printed": ".4f", "ME": ".4f", "CF": ".4f"}
    columns |= {"ME, noise alone": ".4f", "CF, noise alone": ".4f"}
    return Table("tissue", columns | {"ME, 1e8 photons": ".4f", "CF, 1e8 photons": ".4f"}, rows)


def noise_of(truth: fspt.Image, exact: fspt.Image) -> tuple[float, float]:
    """ME and CF between an exact image and one that differs from it only by the noise of a Monte Carlo image."""
    rng = np.random.default_rng(6)
    scale = exact.power.sum() / truth.power.sum()
    scatter = np.where(truth.power > 0, truth.error, 0)  # where no photon came the error is a bound, not a scatter
    draws = (exact.power + scale * scatter * rng.standard_normal(exact.shape) for _ in range(20))
    return _mean_distance(exact, draws)


def photon_noise(exact: fspt.Image, photons: float = PHOTONS) -> tuple[float, float]:
    """ME and CF between an image [W/W] and the counts of a Monte Carlo of this number of photons from the source."""
    rng = np.random.default_rng(4)
    return _mean_distance(exact, (rng.poisson(photons * exact.power).astype(float) for _ in range(20)))


def _mean_distance(exact: fspt.Image, draws: Iterable[Array]) -> tuple[float, float]:
    found = [fspt.compare(exact, fspt.Image(draw)) for draw in draws]
    return float(np.mean([one.me for one in found])), float(np.mean([one.cf for one in found]))


def _total(pictures: dict[str, Pictures]) -> Table:
    """Power on the CCD, also as a number of the paper's photons; errors are those of images that are not mirrored."""
    rows = []
    for view, images in pictures.items():
        everywhere = np.ones((COARSE, COARSE), bool)
        power = images["integral"].power.sum()
        row = [view, power, PHOTONS * power]
        for image in (images["binned"], images["last flight"]):
            value, error = ratio(image, images["counted"], everywhere)
            row.append(f"{value:.3f} ± {error:.3f}")
        found = images["tissue"].metadata
        rows.append([*row, float(found["spp"]) * COARSE**2, float(found["wall_time"])])
    columns = {"view": "", "ΣP [W/W]": ".3e", "photons of 1e8": ".0f", "Lambert / Monte Carlo": ""}
    columns |= {"last flight / Monte Carlo": "", "paths": ".1e", "time [s]": ".0f"}
    return Table("total", columns, rows)


def _draw(pictures: dict[str, Pictures], path: Path) -> None:
    """Images by the integral, and profiles at z_d = 0, 2, 4 mm against both kinds of Monte Carlo."""
    drawn = figure(11.0, 8.6)
    axes = drawn.subplots(3, 3)
    for k, (view, images) in enumerate(pictures.items()):
        panel(axes[0, k], images["integral"], f"{view}, integral, f/8", 20)
        _profiles(axes[1, k], images["integral"], images["path"], every=6)
        _profiles(axes[2, k], images["binned"], images["tissue"])
        axes[1, k].set_title("lines: integral; points: path from J$_n$", fontsize="small", loc="right")
        axes[2, k].set_title("lines: integral; points: from the source on", fontsize="small", loc="right")
        axes[2, k].set_xlabel("mm on the virtual detector plane")
    axes[0, 1].set_ylabel(None)
    axes[0, 2].set_ylabel(None)
    axes[1, 0].set_ylabel("W/pixel of (1/9 mm)²")
    axes[2, 0].set_ylabel("W/pixel of 1 mm²")
    axes[1, 0].legend(fontsize="small", frameon=False)
    save(drawn, path, dpi=90)


def _profiles(axes: Axes, image: fspt.Image, truth: fspt.Image, every: int = 1) -> None:
    """Power along the rows at HEIGHTS: the image as lines, the Monte Carlo as points, bars of its standard error."""
    pitch, x = float(image.metadata["pixel_pitch"]), places(image)
    for k, height in enumerate(HEIGHTS):
        row = image.shape[0] // 2 - round(height / pitch)
        axes.plot(x, image.power[row], color=f"C{k}", linewidth=1.1, label=f"$z_d$ = {height} mm")
        some = slice(every // 2, None, every)
        bars = {"fmt": ".", "markersize": 5, "capsize": 1.5, "elinewidth": 0.8}
        axes.errorbar(x[some], truth.power[row][some], truth.error[row][some], color=f"C{k}", **bars)
    axes.set(xlim=(-20, 20), ylim=(0, None))
