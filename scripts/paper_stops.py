"""Part of scripts/paper.py: the diaphragm from f/2.8 to f/22, the 6 mm source seen from the left (Figs. 6-8)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from paper_common import MAGNIFICATION, PITCH, WHOLE_CONE, Array, Table, figure, panel, save, solve, stage

import mitsuba_fspt as fspt

F_NUMBERS = (2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0)  # full stops
SHOWN = (2.8, 5.6, 11.0, 22.0)  # in Fig. 6
LEFT = 90.0  # degrees
BORDER = 0.05  # of the peak: power that defines the border of the image
HALF = 0.5


def stops(folder: Path, output: Path) -> list[Table]:
    """Tables of power and extent against f-number; writes paper_fig6.png and paper_fig78.png into `output`."""
    phantom = solve("nylon_cylinder_6mm", folder)
    scenes = {f: stage(phantom, LEFT, {"f_number": f}) for f in F_NUMBERS}
    images = {f: fspt.render(scene, rtol=1e-3) for f, scene in scenes.items()}
    naive = {f: replace(naive_sum(scene), metadata=images[f].metadata) for f, scene in scenes.items()}
    _draw_pictures(images, naive, output / "paper_fig6.png")
    rows = [(f, *_numbers(image)) for f, image in images.items()]
    _draw_curves(np.array(rows), output / "paper_fig78.png")
    return [_intensity(rows), _distance(rows), _sparse(images, naive)]


def naive_sum(scene: Any) -> fspt.Image:
    """Eq. 9 summed over the centres of the phantom's faces, as the paper does it."""
    from mitsuba_fspt.validation import direct_summation

    return fspt.Image(direct_summation.solve(scene, scene.sensors()[0].camera)[0])


# ---------------------------------------------------------------------- numbers


def ratio_per_stop(f_numbers: Array, values: Array) -> Array:
    """Factor between successive values, converted to a full stop, which is a factor of 2 in N²; 1/2 if P ∝ 1/N²."""
    full = 2 * np.diff(np.log2(f_numbers))
    return (values[1:] / values[:-1]) ** (1 / full)


def peak_to_border(power: Array, share: float = BORDER) -> tuple[float, float]:
    """Column of the peak and its distance to the nearer border of the image, both in pixels.

    The peak is the vertex of the parabola through the brightest pixel and its neighbours in the row. The border is
    where, outwards along that row, the power first falls below `share` of the peak, between pixel centres by a
    straight line.
    """
    row, column = np.unravel_index(power.argmax(), power.shape)
    line = power[row]
    before, top, after = line[column - 1 : column + 2]
    bend = before - 2 * top + after
    peak = column + (0.0 if bend == 0 else (before - after) / (2 * bend))
    right = column + _crossing(line[column:], share * top)
    left = column - _crossing(line[column::-1], share * top)
    return float(peak), float(min(right - peak, peak - left))


def _crossing(line: Array, level: float) -> float:
    """Index, with a fraction, where a line that starts above a level first falls below it; inf where it never does."""
    below = np.flatnonzero(line < level)
    if len(below) == 0:
        return np.inf
    k = below[0]
    return k - 1 + (line[k - 1] - level) / (line[k - 1] - line[k])


def _numbers(image: fspt.Image) -> tuple[float, ...]:
    """Peak and mean [W], column of the peak, distances to the border at BORDER and at HALF of the peak [pixels]."""
    peak, distance = peak_to_border(image.power)
    _, half = peak_to_border(image.power, HALF)
    return float(image.power.max()), float(image.power.mean()), peak, distance, half


def _intensity(rows: list[tuple[float, ...]]) -> Table:
    f, peak, mean = np.array(rows).T[:3]
    factors = zip([None, *ratio_per_stop(f, peak)], [None, *ratio_per_stop(f, mean)], strict=True)
    columns = {"f-number": "g", "peak [W/pixel]": ".3e", "mean [W/pixel]": ".3e"}
    columns |= {"peak, factor per stop": ".3f", "mean, factor per stop": ".3f", "printed": ""}
    lines = [(*row[:3], *pair, "almost half" if pair[0] else None) for row, pair in zip(rows, factors, strict=True)]
    return Table("intensity", columns, lines)


def _distance(rows: list[tuple[float, ...]]) -> Table:
    side = PITCH / MAGNIFICATION
    columns = {"f-number": "g", "distance at 5 % [pixels]": ".2f", "[mm on the virtual detector plane]": ".3f"}
    columns |= {"distance at 50 % [pixels]": ".2f", "column of the peak": ".2f"}
    return Table("distance", columns, [(f, far, far * side, half, peak) for f, _, _, peak, far, half in rows])


def _sparse(images: dict[float, fspt.Image], naive: dict[float, fspt.Image]) -> Table:
    """Eq. 9 as a sum over points against the integral."""
    rows = []
    for f, image in images.items():
        inside = image.coverage > WHOLE_CONE
        found = fspt.compare(naive[f], image)
        empty = [100 * float(np.mean(each.power[inside] == 0)) for each in (naive[f], image)]
        rows.append((f, *empty, found.me, found.cf, naive[f].power.max() / image.power.max()))
    columns = {"f-number": "g", "pixels without light, sum [%]": ".1f", "integral [%]": ".1f"}
    columns |= {"ME": ".4f", "CF": ".3f", "brightest pixel, sum / integral": ".2g"}
    return Table("sparse", columns, rows)


# ---------------------------------------------------------------------- figures


def _draw_pictures(images: dict[float, fspt.Image], naive: dict[float, fspt.Image], path: Path) -> None:
    drawn = figure(13.0, 5.6)
    axes = drawn.subplots(2, len(SHOWN))
    for k, f in enumerate(SHOWN):
        panel(axes[0, k], images[f], f"integral, f/{f:g}", 20)
        panel(axes[1, k], naive[f], f"sum over points, f/{f:g}", 20, float(images[f].power.max()))
    for each in axes.flat:
        each.label_outer()
    save(drawn, path, dpi=88)


def _draw_curves(rows: Array, path: Path) -> None:
    f, peak, mean, _, far, half = rows.T
    side = PITCH / MAGNIFICATION
    drawn = figure(11.0, 3.4)
    left, middle, right = drawn.subplots(1, 3)
    for axes, values, name in ((left, peak, "peak"), (middle, mean, "mean")):
        axes.loglog(f, values, "o", label="integral")
        axes.loglog(f, values[-1] * (f[-1] / f) ** 2, color="0.5", linewidth=1, label="half per stop, through f/22")
        axes.set(ylabel=f"{name} power [W/pixel]")
    right.semilogx(f, far * side, "o-", label=f"border: {BORDER:.0%} of the peak")
    right.semilogx(f, half * side, "s--", label=f"border: {HALF:.0%} of the peak")
    right.set(ylabel="peak to border [mm]")
    for axes in (left, middle, right):
        axes.set_xticks(f, [f"{n:g}" for n in f])
        axes.minorticks_off()
        axes.set_xlabel("f-number")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", frameon=False)
    save(drawn, path)
