"""PNG pictures of images, with a calibrated colour bar and axes in mm on the sharp plane."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..runtime.atomic_files import atomic_path
from ..runtime.errors import BackendError, ImageError
from .comparison import compare
from .image import Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "inferno"  # perceptually uniform, black where there is no light
DIFFERENCES = "RdBu_r"  # white where the images agree


def write_png(image: Image, path: str | os.PathLike[str]) -> None:
    """Write a picture of `image` [W/pixel] to a PNG file, with method and lens as its title.

    Axes are in mm from the centre: on the sharp plane if the metadata hold `pixel_pitch` and `magnification`, on the
    detector if they hold the pitch alone. Without a pitch they count rows and columns.

    Raises
    ------
    ImageError : the suffix is not .png or the file cannot be written.
    BackendError : matplotlib is not installed.
    """
    with png_file(image, path):
        pass


def png_file(image: Image, path: str | os.PathLike[str]) -> AbstractContextManager[None]:
    """Context manager that writes the file of `write_png` before its block and renames it to `path` after it.

    An exception in the block leaves `path` unchanged. Raises as `write_png`.
    """
    path = require_png(path)
    figure = empty_figure(width=6.0, height=0.7 + 4.4 * _aspect(image))
    axes = figure.add_subplot()
    scale, unit = scale_and_unit(image.power)
    draw_picture(axes, image.power / scale, image, f"power [{unit}]", (0.0, float(image.power.max() / scale)))
    axes.set_title(caption(image))
    return figure_file(figure, path)


def write_comparison_png(calculated: Image, standard: Image, path: str | os.PathLike[str]) -> None:
    """Write both images on one scale, their difference and a profile to a PNG file, with ME and CF as its title.

    The profile runs along the row through the standard's brightest pixel; bands show ± `error` where it is given.
    Raises as `write_png` and `compare`.
    """
    path = require_png(path)
    comparison = compare(calculated, standard)
    figure = empty_figure(width=10.0, height=1.8 + 6.8 * _aspect(standard))
    (top_left, top_right), (bottom_left, bottom_right) = figure.subplots(2, 2)
    scale, unit = scale_and_unit(np.maximum(calculated.power, standard.power))
    high = max(calculated.power.max(), standard.power.max()) / scale
    for axes, image, name in ((top_left, calculated, "calculated"), (top_right, standard, "standard")):
        draw_picture(axes, image.power / scale, image, f"power [{unit}]", (0.0, high))
        axes.set_title(f"{name}\n{caption(image)}".strip(), fontsize="medium")
    _show_difference(bottom_left, calculated, standard)
    row = comparison.profiles[0].index
    for image, name, colour in ((standard, "standard", "C7"), (calculated, "calculated", "C3")):
        _draw_profile(bottom_right, image, row, scale, name, colour)
    (left, right, _, _), axis_label = _extent(standard)
    bottom_right.set(xlabel=axis_label, xlim=(left, right), ylabel=f"power [{unit}]", ylim=(0, None))
    bottom_right.set_title(f"row {row}", fontsize="medium")
    bottom_right.set_box_aspect(_aspect(standard))
    bottom_right.legend(frameon=False)
    ratio = "none" if comparison.ratio is None else f"{comparison.ratio:.5g}"
    figure.suptitle(
        f"ME {comparison.me:.3g},  CF {comparison.cf:.5g},  ratio of powers {ratio},  "
        f"of the peak: rms {comparison.rms:.2g}, largest error {comparison.max_error:.2g}"
    )
    save_figure(figure, path)


def caption(image: Image) -> str:
    """Method and lens of an image in one line, from those keys that its metadata hold; may be empty."""
    forms = (
        ("method", "{}"),
        ("focal_length", "F = {:g} mm"),
        ("f_number", "f/{:g}"),
        ("magnification", "magnification {:.4g}"),
    )
    known = image.metadata
    return ",  ".join(form.format(known[key]) for key, form in forms if key in known)


def draw_picture(
    axes: Axes,
    values: NDArray,
    image: Image,
    label: str,
    limits: tuple[float, float],
    colours: str = COLOURS,
) -> None:
    """Draw `values` (h, w) within `limits` in the frame of `image`, with a colour bar of that height and a `label`."""
    extent, axis_label = _extent(image)
    low, high = limits
    shown = axes.imshow(values, cmap=colours, vmin=low, vmax=high or 1.0, extent=extent)
    axes.set(xlabel=axis_label, ylabel=axis_label)
    bar = axes.inset_axes((1.03, 0.0, 0.05, 1.0))
    bar.figure.colorbar(shown, cax=bar, label=label)


def _show_difference(axes: Axes, calculated: Image, standard: Image) -> None:
    difference = calculated.power.astype(np.float64) - standard.power
    scale, unit = scale_and_unit(difference)
    reach = float(np.abs(difference).max() / scale) or 1.0
    draw_picture(axes, difference / scale, standard, f"difference [{unit}]", (-reach, reach), DIFFERENCES)
    axes.set_title("calculated − standard", fontsize="medium")


def _draw_profile(axes: Axes, image: Image, row: int, scale: float, name: str, colour: str) -> None:
    (left, right, _, _), _ = _extent(image)
    width = image.shape[1]
    x = left + (np.arange(width) + 0.5) * (right - left) / width
    power = image.power[row] / scale
    axes.plot(x, power, color=colour, label=name, linewidth=1.2)
    if image.error is not None:
        error = image.error[row] / scale
        axes.fill_between(x, power - error, power + error, color=colour, alpha=0.3, linewidth=0)


def _extent(image: Image) -> tuple[tuple[float, float, float, float], str]:
    """(left, right, bottom, top) of the picture [mm or pixels], and the axis label with unit and plane."""
    height, width = image.shape
    pitch, magnification = (image.metadata.get(key) for key in ("pixel_pitch", "magnification"))
    if not pitch:
        return (-0.5, width - 0.5, height - 0.5, -0.5), "pixel"
    side = float(pitch) / float(magnification or 1.0)
    x, y = side * width / 2, side * height / 2
    return (-x, x, -y, y), "mm on the sharp plane" if magnification else "mm on the detector"


def _aspect(image: Image) -> float:
    """Height over width, limited to [0.5, 2] for the figure."""
    return min(2.0, max(0.5, image.shape[0] / image.shape[1]))


def scale_and_unit(values: NDArray) -> tuple[float, str]:
    """Power of 1000 that scales the largest of `values` [W] to 1 … 1000, and the unit with that factor."""
    peak = float(np.abs(values).max())
    exponent = 3 * math.floor(math.log10(peak) / 3) if peak > 0 else 0
    return 10.0**exponent, "W/pixel" if exponent == 0 else rf"$10^{{{exponent}}}$ W/pixel"


def require_png(path: str | os.PathLike[str]) -> Path:
    """`path` as a Path; ImageError if its suffix is not .png."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ImageError(f"picture file '{path}': pictures are written as PNG. Give a name that ends in .png.")
    return path


def require_matplotlib() -> None:
    """Raise BackendError if matplotlib is missing."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as cause:
        raise BackendError("picture: matplotlib is not installed. pip install 'mitsuba-fspt[plot]'.") from cause


def empty_figure(width: float, height: float) -> Figure:
    """Empty figure of `width` × `height` inches, without pyplot's windows and global state."""
    require_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


@contextmanager
def figure_file(figure: Figure, path: Path) -> Iterator[None]:
    """Context manager that writes the PNG file of a figure before its block and renames it to `path` after it."""
    with atomic_path(path, ImageError) as temporary:
        figure.savefig(temporary, dpi=150)
        yield


def save_figure(figure: Figure, path: Path) -> None:
    """Write the PNG file of a figure."""
    with figure_file(figure, path):
        pass
