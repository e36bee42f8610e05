"""The contact sheet of a sweep: all its images side by side, on one scale, in W/pixel."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from ..images import picture
from ..images.image import read
from ..runtime.errors import ImageError
from .sweep import SweepRow

WIDEST = 8  # images in a row, where the parameters do not say how many
GAP = 0.04  # between the images, over their larger side
CAPTION = 0.1  # above an image, likewise


def write_contact_sheet(rows: Sequence[SweepRow], path: str | os.PathLike[str]) -> None:
    """Write the images of a sweep to a PNG file, what varies above each, one colour bar for all [W/pixel].

    A column for every value of the last parameter that varies, where several do. Where the images differ in
    size, the smaller ones stand in the upper left corner of their place.

    Raises
    ------
    ImageError : no rows, an image that cannot be read, the suffix is not .png or the file cannot be written.
    BackendError : matplotlib is not installed.
    """
    file = picture.require_png(path)
    picture.require_matplotlib()
    if not rows:
        raise ImageError("contact sheet: a sweep without points. Give the rows that sweep returned.")
    powers = [read(row.file).power for row in rows]
    scale, unit = picture.scale_and_unit(np.array([power.max() for power in powers]))
    height, width = (max(power.shape[side] for power in powers) for side in (0, 1))
    varied, same = _parameters(rows)
    columns = len(varied[-1][1]) if len(varied) > 1 else min(len(rows), WIDEST)
    lines = -(-len(rows) // columns)
    gap, caption = (int(np.ceil(share * max(height, width))) for share in (GAP, CAPTION))
    sheet = np.full((lines * (height + caption), columns * (width + gap) - gap), np.nan, np.float32)
    figure = picture.empty_figure(width=1.5 + 1.8 * columns, height=0.5 + 1.8 * sheet.shape[0] / (width + gap))
    axes = figure.add_subplot()
    for number, (row, power) in enumerate(zip(rows, powers, strict=True)):
        line, column = divmod(number, columns)
        top, left = line * (height + caption) + caption, column * (width + gap)
        sheet[top : top + power.shape[0], left : left + power.shape[1]] = power / scale
        label = "  ".join(f"{name}={row.parameters[name]}" for name, _ in varied)
        axes.text(left, top - 0.2 * caption, label, fontsize="x-small", va="bottom")
    shown = axes.imshow(sheet, cmap=picture.COLOURS, vmin=0, vmax=float(np.nanmax(sheet)) or 1.0, interpolation="none")
    axes.axis("off")
    axes.set_title("  ".join(f"{name}={value}" for name, (value,) in same), fontsize="small")
    figure.colorbar(shown, ax=axes, label=f"power [{unit}]", shrink=min(1.0, 3 / lines), aspect=20)
    picture.save_figure(figure, file)


def _parameters(rows: Sequence[SweepRow]) -> tuple[list, list]:
    """Names and values of the parameters with several values, and of those with one."""
    values = {name: list(dict.fromkeys(row.parameters[name] for row in rows)) for name in rows[0].parameters}
    varied = [(name, of) for name, of in values.items() if len(of) > 1]
    return varied, [(name, of) for name, of in values.items() if len(of) == 1]
