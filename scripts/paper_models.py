"""Part of scripts/paper.py: models with and without a diaphragm against a simulated experiment (Table 2, Fig. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from paper_common import DISTANCE, FOCAL, FOCUS, Table, Value, figure, panel, photograph, places, save, solve

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.light import PLANCK_TIMES_LIGHT

LENSES = (FOCAL / 2.8, FOCAL / 2)  # mm: the least border that a 55 mm f/2.8 lens can have, and a larger one
PRINTED = ("printed (Table 2), not stated", None, None, 0.0421, 0.8685, 0.0110, 0.9153)
VIEW = 90.0  # left, degrees
SOURCE, TIME, WAVELENGTH = 1e-8, 20.0, 650.0  # W, s, nm
SIZE, PITCH = 128, 0.216  # pixels a side, mm: 2048² pixels of 13.5 µm, binned 16 × 16
FOCI = {"front": 0, "axis": 15, "15 mm before the front": -15, "30 mm before": -30, "45 mm before": -45}  # mm
SHOWN = "30 mm before"

Pictures = dict[str, fspt.Image]


def models(folder: Path, output: Path) -> list[Table]:
    """Table of both models against the stand-in; writes the figure paper_fig9.png into `output`."""
    fine = solve("nylon_cylinder", folder, surface_edge=0.22)
    coarse = solve("nylon_cylinder", folder)
    rows: list[Sequence[Value]] = [PRINTED]
    exposures = []
    for place, beyond in FOCI.items():
        focus = FOCUS + beyond
        pictures = _pictures(fine, coarse, focus)
        if place == SHOWN:
            _draw(pictures, output / "paper_fig9.png")
        for law in ("fresnel", "lambert"):
            standard, electrons = expose(pictures[law])
            exposures.append(electrons)
            for diameter in LENSES:
                found = [fspt.compare(pictures[name], standard) for name in (f"{diameter:.1f}", "lambert")]
                numbers = [number for one in found for number in (one.me, one.cf)]
                rows.append((f"{place}, {law}", diameter, diameter * abs(DISTANCE - focus) / DISTANCE, *numbers))
    columns = {
        "lens focused on, exit of the stand-in": "",
        "lens [mm]": ".1f",
        "blur at the limb [mm]": ".1f",
        "ME, hrrt": ".4f",
        "CF, hrrt": ".4f",
    }
    table = Table("models", columns | {"ME, diaphragm": ".4f", "CF, diaphragm": ".4f"}, rows)
    least, most = min(exposures), max(exposures)
    peak = Table(
        "exposure", {"brightest pixel": "", "least [e-]": ".0f", "most [e-]": ".0f"}, [("all foci", least, most)]
    )
    return [table, peak]


def _pictures(fine: Path, coarse: Path, focus: float) -> Pictures:
    """The left view at f/8 with Fresnel's and Lambert's exit, and without a diaphragm by diameter of the lens [mm]."""

    def shot(phantom: Path, lens: dict[str, Any], law: str = "lambert") -> fspt.Image:
        lens = {"f_number": 8.0, "focus_distance": focus} | lens
        return photograph(phantom, VIEW, lens, law=law, size=SIZE, pitch=PITCH)

    pictures = {"fresnel": shot(fine, {}, "fresnel"), "lambert": shot(coarse, {})}
    return pictures | {f"{d:.1f}": shot(coarse, {"model": "hrrt", "lens_diameter": d}) for d in LENSES}


def expose(image: fspt.Image, source: float = SOURCE, seed: int = 5) -> tuple[fspt.Image, float]:
    """Image [W/W] that a cooled CCD records of an image [W per W of source], with the mean dark charge subtracted.

    `source` [W]. The second value is the brightest pixel's charge [e-].
    """
    detector = fspt.Detector.typical_ccd()
    bright = fspt.Image(image.power * source, metadata=image.metadata)
    read = detector.expose(bright, TIME, WAVELENGTH, seed=seed)
    dark = detector.expected(fspt.Image(np.zeros(image.shape), metadata=image.metadata), TIME, WAVELENGTH).mean
    energy = PLANCK_TIMES_LIGHT / (WAVELENGTH * 1e-9)  # of one photon [J]
    watts = (read.electrons - dark) * energy / (detector.quantum_efficiency * TIME * source)
    return fspt.Image(watts, None, image.coverage, image.metadata), float(read.electrons.max())


def _draw(pictures: Pictures, path: Path) -> None:
    """Fig. 9, and the row through the brightest pixel, each image over its own maximum as ME and CF take it."""
    drawn = figure(13.5, 3.1)
    axes = drawn.subplots(1, 4)
    wide = f"{LENSES[1]:.1f}"
    shown = {
        "stand-in, Fresnel exit, f/8": expose(pictures["fresnel"])[0],
        f"hrrt, D = {wide} mm": pictures[wide],
        f"diaphragm, D = {FOCAL / 8:.2f} mm": pictures["lambert"],
    }
    row = int(np.unravel_index(pictures["fresnel"].power.argmax(), pictures["fresnel"].shape)[0])
    for k, (title, image) in enumerate(shown.items()):
        panel(axes[k], image, title, 20)
        line: dict[str, Any] = {"color": "0.7", "linewidth": 4.0} if k == 0 else {"linewidth": 1.2}
        axes[3].plot(places(image), image.power[row] / image.power.max(), label=title.split(",")[0], **line)
    for each in axes[1:3]:
        each.set_ylabel(None)
    axes[3].set(xlim=(-10, 20), xlabel="mm on the virtual detector plane", ylabel="power / brightest pixel")
    axes[3].set_title("row of the peak", fontsize="medium")
    axes[3].legend(fontsize="x-small", frameon=False, loc="upper left")
    save(drawn, path)
