"""PNG pictures of images, with a calibrated colour bar and axes in mm on the virtual detector plane."""

from __future__ import annotations

import math
import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ..optics.light import Light
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import BackendError, ImageError
from ..runtime.numbers import whole
from .colour_scale import ColourScale
from .colour_scale import scale_and_unit as scale_and_unit
from .deviations import Deviations, Profile
from .electrons import Electrons
from .image_data import ImageData
from .pixel_axes import PixelAxes
from .radiometry import Converted, in_unit
from .z_test import differences, error_bound

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "inferno"  # perceptually uniform, black where there is no light
DIFFERENCES = "RdBu_r"  # white where the images agree
OUTLINE = "deepskyblue"  # a colour that the colour map of powers does not contain
COLUMNS = 4  # panels in a row


def write_png(image: ImageData, path: str | os.PathLike[str], unit: str = "W", light: Light | None = None) -> None:
    """Write a picture of `image` to a PNG file, with view, total power, method and lens as its title.

    Axes are in mm from the centre: on the virtual detector plane if the metadata hold `pixel_pitch` and
    `magnification`, on the detector if they hold the pitch alone. Without a pitch they count rows and columns.

    Raises
    ------
    ImageError : the suffix is not .png, the file cannot be written, or the image cannot be shown in this `unit`, see
        `radiometry.in_unit`.
    BackendError : matplotlib is not installed.
    """
    with png_file(image, path, unit, light):
        pass


def png_file(
    image: ImageData, path: str | os.PathLike[str], unit: str = "W", light: Light | None = None
) -> AbstractContextManager[None]:
    """Context manager that writes the file of `write_png` before its block and renames it to `path` after it.

    An exception in the block leaves `path` unchanged. Raises as `write_png`.
    """
    path = require_png(path)
    return figure_file(draw_panels([image], unit=unit, light=light), path)


def write_comparison_png(
    calculated: ImageData, standard: ImageData, comparison: Deviations, path: str | os.PathLike[str]
) -> None:
    """Write both images on one scale, their difference and two profiles to a PNG file, with ME and CF as its title.

    The difference is drawn in W and in standard errors, beyond the error bound of the integral. The profiles run along
    the row and the column through the standard's brightest pixel; bands show ± `error` where it is given. Raises as
    `write_png`.
    """
    path = require_png(path)
    figure = empty_figure(width=15.0, height=1.8 + 7.2 * _aspect(standard))
    (first, second, row), (difference, deviation, column) = figure.subplots(2, 3)
    scale = ColourScale.over([np.maximum(calculated.power, standard.power)])
    for axes, image, name in ((first, calculated, "calculated"), (second, standard, "standard")):
        draw_image(axes, image, scale)
        axes.set_title(f"{name}, {title(image)}\n{caption(image)}".strip(), fontsize="medium")
    _show_difference(difference, calculated, standard)
    _show_deviation(deviation, calculated, standard, comparison)
    for axes, profile in zip((row, column), comparison.profiles, strict=True):
        _show_profile(axes, profile, calculated, standard, scale)
    ratio = "none" if comparison.ratio is None else f"{comparison.ratio:.5g}"
    figure.suptitle(
        f"ME {comparison.me:.3g},  CF {comparison.cf:.5g},  ratio of powers {ratio},  "
        f"of the peak: rms {comparison.rms:.2g}, largest error {comparison.max_error:.2g}"
    )
    save_figure(figure, path)


def caption(image: ImageData | Electrons) -> str:
    """Method and lens of an image in one line, from those keys that its metadata hold; may be empty."""
    forms = (
        ("method", "{}"),
        ("focal_length", "F = {:g} mm"),
        ("f_number", "f/{:g}"),
        ("magnification", "magnification {:.4g}"),
        ("source_power", "source {:.3g} W"),
    )
    known = image.metadata
    return ",  ".join(form.format(known[key]) for key, form in forms if key in known)


