"""The figures of docs/model.md: the geometry of both forms of Eq. 9, and the blur disc against depth.

    python scripts/figures_model.py [-o docs]

Writes model_geometry.png and model_blur.png. The blur radius is computed from Eq. M.8 of docs/model.md alone, without
the package.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parent.parent
# The geometry drawing, in arbitrary lengths: focus, image, lens and pupil radius, phantom.
U, V, LENS, PUPIL = 6.0, 3.0, 1.75, 1.25
CENTRE, RADIUS = (6.5, 0.0), 2.05
BLUE, RED, GREEN, GREY = "#0b5fa5", "#c03a2b", "#2a7f3f", "0.45"
# The blur figure: scenes/nylon_cylinder.xml, F and u in mm, side p/t of a virtual pixel in mm.
FOCAL, FOCUS, VIRTUAL_PITCH = 55.0, 165.0, 0.216
APERTURE = 0.02  # numerical aperture of the acceptance cone

Array = NDArray[np.float64]


def main() -> None:
    """Draw both figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs", help="folder for the PNG files")
    folder = parser.parse_args().output
    draw_geometry(folder / "model_geometry.png")
    draw_blur(folder / "model_blur.png")


def blur_radius(depth: Array, focus: float, radius: float, shift: float) -> Array:
    """Signed radius R b/m of the blur disc [mm on the virtual detector plane] (Eq. M.8)."""
    b = (focus - depth) / focus
    return radius * b / (1 - (1 - shift) * b)


# ---------------------------------------------------------------------- geometry


def draw_geometry(path: Path) -> None:
    """Above, the cone of lines of sight of one virtual point; below, the blur disc of one surface point."""
    figure = Figure(figsize=(8.6, 7.4), layout="constrained")
    above, below = figure.subplots(2, 1)
    for axes in (above, below):
        _draw_stage(axes)
    _draw_pupil_form(above)
    _draw_surface_form(below)
    figure.savefig(path, dpi=110)


def _draw_stage(axes: Axes) -> None:
    """Detector, lens, diaphragm, virtual detector plane, phantom and optical axis, with their distances."""
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set(xlim=(-V - 1.5, 9.9), ylim=(-2.95, 2.75))
    axes.plot([-V - 0.5, 9.2], [0, 0], color=GREY, linewidth=0.8, linestyle="-.")
    axes.annotate("", (9.5, 0), xytext=(9.0, 0), arrowprops={"arrowstyle": "->", "color": GREY})
    axes.text(9.58, 0, "z", color=GREY, va="center")
    axes.add_patch(Circle(CENTRE, RADIUS, facecolor="#f4e3c8", edgecolor="#a06a1c", linewidth=1.4))
    axes.text(8.0, -1.95, "phantom, surface S", color="#a06a1c")
    axes.plot([U, U], [-2.3, 2.3], color=GREEN, linestyle="--", linewidth=1.2)
    axes.text(U, 2.38, "virtual detector plane", color=GREEN, ha="center")
    axes.plot([-V, -V], [-1.5, 1.5], color="0.15", linewidth=2.2)
    axes.text(-V, 1.62, "detector", ha="center")
    bulge = np.linspace(-1, 1, 60)
    width = 0.16 * (1 - bulge**2)
    outline = np.concatenate([np.stack([width, LENS * bulge], -1), np.stack([-width, LENS * bulge], -1)[::-1]])
    axes.add_patch(Polygon(outline, facecolor="#dbe9f6", edgecolor="#6f93b5"))
    for side in (-1, 1):
        axes.plot([0, 0], [side * PUPIL, side * (LENS + 0.35)], color="0.15", linewidth=3.4, solid_capstyle="butt")
    axes.text(0, LENS + 0.5, "lens and diaphragm", ha="center")
    _draw_distance(axes, (-V, 0), -2.45, "v")
    _draw_distance(axes, (0, U), -2.45, "u")
    axes.annotate(
        "", (0.42, -PUPIL), xytext=(0.42, PUPIL), arrowprops={"arrowstyle": "<->", "color": GREY, "shrinkA": 0}
    )
    axes.text(0.52, -0.42, "D", color=GREY)


def _draw_distance(axes: Axes, ends: tuple[float, float], height: float, name: str) -> None:
    axes.annotate(
        "",
        (ends[0], height),
        xytext=(ends[1], height),
        arrowprops={"arrowstyle": "<->", "color": GREY, "shrinkA": 0, "shrinkB": 0},
    )
    axes.text(sum(ends) / 2, height - 0.32, name, color=GREY, ha="center")


