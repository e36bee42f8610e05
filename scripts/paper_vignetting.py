"""Vignetting for scripts/paper.py: a diaphragm behind the lens, as in the paper's Fig. 2(b), before a uniform disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from paper_common import DISTANCE, FOCAL, FOCUS, MAGNIFICATION, Array, Table, camera, figure, save

import mitsuba_fspt as fspt

F_NUMBERS = (2.8, 4.0, 5.6, 8.0)
BEHIND, LENS = 20.0, 22.0  # mm from the lens to the diaphragm, diameter of the lens
PIXELS, PITCH = 39, 1.0  # one row across the CCD's diagonal, 39 mm
TOUCHING = 1e-12  # mm


def vignetting(output: Path) -> list[Table]:
    """Table of the relative illumination; writes the figure paper_vignetting.png into `output`."""
    field = (np.arange(PIXELS) - PIXELS // 2) * PITCH  # mm on the detector
    right = field >= 0
    curves, points = {}, {}
    for f in F_NUMBERS:
        curves[f] = illumination(field[right] / MAGNIFICATION, FOCAL / f)
        power = _measured(f)[right]
        points[f] = power / power[0]
    _draw(field[right], points, output / "paper_vignetting.png")
    rows = []
    for f in F_NUMBERS:
        at = [float(points[f][np.searchsorted(field[right], place)]) for place in (5, 10, 15, 19)]
        rows.append((f"f/{f:g}", *at, float(np.abs(points[f] - curves[f]).max())))
    columns = {"f-number": ""} | {f"{place} mm off axis": ".3f" for place in (5, 10, 15, 19)}
    return [Table("vignetting", columns | {"largest difference": ".4f"}, rows)]


def _measured(f_number: float) -> Array:
    """Power along a row of pixels, for a uniform disk in the virtual detector plane, shape (PIXELS,) [W per W/mm²]."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([DISTANCE - FOCUS, 0, 0]).rotate([0, 1, 0], 90).scale(200)
    glow = {"type": "fspt_surface", "exitance": 1.0}
    lens = {"f_number": f_number, "lens_diameter": LENS, "diaphragm_distance": BEHIND}
    scene = camera({"type": "disk", "to_world": place, "glow": glow}, lens, (PIXELS, 1), PITCH)
    return fspt.render(scene).power[0]


def overlap(r: float, s: float, apart: Array) -> tuple[Array, Array]:
    """Area [mm²] that two circles of radii r and s share, and how far its centroid lies from the first one's centre.

    `apart` [mm]: between the centres. The centroid lies towards the second one: each circle's segment has the
    moment ± 2/3 (half the chord)³ about its own centre, and these cancel.
    """
    apart = np.clip(apart, abs(r - s) + TOUCHING, r + s)
    a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
    b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    of_second = s**2 * (b - np.sin(2 * b) / 2)
    area = r**2 * (a - np.sin(2 * a) / 2) + of_second
    return area, apart * of_second / area


def illumination(off: Array, diameter: float) -> Array:
    """Power over that on the axis at points `off` the axis [mm on the virtual detector plane], closed form.

    The diaphragm of a diameter [mm], s behind the lens, appears sF/(F − s) behind it, magnified F/(F − s). Seen from
    a point of the virtual detector plane the lens border and this entrance pupil cover each other in part. The light is
    the area they leave open, times cos⁴θ towards its centroid; what cos⁴θ varies over that area is left out.
    """
    behind = BEHIND * FOCAL / (FOCAL - BEHIND)
    growth = 1 + behind / FOCUS  # of the lens border, from the lens plane to that of the entrance pupil
    pupil = diameter / 2 * FOCAL / (FOCAL - BEHIND)

    def light(x: Array) -> Array:
        area, aside = overlap(pupil, LENS / 2 * growth, x * behind / FOCUS)
        distance = FOCUS + behind
        return area * (distance**2 / (distance**2 + (x + aside) ** 2)) ** 2

    return light(off) / light(np.zeros(1))


def _draw(field: Array, points: dict[float, Array], path: Path) -> None:
    drawn = figure(6.5, 3.8)
    axes = drawn.subplots()
    smooth = np.linspace(0, field[-1], 200)
    for k, (f, measured) in enumerate(points.items()):
        axes.plot(smooth, illumination(smooth / MAGNIFICATION, FOCAL / f), color=f"C{k}", linewidth=1.2)
        axes.plot(field, measured, "o", markersize=4, color=f"C{k}", label=f"f/{f:g}")
    distance = FOCUS + BEHIND * FOCAL / (FOCAL - BEHIND)  # of the entrance pupil from the virtual detector plane
    cos4 = (distance**2 / (distance**2 + (smooth / MAGNIFICATION) ** 2)) ** 2
    axes.plot(smooth, cos4, "k:", linewidth=1, label="cos⁴θ alone, from the entrance pupil")
    axes.set(xlabel="mm from the middle of the CCD", ylabel="power / power on the axis", ylim=(0.6, 1.02))
    axes.set_title(f"diaphragm {BEHIND:g} mm behind a lens of {LENS:g} mm; lines: two circles", fontsize="medium")
    axes.legend(fontsize="small", frameon=False)
    axes.grid(alpha=0.3)
    save(drawn, path, dpi=110)