def title(image: ImageData | Electrons, name: str = "") -> str:
    """Name, view and total of an image in one line, in W or e-; the view is that of the scene's parameters, if any.

    Masked pixels are not part of the total.
    """
    view = re.search(r"(?:^|\s)view=(\S+)", str(image.metadata.get("scene", "")))
    parts = [name] if name else []
    parts += [f"view {view[1]}°"] if view else []
    if isinstance(image, Electrons):
        return ", ".join([*parts, f"total {image.total:.4g} e-"])
    return ", ".join([*parts, f"total {image.total_power:.4g} W"])


def plot_image(
    image: ImageData | Electrons,
    axes: Axes | None,
    *,
    log: bool = False,
    limits: tuple[float, float] | None = None,
    outline: bool = False,
    unit: str = "W",
    light: Light | None = None,
) -> Axes:
    """As `Image.plot`, and of an exposure."""
    shown = _shown(image, unit, light)
    scale = _scale([shown], log=log, limits=limits)
    axes = _own_axes(axes)
    draw_image(axes, image, scale, shown.values, outline=outline)
    axes.set_title("\n".join(filter(None, [title(image), caption(image)])), fontsize="medium")
    return axes


def plot_profile(image: ImageData, row: int | None, column: int | None, axes: Axes | None) -> Axes:
    """As `Image.plot_profile`."""
    if row is not None and column is not None:
        raise ImageError(f"picture: row {row} and column {column} exclude each other. Give one of them.")
    if column is None:
        along, given, count = "row", image.power.max(axis=1).argmax() if row is None else row, image.shape[0]
    else:
        along, given, count = "column", column, image.shape[1]
    index = whole(f"picture: the number of a {along}", given, ImageError, "0")
    if not 0 <= index < count:
        raise ImageError(f"picture: {along} {index} does not exist. Give one in 0 … {count - 1}.")
    power = (image.power[index] if along == "row" else image.power[:, index]).astype(np.float64)
    axes = _own_axes(axes)
    _draw_profile(axes, image, Profile(along, index, power, power), [(image, power, "power", "C3", 1.2)])
    return axes


def draw_comparison_profiles(comparison: Deviations) -> Figure:
    """Figure of the profiles of both images, power [W/pixel] over the number of the pixel."""
    count = len(comparison.profiles)
    figure = empty_figure(width=5.0 * count, height=3.2)
    for axes, profile in zip(figure.subplots(1, count, squeeze=False).flat, comparison.profiles, strict=True):
        factor, unit = scale_and_unit(np.maximum(profile.calculated, profile.standard))
        axes.plot(profile.standard / factor, color="0.65", linewidth=4.0, label="standard")
        axes.plot(profile.calculated / factor, color="C3", linewidth=1.2, label="calculated")
        axes.set(xlabel="pixel", ylabel=f"power [{unit}]", ylim=(0, None), title=f"{profile.line} {profile.index}")
        axes.legend(frameon=False)
    return figure


def _own_axes(axes: Axes | None) -> Axes:
    """`axes`, or those of a new figure of pyplot, which a notebook or `pyplot.show` shows."""
    require_matplotlib()
    if axes is not None:
        return axes
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained")[1]


