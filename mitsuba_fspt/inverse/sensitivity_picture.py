"""Picture of how sensitive all views together are to the surface, drawn in each view."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..images.picture import empty_figure, require_png
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import ImageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_COLUMNS = 4


class Rows(Protocol):
    """What pictures need of a `TransportMatrix`, whose members these are."""

    areas: NDArray[np.float64]
    sensitivity: NDArray[np.float64]

    @property
    def views(self) -> list[dict[str, Any]]: ...

    def forward(self, exitance: NDArray[np.float64], /) -> NDArray[np.float64]: ...


def sensitivity_images(matrix: Rows) -> NDArray[np.float64]:
    """Share of the light of the surface that arrives on the pixels of all views, as each pixel sees it.

    (views, height, width); the mean over the pixel's lines of sight, NaN where it sees nothing.
    """
    per_area = np.divide(matrix.sensitivity, matrix.areas, out=np.zeros_like(matrix.areas), where=matrix.areas > 0)
    light, weight = matrix.forward(per_area), matrix.forward(np.ones_like(per_area))
    return np.divide(light, weight, out=np.full_like(light, np.nan), where=weight > 0)


def view_labels(matrix: Rows) -> list[str]:
    """Parameter values of each view, without those that all of several views share."""
    first, *others = matrix.views
    shared = {name for name, value in first.items() if others and all(view.get(name) == value for view in others)}
    return ["  ".join(f"{name}={value}" for name, value in view.items() if name not in shared) for view in matrix.views]


def draw_sensitivity(matrix: Rows) -> Figure:
    """Figure of `sensitivity_images`, side by side; BackendError without matplotlib."""
    images = sensitivity_images(matrix)
    columns = min(len(images), MOST_COLUMNS)
    rows = -(-len(images) // columns)
    figure = empty_figure(width=1.2 + 2.6 * columns, height=0.5 + 2.8 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    most = np.nanmax(images)
    for ax in axes:
        ax.axis("off")
    for ax, image, label in zip(axes, images, view_labels(matrix), strict=False):
        drawn = ax.imshow(image, vmin=0, vmax=most, cmap="viridis")
        ax.set_title(label, fontsize="small")
    bar = figure.colorbar(drawn, ax=list(axes), shrink=0.8)
    bar.set_label("share of the light of a surface point\nthat arrives on the pixels of all views", fontsize="small")
    return figure


def write_sensitivity(matrix: Rows, path: str | os.PathLike[str]) -> None:
    """Write the figure to a PNG file; ImageError or BackendError where that is not possible."""
    file = require_png(path)
    figure = draw_sensitivity(matrix)
    with atomic_path(file, ImageError) as temporary:
        figure.savefig(temporary, dpi=130)