def _draw_pupil_form(axes: Axes) -> None:
    """Lines of sight from the pupil through one virtual point to the surface."""
    x = 0.75
    ends = [_first_hit(a, x) for a in (PUPIL, -PUPIL)]
    cone = [(0, PUPIL), (U, x), (0, -PUPIL)]
    axes.add_patch(Polygon(cone, facecolor=BLUE, alpha=0.10, edgecolor="none"))
    for a, end in zip((PUPIL, -PUPIL), ends, strict=True):
        axes.plot([-V, 0, end[0]], [-x * V / U, a, end[1]], color=BLUE, linewidth=0.9)
        axes.plot([end[0], U], [end[1], x], color=BLUE, linewidth=0.9, linestyle=":")
    a = 0.55
    r = _first_hit(a, x)
    axes.plot([-V, 0, r[0]], [-x * V / U, a, r[1]], color=RED, linewidth=1.7)
    axes.plot([r[0], U], [r[1], x], color=RED, linewidth=1.4, linestyle=":")
    axes.plot(*np.array([(0, a), r, (U, x), (-V, -x * V / U)]).T, "o", color=RED, markersize=4.5)
    axes.text(-0.34, a + 0.12, "a", color=RED, ha="center")
    axes.text(r[0] - 0.18, r[1] + 0.16, "r", color=RED, ha="right")
    axes.text(U + 0.14, x + 0.12, r"$r_{vd}$", color=RED)
    axes.text(-V - 0.16, -x * V / U - 0.1, r"$r_d$", color=RED, ha="right")
    normal = np.array([r[0] - CENTRE[0], r[1] - CENTRE[1]]) / RADIUS
    axes.annotate("", r + 0.95 * normal, xytext=r, arrowprops={"arrowstyle": "->", "color": "#a06a1c"})
    axes.text(*(r + 1.1 * normal + (0.02, 0.02)), "n", color="#a06a1c", ha="center")
    axes.text(2.2, 1.2, "lines of sight of $r_{vd}$", color=BLUE, ha="center")
    axes.set_title("pupil form: from the pixel through the pupil to the surface", fontsize="medium", loc="left")


def _first_hit(a: float, x: float) -> Array:
    """Point at which the line from the lens point a through the virtual point x first meets the phantom."""
    direction = np.array([U, x - a]) / math.hypot(U, x - a)
    away = np.array([0.0, a]) - CENTRE
    along = -float(away @ direction)
    return np.array([0.0, a]) + (along - math.sqrt(along**2 - away @ away + RADIUS**2)) * direction


def _draw_surface_form(axes: Axes) -> None:
    """Light from one surface point through the pupil, its blur disc and its image."""
    angle = math.radians(157)
    r = np.array(CENTRE) + RADIUS * np.array([math.cos(angle), math.sin(angle)])
    z, q = r
    b = (U - z) / U
    centre, radius = q / (1 - b), PUPIL * b / (1 - b)
    axes.add_patch(Polygon([(0, PUPIL), r, (0, -PUPIL)], facecolor=RED, alpha=0.10, edgecolor="none"))
    for a in (PUPIL, -PUPIL):
        x = q / (1 - b) - PUPIL * b / (1 - b) * math.copysign(1, a)
        axes.plot([-V, 0, z], [-x * V / U, a, q], color=RED, linewidth=0.9)
        axes.plot([z, U], [q, x], color=RED, linewidth=0.9, linestyle=":")
    axes.plot([U, U], [centre - radius, centre + radius], color=BLUE, linewidth=4, solid_capstyle="butt")
    axes.plot([-V, -V], [-(centre - radius) * V / U, -(centre + radius) * V / U], color=BLUE, linewidth=5, zorder=5)
    axes.plot(*r, "o", color=RED, markersize=4.5)
    axes.text(z - 0.12, q + 0.2, "r, depth z", color=RED, ha="right")
    axes.text(U + 0.15, centre, "blur disc of r,\nradius R |u − z|/z", color=BLUE, va="center")
    axes.text(-V - 0.2, -centre * V / U, "image", color=BLUE, ha="right", va="center")
    axes.set_title("surface form: from the surface through the pupil to the pixels", fontsize="medium", loc="left")


# ---------------------------------------------------------------------- blur


def draw_blur(path: Path) -> None:
    """Blur radius in pixels against depth for three stops, an entrance pupil behind the lens and a cone."""
    depth = np.linspace(120, 215, 400)
    figure = Figure(figsize=(6.8, 4.3), layout="constrained")
    axes = figure.subplots()
    for f_number, shade in ((2.8, "#08306b"), (8, "#2f7ebc"), (22, "#8fbfe0")):
        radius = FOCAL / f_number / 2
        pixels = np.abs(blur_radius(depth, FOCUS, radius, 0)) / VIRTUAL_PITCH
        axes.plot(depth, pixels, color=shade, label=f"diaphragm in the lens, f/{f_number:g}")
    behind = 20.0  # mm, distance of the diaphragm behind the lens (Eqs. M.11 and M.12)
    pupil = behind * FOCAL / (behind - FOCAL)
    radius = FOCAL / 2.8 / 2 * FOCAL / abs(behind - FOCAL) * FOCUS / abs(FOCUS - pupil)
    pixels = np.abs(blur_radius(depth, FOCUS, radius, -pupil / (FOCUS - pupil))) / VIRTUAL_PITCH
    axes.plot(depth, pixels, color="#2a7f3f", linestyle="--", label="diaphragm 20 mm behind the lens, f/2.8")
    cone = FOCUS * math.tan(math.asin(APERTURE))
    pixels = np.abs(blur_radius(depth, FOCUS, cone, 1)) / VIRTUAL_PITCH
    axes.plot(depth, pixels, color="#c03a2b", linestyle=":", label=f"acceptance cone, NA = {APERTURE:g}")
    axes.axvline(FOCUS, color=GREY, linewidth=0.8)
    axes.text(FOCUS + 0.8, 16.6, "z = u", color=GREY)
    axes.set(xlabel="depth z of the surface point [mm]", ylabel="blur radius [pixels]")
    axes.set(xlim=(depth[0], depth[-1]), ylim=(0, 18))
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