def draw_panels(
    images: Sequence[ImageData | Electrons],
    names: Sequence[str] = (),
    *,
    log: bool = False,
    limits: tuple[float, float] | None = None,
    per_panel: bool = False,
    outline: bool = False,
    unit: str = "W",
    light: Light | None = None,
) -> Figure:
    """Figure with a panel for each image, up to `COLUMNS` in a row.

    Parameters
    ----------
    images : power [W] or electrons [e-]; their titles state the view and the total
    names : of the images, for the titles; none if left out
    log, limits : of the colour scale, limits in the unit that is shown; see `ColourScale.over`
    per_panel : a colour scale for each image; False: one for all
    outline : draw the outline of the phantom, where the coverage is 1/2
    unit, light : what is shown, see `radiometry.in_unit`; totals in titles are in W

    Raises
    ------
    ImageError : no images, limits that are no range or given with `per_panel`, an outline without coverage, an image
        that cannot be shown in this unit.
    BackendError : matplotlib is not installed.
    """
    if not images:
        raise ImageError("picture: no images to draw. Give one or more.")
    if per_panel and limits is not None:
        raise ImageError("picture: one range for all panels and a scale for each exclude each other. Leave one out.")
    shown = [_shown(image, unit, light) for image in images]
    scales = [_scale([one], log=log) for one in shown]
    if not per_panel:
        scales = [_scale(shown, log=log, limits=limits)] * len(images)
    figure, grid = _panel_grid(images, wide=per_panel)
    rows, columns = grid.shape
    common = len(images) > 1 and len(set(map(caption, images))) == 1
    alike = len({_extent(image) for image in images}) == 1  # then one row of axis labels suffices
    own_bar = per_panel or len(images) == 1
    for place, axes in enumerate(grid.flat):
        if place >= len(images):
            axes.axis("off")
            continue
        image, name = images[place], names[place] if names else ""
        draw_image(axes, image, scales[place], shown[place].values, outline=outline, bar=own_bar)
        lines = [*textwrap.wrap(name, 44), title(image)] if len(images) > 1 else [title(image, name)]
        lines += [] if common else [caption(image)]
        axes.set_title("\n".join(filter(None, lines)), fontsize="medium" if columns == 1 else "small")
        if alike and place % columns:
            axes.set(ylabel="", yticklabels=[])
        if alike and place + columns < len(images):
            axes.set(xlabel="", xticklabels=[])
    figure.suptitle(caption(images[0]) if common else "", fontsize="medium")
    if not own_bar:
        drawn = grid.flat[0].get_images()[0]
        ends, shrink = _extend([one.values for one in shown], scales[0]), 0.9 if rows == 1 else min(1.0, 2 / rows)
        figure.colorbar(drawn, ax=grid, label=scales[0].label, shrink=shrink, aspect=25, extend=ends)
    return figure


