"""Sweeps: one image of a scene for every combination of parameter values, an index of them, and a contact sheet."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..images import picture
from ..images.colour_scale import ColourScale
from ..images.formats import format_of, suffixes
from ..images.image import Image, read, required_source_power
from ..images.pixel_axes import virtual_pitch
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import is_text
from ..runtime.atomic_files import atomic_path
from ..runtime.deadline import Deadline, required_time
from ..runtime.errors import FsptError, ImageError, SceneError
from ..runtime.interrupt import ctrl_c_held
from ..runtime.numbers import number, whole
from ..runtime.progress_bar import Progress, reported
from .sweep_point import Setting, SweepPoint, points

INDEX = "index.csv"
MAX_NAMED = 5  # failed points that an error message names, beside the first of them
Images = Generator[tuple[SweepPoint, Image | FsptError], None, None]
COLUMNS = ("file", "power", "peak", "largest_error", "wall_time")
# The contact sheet.
MAX_COLUMNS = 8  # images in a row, where not several parameters vary
GAP = 0.04  # between images, relative to the larger side of an image
CAPTION = 0.22  # height of the text above an image, relative likewise


@dataclass(frozen=True)
class SweepRow:
    """One point of a sweep, one row of its index.

    parameters : name and value: a number where the value is one, else its text
    file : path of its image
    power, peak : power on all pixels and on the brightest one [W]
    largest_error : largest error of a pixel [W]; None where the image has no error
    wall_time : time of the rendering [s]
    reused : True if the image existed before and was not rendered again
    warnings : what the image's metadata warn of, in one line; empty without a warning
    """

    parameters: dict[str, str | int | float]
    file: Path
    power: float
    peak: float
    largest_error: float | None
    wall_time: float
    reused: bool = field(default=False, compare=False)
    warnings: str = ""


def sweep(
    scene: str | os.PathLike[str],
    parameters: Mapping[str, Iterable[object] | object],
    folder: str | os.PathLike[str],
    *,
    method: str | None = None,
    rtol: float | None = None,
    spp: int | None = None,
    seed: int | None = None,
    sensor: int = 0,
    source_power: float | None = None,
    format: str = "exr",
    jobs: int | None = None,
    scheduler: str | None = None,
    max_time: float | None = None,
    progress: Progress | None = None,
) -> list[SweepRow]:
    """Rows of the index, one for every combination of the values, the last parameter changing fastest.

        fspt.sweep("scenes/nylon_cylinder.xml", {"f_number": [2.8, 5.6], "view": [0, 90]}, "nylon")

    Writes an image for each row into `folder`, and `index.csv`. An image that is there already and was made from the
    same scene, data, values, settings and versions is not rendered again, so that a second call continues an
    interrupted sweep. The scene is loaded once for all points that differ only in numbers of the lens. The pixels do
    not depend on `jobs` or `scheduler`, to the last bit, except with `ptracer`, whose sums depend on the order of the
    threads. `write_contact_sheet` draws the rows.

    Parameters
    ----------
    scene : name of a scene file
    parameters : values for `<default>` parameters of the scene: a list of values or one value for each name
    folder : folder of the images; created if its parent exists
    method, rtol, spp, seed, sensor : as in `render`
    source_power : power of the light source [W], for a scene that is per 1 W of it, as in `Image.scaled`
    format : suffix of the images, which chooses their format: exr, tif, h5, npz or fits
    jobs : number of processes, >= 1; None renders in this one (with scheduler 'local': one process a core). Each
        imports the script that calls: keep the call behind `if __name__ == "__main__":`
    scheduler : address of a dask.distributed scheduler, for example 'tcp://10.0.0.1:8786', or 'local' to start one
        on this machine; needs the extra `cluster`. Workers must find the scene under the same path.
    max_time : [s] for all points, each of which gets an equal part of what is left; None: no limit. The images are the
        best so far, as of `render`; a second call renders those anew that were stopped
    progress : called with the name of the stage and the share done, 0 … 1; without it a notebook shows a bar

    Raises
    ------
    SceneError, OpticsError, ExitanceError : a parameter, value or setting that cannot be used. An error of the
        rendering is raised after the other points are done, and names the point.
    ImageError : the folder cannot be written.
    BackendError : no such scheduler, dask is missing, one point ended its worker process three times, no LLVM.
    """
    folder, jobs = Path(folder), None if jobs is None else whole("sweep: 'jobs'", jobs, SceneError, "2")
    _check_jobs(jobs, scheduler)
    _check_format(format)
    settings = _settings(method, rtol, spp, seed, sensor, source_power)
    deadline = Deadline(required_time("sweep", max_time, SceneError))
    wanted = points(_path_of(scene), parameters, settings, f".{format}")
    _check_names(wanted)
    _check_folder(folder)
    with reported(progress) as report:
        return _completed(wanted, folder, jobs, scheduler, report, deadline)


def _path_of(scene: object) -> Path:
    """Name of the scene file as a path; SceneError for a scene that is loaded, or given as text or dictionary."""
    if isinstance(scene, (str, os.PathLike)) and not is_text(scene):
        return Path(scene)
    is_loaded = hasattr(scene, "id")
    file = str(scene.id()).partition(" ")[0] if is_loaded else ""  # type: ignore[attr-defined]  # no Mitsuba here
    kind = "XML text" if is_text(scene) else "a loaded scene" if is_loaded else type(scene).__name__
    name = file if file.endswith(".xml") else "scenes/nylon_cylinder.xml"
    raise SceneError(
        f"sweep: the scene must be the name of a file, whose parameters vary, got {kind}. Give for example '{name}'."
    )


def _settings(
    method: str | None,
    rtol: float | None,
    spp: int | None,
    seed: int | None,
    sensor: int,
    source_power: float | None,
) -> dict[str, Setting]:
    """The settings common to all points; SceneError for a value that is no number."""
    return {
        "method": method,
        "rtol": None if rtol is None else number("sweep: 'rtol'", rtol, SceneError, "1e-3"),
        "spp": None if spp is None else whole("sweep: 'spp'", spp, SceneError, "256"),
        "seed": None if seed is None else whole("sweep: 'seed'", seed, SceneError, "1"),
        "sensor": whole("sweep: 'sensor'", sensor, SceneError, "0"),
        "source_power": None if source_power is None else required_source_power(source_power),
    }


def _completed(
    wanted: list[SweepPoint],
    folder: Path,
    jobs: int | None,
    scheduler: str | None,
    progress: Progress,
    deadline: Deadline,
) -> list[SweepRow]:
    """Rows of all points; renders those whose image is missing, and writes the index, after an interrupt too."""
    rows = {point.file: row for point in wanted if (row := _finished(point, folder)) is not None}
    missing = _by_geometry(point for point in wanted if point.file not in rows)
    failed: dict[str, FsptError] = {}

    def report() -> None:
        done = len(rows) + len(failed)
        progress(f"{done} of {len(wanted)} points", done / len(wanted))

    report()
    try:
        with closing(_images(missing, jobs, scheduler, deadline)) as images:
            for point, image in images:
                if isinstance(image, FsptError):
                    failed[point.label] = image
                    report()
                    continue
                folder.mkdir(exist_ok=True)
                with ctrl_c_held():  # else an image could exist without its row in the index
                    image.write(folder / point.file)
                    rows[point.file] = _row(point, folder, image)
                report()
    finally:
        if rows:
            with ctrl_c_held():
                _write_index([(point, rows[point.file]) for point in wanted if point.file in rows], folder / INDEX)
    _require_all(wanted, failed)
    return [rows[point.file] for point in wanted]


def _require_all(wanted: list[SweepPoint], failed: Mapping[str, FsptError]) -> None:
    """Raise the error of the only point that failed, or that of the first with the names of some others."""
    labels = [point.label for point in wanted if point.label in failed]
    if not labels:
        return
    error, others = failed[labels[0]], labels[1:]
    if not others:
        raise error
    named = ", ".join(others[:MAX_NAMED]) + (" and more" if others[MAX_NAMED:] else "")
    raise type(error)(f"{error} {len(labels)} of {len(wanted)} points failed; the others: {named}.") from error


def _images(missing: list[SweepPoint], jobs: int | None, scheduler: str | None, deadline: Deadline) -> Images:
    """Points with their images or errors in the order they are finished, by this process, others or a cluster."""
    if not missing:
        return
    if deadline.is_set:  # of a cluster: for as many workers as are asked for, at least one
        at_a_time = min(jobs or (os.cpu_count() or 1 if scheduler == "local" else 1), len(missing))
        missing = [point.within(deadline.left * at_a_time / len(missing)) for point in missing]
    if scheduler is not None:
        from .sweep_workers import images_of_cluster

        yield from images_of_cluster(missing, scheduler, jobs)
    elif jobs is not None and jobs > 1:
        from .sweep_workers import images_of_processes

        yield from images_of_processes(missing, jobs)
    else:
        from .point_renderer import PointRenderer

        renderer = PointRenderer()
        for k, point in enumerate(missing):
            timed = point.within(deadline.left / (len(missing) - k)) if deadline.is_set else point
            yield point, renderer.image_or_error(timed)


def _by_geometry(missing: Iterable[SweepPoint]) -> list[SweepPoint]:
    """The points in an order in which those that can use the same loaded scene follow one another."""
    groups: dict[str, list[SweepPoint]] = {}
    for point in missing:
        groups.setdefault(point.geometry, []).append(point)
    return [point for group in groups.values() for point in group]


def _finished(point: SweepPoint, folder: Path) -> SweepRow | None:
    """The row of a point whose image exists, is readable and has the same fingerprint; else None."""
    if not os.path.isfile(folder / point.file):
        return None
    try:
        image = read(folder / point.file)
    except ImageError:
        return None
    made_so = image.metadata.get("fingerprint") == point.fingerprint
    return replace(_row(point, folder, image), reused=True) if made_so else None


def _row(point: SweepPoint, folder: Path, image: Image) -> SweepRow:
    """The row of an image, from its float32 values, which are those in the file."""
    power = image.power.astype(np.float32)
    error = None if image.error is None else float(image.error.astype(np.float32).max())
    total, peak = float(power.sum(dtype=np.float64)), float(power.max())
    values = {name: _value(text) for name, text in point.parameters.items()}
    warnings = str(image.metadata.get("warnings", ""))
    wall_time = float(image.metadata["wall_time"])
    return SweepRow(values, folder / point.file, total, peak, error, wall_time, warnings=warnings)


def _value(text: str) -> str | int | float:
    """The number that a text stands for, whole where it is written so; any other text unchanged."""
    if not is_number(text):
        return text
    return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)


def _write_index(rows: list[tuple[SweepPoint, SweepRow]], path: Path) -> None:
    """Write the table of the points, with the texts of their values."""
    with atomic_path(path, ImageError) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*rows[0][0].parameters, *COLUMNS])
        for point, row in rows:
            numbers = (row.power, row.peak, row.largest_error, row.wall_time)
            writer.writerow([*point.parameters.values(), row.file.name, *numbers])


def _check_jobs(jobs: int | None, scheduler: str | None) -> None:
    if jobs is not None and jobs < 1:
        raise SceneError(f"sweep: 'jobs' must be >= 1, got {jobs}. Give a number of processes, for example 2.")
    if jobs is not None and scheduler not in (None, "local"):
        raise SceneError(f"sweep: 'jobs' = {jobs} has no meaning for the scheduler '{scheduler}'. Leave it out.")


def _check_format(format: str) -> None:
    """Raise ImageError for an unknown format, BackendError where it needs a missing package."""
    if f".{format}" not in suffixes():
        known = ", ".join(suffix[1:] for suffix in suffixes())
        raise ImageError(f"sweep: 'format' must be one of {known}, got '{format}'. Give for example exr.")
    format_of(f"sweep.{format}")


def _check_names(wanted: list[SweepPoint]) -> None:
    for name in wanted[0].parameters:
        if name in COLUMNS:
            raise SceneError(f"sweep: parameter '{name}' has the name of a column of {INDEX}. Rename the <default>.")


def _check_folder(folder: Path) -> None:
    """Raise ImageError for a folder that cannot be created or written, before anything is rendered."""
    if os.path.exists(folder) and not folder.is_dir():
        raise ImageError(f"sweep: the folder '{folder}' is a file. Give another name with -o.")
    existing = folder if os.path.isdir(folder) else folder.parent
    if not os.path.isdir(existing):
        raise ImageError(f"sweep: '{folder}': the folder '{existing}' does not exist. Make it, or write elsewhere.")
    if not os.access(existing, os.W_OK):
        raise ImageError(f"sweep: the folder '{existing}' is not writable. Write elsewhere with -o.")
    try:
        os.stat(folder)
    except FileNotFoundError:
        pass
    except OSError as cause:  # a name too long
        raise ImageError(f"sweep: the folder '{folder}' cannot be made: {cause.strerror}. Give -o a name.") from cause


# ---------------------------------------------------------------------- the contact sheet


def write_contact_sheet(rows: Sequence[SweepRow], path: str | os.PathLike[str]) -> None:
    """Write the images of a sweep side by side to a PNG file, with one colour bar for all [W/pixel].

    The scale is logarithmic where the peaks differ a lot, see `ColourScale.over`. Above each image are its values of
    the parameters that vary and its total power. A scale bar is in the first image, and in those of another scale.
    If several parameters vary, there is a column for every value of the last one. An image that is smaller than the
    others is drawn in the upper left corner of its cell.

    Raises
    ------
    ImageError : no rows, an image that cannot be read, the suffix is not .png or the file cannot be written.
    BackendError : matplotlib is not installed.
    """
    file = picture.require_png(path)
    picture.require_matplotlib()
    if not rows:
        raise ImageError("contact sheet: a sweep without points. Give the rows that sweep returned.")
    images = [read(row.file) for row in rows]
    powers = [image.power for image in images]
    scale = ColourScale.over(powers)
    pitches = [virtual_pitch(image.metadata) for image in images]
    height, width = (max(power.shape[side] for power in powers) for side in (0, 1))
    varied, same = _parameters(rows)
    columns = len(varied[-1][1]) if len(varied) > 1 else min(len(rows), MAX_COLUMNS)
    lines = -(-len(rows) // columns)
    gap, caption = (int(np.ceil(share * max(height, width))) for share in (GAP, CAPTION))
    sheet = np.full((lines * (height + caption), columns * (width + gap) - gap), np.nan, np.float32)
    figure = picture.empty_figure(width=1.5 + 1.8 * columns, height=0.5 + 1.8 * sheet.shape[0] / (width + gap))
    axes = figure.add_subplot()
    for place, (row, power) in enumerate(zip(rows, powers, strict=True)):
        line, column = divmod(place, columns)
        top, left = line * (height + caption) + caption, column * (width + gap)
        sheet[top : top + power.shape[0], left : left + power.shape[1]] = power
        label = "  ".join(f"{name}={row.parameters[name]}" for name, _ in varied)
        axes.text(left, top - 0.2 * caption, f"{label}\n{row.power:.3g} W", fontsize="x-small", va="bottom")
        if (pitch := pitches[place]) and (place == 0 or pitch != pitches[0]):
            picture.draw_scale_bar(axes, left, top + power.shape[0], power.shape[1], pitch)
    shown = axes.imshow(scale.values(sheet), cmap=picture.COLOURS, norm=scale.norm(), interpolation="none")
    axes.axis("off")
    axes.set_title("  ".join(f"{name}={value}" for name, (value,) in same), fontsize="small")
    figure.colorbar(shown, ax=axes, label=scale.label, shrink=min(1.0, 3 / lines), aspect=20)
    picture.save_figure(figure, file)


def _parameters(rows: Sequence[SweepRow]) -> tuple[list, list]:
    """Names and values of the parameters with several values, and those of the parameters with one value."""
    values = {name: list(dict.fromkeys(row.parameters[name] for row in rows)) for name in rows[0].parameters}
    varied = [(name, of) for name, of in values.items() if len(of) > 1]
    return varied, [(name, of) for name, of in values.items() if len(of) == 1]
