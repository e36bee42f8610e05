"""Figures of the pages by task: docs/matrix.png, comparisons.png, calibration.png and source.png.

    python scripts/figures_tasks.py [--only matrix,comparisons,calibration,source] [-o docs]

All show the nylon cylinder through the lens of scenes/nylon_cylinder.xml at f/2.8 on 64 x 64 pixels.

matrix : how much of the light of each surface point four views collect together
comparisons : what a pinhole and a lens without a diaphragm leave out, at equal total power
calibration : residuals of an image with noise before and after `fspt.calibrate` of view, distance and magnification
source : electrons of four views, and the located source with its 90 % intervals, from above and from the side
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

import mitsuba_fspt as fspt  # before Mitsuba
from mitsuba_fspt.inverse.sensitivity_picture import draw_sensitivity
from mitsuba_fspt.runtime.backend import ensure_variant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parent.parent
SCENE, PHANTOM = ROOT / "scenes" / "nylon_cylinder.xml", ROOT / "scenes" / "nylon_cylinder.toml"
FILM = {"width": 64, "height": 64, "pixel_pitch": 0.27, "f_number": 2.8}
VIEWS = [0, 90, 180, 270]
TRUE = {"view": 12.0, "distance": 181.0, "magnification": 0.505}
HOLE = (8.0, 0.0, -1.0)  # centre of the glowing part of the hole, 1 mm long and of 1 mm radius, x, y, z [mm]
RADIUS, HEIGHT = 15.0, 30.0  # of the cylinder [mm]
HRRT = '<string name="model" value="hrrt"/><float name="lens_diameter" value="27.5"/>'
MODELS = {"pinhole": '<string name="model" value="pinhole"/>', "lens of 27.5 mm without a diaphragm": HRRT}
Array = NDArray[np.float64]


def main() -> None:
    """Draw the figures."""
    figures: dict[str, Callable[[], Figure]] = {
        "matrix": matrix_figure,
        "comparisons": comparisons_figure,
        "calibration": calibration_figure,
        "source": source_figure,
    }
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(figures), help="figures, separated by commas")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs", help="folder for the PNG files")
    given = parser.parse_args()
    ensure_variant()
    for name in given.only.split(","):
        figures[name]().savefig(given.output / f"{name}.png", dpi=110)


def power_of(scene: str | Path = SCENE, **parameters: float) -> Array:
    """Power on the pixels [W per W of source]."""
    return np.asarray(fspt.render(fspt.load(scene, **FILM | parameters), rtol=1e-3).power, np.float64)


def shown(ax: Axes, image: Array, title: str, **colours: object) -> None:
    """Draw an image with a colour bar, without axes."""
    ax.axis("off")
    ax.set_title(title, fontsize="small")
    ax.figure.colorbar(ax.imshow(image, **colours), ax=ax, shrink=0.8)


def matrix_figure() -> Figure:
    """Sensitivity of four views together, as each of them sees it."""
    return draw_sensitivity(fspt.transport(SCENE, view=VIEWS, rtol=1e-2, **FILM))


def comparisons_figure() -> Figure:
    """The left view, and what two simpler projectors differ by at equal total power."""
    text = SCENE.read_text(encoding="utf-8").replace('"nylon_cylinder.ply"', f'"{SCENE.with_suffix(".ply")}"')
    focal = '<float name="focal_length" value="$focal_length"/>'
    due = power_of(view=90)
    figure = Figure(figsize=(10, 3), layout="constrained")
    first, *others = figure.subplots(1, 3)
    shown(first, due / due.max(), "diaphragm of f/2.8", cmap="inferno")
    for ax, (name, model) in zip(others, MODELS.items(), strict=True):
        found = power_of(text.replace(focal, focal + model), view=90)
        off = 100 * (found * due.sum() / found.sum() - due) / due.max()
        shown(ax, off, f"{name}:\ndifference [% of the brightest pixel]", cmap="RdBu_r", vmin=-10, vmax=10)
    return figure


def noisy(power: Array, per_watt: float, seed: int) -> fspt.Image:
    """Image with so many electrons for each W of `power`, and 3.5 electrons of read noise."""
    rng = np.random.default_rng(seed)
    counted = rng.poisson(power * per_watt) + 3.5 * rng.standard_normal(power.shape)
    known = {"electrons_per_watt": per_watt, "read_noise": 3.5, "pixel_pitch": FILM["pixel_pitch"]}
    return fspt.Image(counted / per_watt, np.sqrt(np.maximum(counted, 0) + 3.5**2) / per_watt, metadata=known)


def calibration_figure() -> Figure:
    """Residuals in standard deviations, by the scene's own pose and by the fitted one."""
    power = power_of(**TRUE)
    image = noisy(power, 3000 / power.max(), 2)
    found = fspt.calibrate(SCENE, image, free=list(TRUE), **FILM)
    figure = Figure(figsize=(10, 3), layout="constrained")
    first, *others = figure.subplots(1, 3)
    shown(first, image.power * 3000 / power.max(), "electrons", cmap="inferno")
    own = {"view": 0.0, "distance": 180.0, "magnification": 0.5}
    for ax, values, title in ((others[0], own, "the scene's own pose"), (others[1], found.values, "fitted pose")):
        off = (power_of(**values) - image.power) / image.error
        shown(ax, off, f"{title}:\nresidual [standard deviations]", cmap="RdBu_r", vmin=-5, vmax=5)
    return figure


def source_figure() -> Figure:
    """Electrons of four views; the located source in two sections of the cylinder."""
    powers = np.stack([power_of(view=view) for view in VIEWS])
    per_watt = 100 / powers.max()
    images = [noisy(power, per_watt, seed) for seed, power in enumerate(powers)]
    found = fspt.locate(PHANTOM, fspt.transport(SCENE, view=VIEWS, rtol=1e-2, **FILM), images).sources[0]
    figure = Figure(figsize=(15, 2.8), layout="constrained")
    panels = figure.subplots(1, 6)
    for ax, image, view in zip(panels, images, VIEWS, strict=False):
        shown(ax, image.power * per_watt, f"view {view}°: electrons", cmap="inferno")
    outlines = Circle((0, 0), RADIUS, fill=False), Rectangle((-RADIUS, -HEIGHT / 2), 2 * RADIUS, HEIGHT, fill=False)
    ends = Circle(HOLE[:2], 1, color="0.8"), Rectangle((HOLE[0] - 1, HOLE[2] - 0.5), 2, 1, color="0.8")
    for ax, across, outline, end in zip(panels[4:], (1, 2), outlines, ends, strict=True):
        ax.add_patch(outline)
        ax.add_patch(end)
        reach = np.abs(np.stack(found.position_interval) - found.position)[:, [0, across]]
        ax.errorbar(*found.position[[0, across]], xerr=reach[:, :1], yerr=reach[:, 1:], fmt=".", color="C3")
        ax.set(xlim=(-16, 16), ylim=(-16, 16), aspect="equal", xlabel="x [mm]", ylabel=f"{'xyz'[across]} [mm]")
        half = found.position_interval[1] - found.position
        texts = (f"{'xyz'[k]} {found.position[k]:.2f} ± {half[k]:.2f}" for k in (0, across))
        ax.set_title(f"{('from above', 'from the side')[across - 1]}:\n{', '.join(texts)} mm", fontsize="small")
    return figure


if __name__ == "__main__":
    main()