def _panel_grid(images: Sequence[ImageData | Electrons], wide: bool) -> tuple[Figure, NDArray[np.object_]]:
    """Empty figure and its axes, shape (rows, columns), with room for all images; `wide`: for a colour bar each too."""
    columns = len(images) if len(images) < COLUMNS else min(COLUMNS, math.ceil(len(images) ** 0.5))
    rows = -(-len(images) // columns)
    width = 6.0 if columns == 1 else 1.0 + (4.2 if wide else 3.4) * columns
    height = 4.4 if columns == 1 else 3.0
    figure = empty_figure(width, 1.0 + rows * (0.5 + height * max(map(_aspect, images))))
    return figure, figure.subplots(rows, columns, squeeze=False)


def _shown(image: ImageData | Electrons, unit: str, light: Light | None) -> Converted:
    """Values of an image in a unit, see `radiometry.in_unit`; electrons of an exposure, whatever `unit` is "W"."""
    if not isinstance(image, Electrons):
        return in_unit(image, unit, light)
    if unit != "W" or light is not None:
        raise ImageError(
            f"picture: electrons have no unit '{unit}' and no wavelength or spectrum. Leave both out, or draw the "
            "image that was exposed."
        )
    return Converted(image.electrons.astype(np.float64), None, "electrons", "e-", None)


def _scale(shown: Sequence[Converted], *, log: bool = False, limits: tuple[float, float] | None = None) -> ColourScale:
    """Colour scale over images; ImageError where their units differ."""
    if len(units := sorted({one.unit for one in shown})) > 1:
        raise ImageError(
            f"picture: {' and '.join(units)} have no common colour scale. Draw a scale for each panel, or images of "
            "one kind."
        )
    unit = shown[0].unit + ("" if shown[0].quantity == "radiance" else "/pixel")
    values, quantity = [one.values for one in shown], shown[0].quantity.replace("_", " ")
    return ColourScale.over(values, log=log, limits=limits, quantity=quantity, unit=unit)


def draw_image(
    axes: Axes,
    image: ImageData | Electrons,
    scale: ColourScale,
    values: NDArray | None = None,
    *,
    outline: bool = False,
    bar: bool = True,
) -> None:
    """Draw an image on a colour scale, with its colour bar if `bar`, and the `outline` of the phantom.

    values : (h, w) in the scale's unit; None: the image's power
    """
    values = np.asarray(image) if values is None else values
    extent, axis_label = _extent(image)
    shown = axes.imshow(scale.values(values), cmap=COLOURS, norm=scale.norm(), extent=extent)
    axes.set(xlabel=axis_label, ylabel=axis_label)
    if bar:
        side = axes.inset_axes((1.03, 0.0, 0.05, 1.0))
        side.figure.colorbar(shown, cax=side, label=scale.label, extend=_extend([values], scale))
    if outline:
        draw_outline(axes, image)


def draw_outline(axes: Axes, image: ImageData | Electrons) -> None:
    """Draw the contour where half of a pixel's lines of sight meet the phantom; ImageError without coverage."""
    if isinstance(image, Electrons) or image.coverage is None:
        raise ImageError(
            "picture: an image without coverage has no outline. Leave it out, or give one that 'fspt render' wrote."
        )
    if image.coverage.min() < 0.5 < image.coverage.max() and min(image.shape) > 1:
        place = _axes_of(image)
        axes.contour(place.x, place.y, image.coverage, levels=[0.5], colors=OUTLINE, linewidths=1.0)


def draw_scale_bar(axes: Axes, left: float, bottom: float, width: float, side: float) -> None:
    """Draw a scale bar of a round length, about a quarter of `width` pixels, into a picture in pixels.

    left, bottom : [pixels] of the picture's corner;  side : of a pixel on the virtual detector plane [mm]
    """
    wanted = 0.3 * width * side
    decade = 10.0 ** math.floor(math.log10(wanted))
    length = max(decade * step for step in (1, 2, 5) if decade * step <= wanted)
    start, at = left + 0.06 * width, bottom - 0.06 * width
    axes.plot([start, start + length / side], [at, at], color="white", linewidth=2, solid_capstyle="butt")
    axes.text(start, at - 0.02 * width, f"{length:g} mm", color="white", fontsize="x-small", va="bottom")


def draw_picture(
    axes: Axes,
    values: NDArray,
    image: ImageData,
    label: str,
    limits: tuple[float, float],
    colours: str = COLOURS,
) -> None:
    """Draw `values` (h, w) within `limits` on the axes of `image`, with a labelled colour bar of the same height."""
    extent, axis_label = _extent(image)
    low, high = limits
    shown = axes.imshow(values, cmap=colours, vmin=low, vmax=high or 1.0, extent=extent)
    axes.set(xlabel=axis_label, ylabel=axis_label)
    bar = axes.inset_axes((1.03, 0.0, 0.05, 1.0))
    bar.figure.colorbar(shown, cax=bar, label=label)


def _show_difference(axes: Axes, calculated: ImageData, standard: ImageData) -> None:
    """Draw the difference, white where a pixel of either image is masked."""
    both = calculated.kept & standard.kept
    difference = np.where(both, calculated.power.astype(np.float64) - standard.power, 0)
    scale, unit = scale_and_unit(difference)
    reach = float(np.abs(difference).max() / scale) or 1.0
    draw_picture(axes, difference / scale, standard, f"difference [{unit}]", (-reach, reach), DIFFERENCES)
    axes.set_title("calculated − standard", fontsize="medium")


def _show_deviation(axes: Axes, calculated: ImageData, standard: ImageData, comparison: Deviations) -> None:
    """Draw the difference in standard errors, white where it is not tested; a line of text if there are none."""
    test = comparison.z_test
    if test is None:
        axes.axis("off")
        axes.text(0.5, 0.5, "no image has a standard error", ha="center", transform=axes.transAxes)
        return
    z = np.nan_to_num(differences(calculated, standard))
    reach = max(test.max_z, 1.0)
    draw_picture(axes, z, standard, "difference / standard error", (-reach, reach), DIFFERENCES)
    bound = " beyond the integral's error" if error_bound(calculated, standard).any() else ""
    chi2 = "none" if test.chi2 is None else f"{test.chi2:.3g}"
    axes.set_title(f"difference{bound} in standard errors\nchi2 {chi2},  p {test.p_value:.2g}", fontsize="medium")


def _show_profile(axes: Axes, profile: Profile, calculated: ImageData, standard: ImageData, scale: ColourScale) -> None:
    """Draw the power along a row or column of both images, the calculated one as a thin line on a wide one."""
    pairs = [
        (standard, profile.standard, "standard", "0.65", 4.0),
        (calculated, profile.calculated, "calculated", "C3", 1.2),
    ]
    _draw_profile(axes, standard, profile, pairs, scale)
    axes.set_box_aspect(_aspect(standard))
    axes.legend(frameon=False)


def _draw_profile(
    axes: Axes,
    frame: ImageData,
    profile: Profile,
    curves: Sequence[tuple[ImageData, NDArray, str, str, float]],
    scale: ColourScale | None = None,
) -> None:
    """Draw curves (image, power along the profile, name, colour, line width) with bands of ± error, in mm of `frame`.

    scale : of the power; None: that of the curves
    """
    row = profile.line == "row"
    x = _axes_of(frame).x if row else _axes_of(frame).y
    scale = scale or ColourScale.over([power for _, power, *_ in curves])
    for image, power, name, colour, width in curves:
        axes.plot(x, power / scale.factor, color=colour, label=name, linewidth=width)
        if image.error is not None:
            error = (image.error[profile.index] if row else image.error[:, profile.index]) / scale.factor
            low, high = power / scale.factor - error, power / scale.factor + error
            axes.fill_between(x, low, high, color=colour, alpha=0.3, linewidth=0)
    left, right, bottom, top = _extent(frame)[0]
    axes.set(xlabel=_extent(frame)[1], xlim=(left, right) if row else sorted((bottom, top)))
    axes.set(ylabel=scale.label, ylim=(0, None))
    axes.set_title(
        f"{profile.line} {profile.index}, " + ("left to right" if row else "vertical position"), fontsize="medium"
    )


def _extend(planes: Sequence[NDArray], scale: ColourScale) -> Literal["neither", "min", "max", "both"]:
    """Ends of the colour bar beyond which there are values, in matplotlib's words."""
    below = any(bool(np.any((plane > 0) & (plane < scale.low))) for plane in planes)
    above = any(float(plane.max()) > scale.high for plane in planes)
    return "both" if below and above else "min" if below else "max" if above else "neither"


def _extent(image: ImageData | Electrons) -> tuple[tuple[float, float, float, float], str]:
    """(left, right, bottom, top) of the picture [mm or pixels], and the axis label with unit and plane."""
    axes = _axes_of(image)
    across, down = axes.step / 2, axes.down / 2
    ends = (axes.x[0] - across, axes.x[-1] + across, axes.y[-1] + down, axes.y[0] - down)
    return tuple(map(float, ends)), axes.label  # type: ignore[return-value]


def _axes_of(image: ImageData | Electrons) -> PixelAxes:
    return PixelAxes.of(image.shape, image.metadata)


def _aspect(image: ImageData | Electrons) -> float:
    """Height over width, limited to [0.5, 2] for the figure."""
    return min(2.0, max(0.5, image.shape[0] / image.shape[1]))


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
