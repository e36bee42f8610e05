"""Picture of an inversion: measured, fitted, residual/σ of every view, and J_n as each pixel sees it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..images.picture import empty_figure, require_png
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import ImageError
from .sensitivity_picture import Rows, view_labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESIDUAL = 4.0  # standard deviations at the ends of the colour scale
LINE = 150  # characters of a line of warnings


class Fitted(Protocol):
    """What the picture needs of an `Inversion`, whose members these are."""

    @property
    def matrix(self) -> Rows: ...

    @property
    def solution(self) -> NDArray[np.float64]: ...

    @property
    def seen(self) -> NDArray[np.bool_]: ...

    @property
    def measured(self) -> NDArray[np.float64]: ...

    @property
    def fitted(self) -> NDArray[np.float64]: ...

    @property
    def residual(self) -> NDArray[np.float64]: ...

    @property
    def warnings(self) -> Sequence[str]: ...


def exitance_images(inversion: Fitted) -> NDArray[np.float64]:
    """J_n as the pixels see it [W/mm²], (views, height, width); NaN where they see nothing of it."""
    matrix = inversion.matrix
    seen = inversion.seen.astype(np.float64)
    light, weight = matrix.forward(np.where(inversion.seen, inversion.solution, 0)), matrix.forward(seen)
    return np.divide(light, weight, out=np.full_like(light, np.nan), where=weight > 0)


def draw(inversion: Fitted) -> Figure:
    """Figure with a row a view."""
    views = len(inversion.measured)
    figure = empty_figure(width=12.5, height=0.8 + 2.9 * views)
    axes = figure.subplots(views, 4, squeeze=False)
    labels = view_labels(inversion.matrix)
    peak = float(np.nanmax(inversion.fitted)) or 1.0
    flux = exitance_images(inversion)
    highest = float(np.nanmax(flux))
    columns = (
        ("measured [W]", inversion.measured, "inferno", 0.0, peak),
        ("fitted [W]", inversion.fitted, "inferno", 0.0, peak),
        ("residual / σ", inversion.residual, "coolwarm", -RESIDUAL, RESIDUAL),
        ("J_n [W/mm²]", flux, "viridis", 0.0, highest),
    )
    for column, (title, planes, colours, least, most) in enumerate(columns):
        for row in range(views):
            ax = axes[row, column]
            drawn = ax.imshow(planes[row], vmin=least, vmax=most, cmap=colours)
            ax.set_xticks([])
            ax.set_yticks([])
            if row == 0:
                ax.set_title(title, fontsize="small")
            if column == 0:
                ax.set_ylabel(labels[row], fontsize="small")
        bar = figure.colorbar(drawn, ax=list(axes[:, column]), location="bottom", shrink=0.9, pad=0.02)
        bar.ax.locator_params(axis="x", nbins=5)
        bar.ax.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3))
    if inversion.warnings:
        told = "\n".join(fill(line, LINE) for line in inversion.warnings)
        figure.suptitle(told, fontsize="small", color="firebrick")
    return figure


def write(inversion: Fitted, path: str | os.PathLike[str]) -> Figure:
    """Write the figure to a PNG file; ImageError or BackendError where that is not possible."""
    file = require_png(path)
    figure = draw(inversion)
    with atomic_path(file, ImageError) as temporary:
        figure.savefig(temporary, dpi=110)
    return figure
