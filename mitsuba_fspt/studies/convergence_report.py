"""The files of a convergence study: a CSV file with every setting, a figure of error over run time."""

from __future__ import annotations

import csv
import math
import os
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from ..images import picture
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import ImageError
from .convergence import DIRECT_SUM, INTEGRAL, PEER, PTRACER, SURFACE_FORM, Convergence, Measurement

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = (
    "method",
    "knob",
    "value",
    "seconds_cold",
    "seconds_median",
    "seconds_min",
    "seconds_max",
    "rays",
    "rays_per_second",
    "share_of_raw",
    "rms_all",
    "rms_full",
    "largest",
    "drjit_mib",
)
GREY, MARKERS = "0.55", "sD^vP"
# The methods that the figure compares. All others, the further samplers of `path`, are thin and grey.
STYLES: dict[str, dict[str, Any]] = {
    INTEGRAL: {"color": "#0b5fa5", "marker": "o", "linewidth": 2.4, "markersize": 5.5, "zorder": 6},
    SURFACE_FORM: {"color": "#35a6c8", "marker": "o", "linewidth": 1.6, "markersize": 4.5, "zorder": 5},
    DIRECT_SUM: {"color": "#c03a2b", "marker": "X", "linewidth": 1.6, "markersize": 5, "zorder": 4},
    PEER: {"color": "0.1", "marker": "s", "linewidth": 2.0, "markersize": 4.5, "zorder": 5},
    PTRACER: {"color": "#d98a1f", "marker": "d", "linewidth": 1.6, "markersize": 5, "zorder": 4},
}


def write_csv(found: Convergence, path: str | os.PathLike[str]) -> None:
    """Write a CSV file: the reference with its stated errors, the raw rate of rays, then one row per setting.

    Times are in s, errors relative to the brightest pixel. Raises ImageError if the file cannot be written.
    """
    with atomic_path(path, ImageError) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, COLUMNS, restval="")
        rows.writeheader()
        own = {"rms_all": f"{found.stated:.4e}", "largest": f"{found.stated_largest:.4e}"}
        rows.writerow({"method": "reference", "knob": found.reference} | own)
        rows.writerow({"method": "raw", "rays_per_second": f"{found.raw_rate:.5g}"})
        rows.writerows(_line(row, found.raw_rate) for row in found.rows)


def _line(row: Measurement, raw_rate: float) -> dict[str, str | int]:
    """The columns of one setting; `raw_rate` in rays per second."""
    values: tuple[str | int, ...] = (
        row.method,
        row.knob,
        f"{row.value:g}",
        *(f"{t:.5f}" for t in (row.cold, row.median, min(row.seconds), max(row.seconds))),
        row.rays,
        f"{row.rate:.5g}",
        f"{row.rate / raw_rate:.4f}",
        f"{row.rms:.4e}",
        "" if math.isnan(row.rms_full) else f"{row.rms_full:.4e}",
        f"{row.largest:.4e}",
        f"{row.memory:.1f}",
    )
    return dict(zip(COLUMNS, values, strict=True))


def png_file(found: Convergence, path: str | os.PathLike[str]) -> AbstractContextManager[None]:
    """Context manager: a PNG file of error against warm run time, drawn before the block and renamed to `path` after
    it.

    Three panels: RMS error of all pixels, RMS error of pixels all of whose lines of sight meet the phantom, largest
    error. The dotted line is the stated error of the reference. Points below it are hollow; points below the range of
    the axis are drawn on its lower edge.

    Raises
    ------
    ImageError : the suffix is not .png or the file cannot be written.
    BackendError : matplotlib is not installed.
    """
    file = picture.require_png(path)
    panels = [
        ("RMS error, all pixels", found.stated, [row.rms for row in found.rows]),
        ("RMS error, pixels whose whole cone\nsees the phantom", found.stated, [row.rms_full for row in found.rows]),
        ("largest error of a pixel", found.stated_largest, [row.largest for row in found.rows]),
    ]
    panels = [panel for panel in panels if not all(map(math.isnan, panel[2]))]
    figure = picture.empty_figure(width=1.0 + 3.9 * len(panels), height=5.6)
    every = figure.subplots(1, len(panels), sharey=True)
    bottom = found.stated / 4 or min((e for *_, errors in panels for e in errors if e > 0), default=1.0)
    for axes, (title, stated, errors) in zip(every, panels, strict=True):
        _draw(axes, found, errors, stated, bottom)
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("run time, warm [s]")
    every[0].set_ylabel("error / brightest pixel")
    top = max(bottom, *(row.largest for row in found.rows))
    every[0].set_ylim(bottom / 1.5, 2 * top)
    handles, labels = every[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize="small")
    figure.suptitle(found.scene, fontsize="large")
    return picture.figure_file(figure, file)


def _draw(axes: Axes, found: Convergence, errors: list[float], stated: float, bottom: float) -> None:
    """One panel: `errors` of all rows over their times; none lower than `bottom`, hollow below `stated`."""
    others = [method for method in found.methods if method not in STYLES]
    for method in found.methods:
        thin = {"color": GREY, "marker": MARKERS[others.index(method) % len(MARKERS)]} if method in others else {}
        style = STYLES.get(method) or {**thin, "linewidth": 0.9, "markersize": 3.8, "zorder": 3}
        points = [(row, e) for row, e in zip(found.rows, errors, strict=True) if row.method == method]
        times = [row.median for row, _ in points]
        heights = [max(e, bottom) for _, e in points]
        axes.loglog(times, heights, label=method, **style)
        below = [(t, h) for t, h, (_, e) in zip(times, heights, points, strict=True) if e < stated]
        hollow = style | {"linestyle": "none", "markerfacecolor": "white", "zorder": style["zorder"] + 0.5}
        axes.plot([t for t, _ in below], [h for _, h in below], **hollow)
    if stated > 0:
        _draw_stated(axes, stated)
    axes.grid(which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_stated(axes: Axes, stated: float) -> None:
    """The dotted line at the reference's own error."""
    axes.axhline(stated, color="0.3", linestyle=":", linewidth=1.2)
    axes.annotate(
        "the reference's own error",
        (0.98, stated),
        xycoords=("axes fraction", "data"),
        xytext=(0, 3),
        textcoords="offset points",
        ha="right",
        color="0.3",
        fontsize="small",
    )
