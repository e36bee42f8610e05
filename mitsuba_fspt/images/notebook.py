"""Display of results in a notebook: a table of their main numbers, and a picture."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING

from ..runtime.errors import BackendError
from .deviations import Deviations
from .image_data import ImageData
from .picture import draw_comparison_profiles, draw_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100
LENS = (
    ("focal_length", "F = {:g} mm"),
    ("f_number", "f/{:g}"),
    ("magnification", "magnification {:.4g}"),
    ("transmittance", "transmittance {:.3g}"),
)


def image_png(image: ImageData) -> bytes | None:
    """PNG of the picture that `--png` writes; None without matplotlib."""
    return png_of(lambda: draw_panels([image]))


def comparison_png(comparison: Deviations) -> bytes | None:
    """PNG of the profiles of both images; None without matplotlib or without profiles."""
    return png_of(lambda: draw_comparison_profiles(comparison)) if comparison.profiles else None


def image_html(image: ImageData) -> str:
    """Table of size, power, error, scene, method and lens, with the picture where matplotlib is installed."""
    known, height, width = image.metadata, *image.shape
    rows = [
        ("pixels", f"{width} × {height}"),
        ("total power", f"{image.total_power:.6g} W"),
        ("brightest pixel", f"{image.power.max():.6g} W"),
    ]
    rows += [("masked", f"{image.masked} pixels, left out of the total")] if image.masked else []
    if image.error is not None:
        rows.append(("largest error", f"{image.error.max():.3g} W"))
    if image.coverage is not None:
        rows.append(("phantom seen by", f"{(image.coverage > 0).mean():.1%} of the pixels"))
    rows += [(key, str(known[key])) for key in ("scene", "method") if key in known]
    lens = ", ".join(form.format(known[key]) for key, form in LENS if key in known)
    rows += [("lens", lens)] if lens else []
    rows += [(key, f"{known['source_power']:g} W") for key in ("source_power",) if key in known]
    rows += [("warning", str(known["warnings"]))] if "warnings" in known else []
    return html_of("Image", rows, image_png(image))


def comparison_html(comparison: Deviations) -> str:
    """Table of the numbers with their meaning, as `render_text` prints them, and the profiles."""
    rows = []
    for line in comparison.render_text().splitlines():
        name, _, value = line.partition(" ")
        rows.append((name, value.strip()))
    return html_of("Comparison", rows, comparison_png(comparison))


def png_of(draw: Callable[[], Figure]) -> bytes | None:
    """PNG file of a figure as bytes; None where matplotlib is missing."""
    try:
        figure = draw()
    except BackendError:
        return None
    file = io.BytesIO()
    figure.savefig(file, dpi=DPI, format="png")
    return file.getvalue()


def html_of(title: str, rows: list[tuple[str, str]], png: bytes | None) -> str:
    """A table of names and values, and a picture below it whose text alternative is the table's title."""
    lines = [
        f'<tr><th scope="row" style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in rows
    ]
    picture = ""
    if png:
        data = base64.b64encode(png).decode("ascii")
        picture = f'<img alt="{title}" src="data:image/png;base64,{data}">'
    return f"<div><table><caption>{title}</caption>{''.join(lines)}</table>{picture}</div>"
