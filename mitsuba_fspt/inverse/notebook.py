"""How transport matrices and inversions show themselves in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ..images.notebook import html_of, png_of
from . import inversion_picture
from .inversion_picture import Fitted
from .sensitivity_picture import Rows, draw_sensitivity


class ShownMatrix(Rows, Protocol):
    """What the table needs of a `TransportMatrix` beside its picture."""

    metadata: Mapping[str, Any]

    @property
    def on(self) -> str: ...

    @property
    def parts(self) -> Mapping[str, slice]: ...

    def summary(self) -> dict[str, Any]: ...


class ShownInversion(Fitted, Protocol):
    """What the table needs of an `Inversion` beside its picture."""

    def summary(self) -> dict[str, Any]: ...


def matrix_png(matrix: Rows) -> bytes | None:
    """PNG of the sensitivity to the surface in each view; None without matplotlib."""
    return png_of(lambda: draw_sensitivity(matrix))


def inversion_png(inversion: Fitted) -> bytes | None:
    """PNG of `Inversion.report`; None without matplotlib."""
    return png_of(lambda: inversion_picture.draw(inversion))


def matrix_html(matrix: ShownMatrix) -> str:
    """Table of views, size, entries, sensitivity and seen share, with the picture."""
    found = matrix.summary()
    views, height, width = found["image_shape"]
    low, high = found["sensitivity"]
    parts = ", ".join(f"{name} ({part.stop - part.start})" for name, part in matrix.parts.items())
    rows = [
        ("views", f"{views} of {width} × {height} pixels"),
        ("columns", f"{found['shape'][1]}, one a {matrix.on}"),
        ("shapes", parts),
        ("entries", f"{found['entries']}, {found['entries'] / found['shape'][0]:.3g} a pixel"),
        ("rtol", f"{matrix.metadata['rtol']:g}"),
        ("surface seen", f"{found['seen']:.1%}"),
        ("share of its light that arrives", f"{low:.2e} to {high:.2e}"),
    ]
    return html_of("TransportMatrix", rows, matrix_png(matrix))


def inversion_html(inversion: ShownInversion) -> str:
    """Table of the total with its interval, fit and regularisation, with the picture."""
    found = inversion.summary()
    total = f"{found['total']:.6g} W"
    if "total_interval" in found:
        low, high = found["total_interval"]
        total += f" ({found['confidence']:.0%} interval {low:.6g} to {high:.6g} W)"
    rows = [
        ("total over what is seen", total),
        ("surface seen", f"{found['seen']:.1%}"),
        ("largest J_n", f"{found['peak']:.6g} W/mm²"),
        ("chi2", f"{found['chi2']:.4g} a degree of freedom, {found['pixels']} pixels"),
        ("weight of smoothness", f"{found['weight']:.4g}"),
        ("gain error", f"{found['gain_error']:.3g}"),
        ("samples", str(found["samples"])),
    ]
    return html_of("Inversion", rows, inversion_png(inversion))
