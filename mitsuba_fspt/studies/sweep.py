"""Sweeps: one image for every combination of values over a scene, an index of them, and no point rendered twice."""

from __future__ import annotations

import csv
import os
from collections.abc import Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..images.image import Image, read
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import FsptError, ImageError, SceneError
from ..runtime.interrupt import ctrl_c_held
from ..runtime.numbers import number, whole
from .sweep_point import Setting, SweepPoint, points

if TYPE_CHECKING:
    from ..rendering.render import Progress

INDEX = "index.csv"
NAMED = 5  # points that failed, beside the first of them
Images = Generator[tuple[SweepPoint, Image | FsptError], None, None]
COLUMNS = ("file", "power", "peak", "largest_error", "wall_time")


@dataclass(frozen=True)
class SweepRow:
    """One point of a sweep, as the index tells it.

    parameters : name and value, as text
    file : its image
    power, peak : sum of all pixels and brightest pixel [W]
    largest_error : of a pixel [W]; None where the image has no error
    wall_time : of the rendering [s]
    """

    parameters: dict[str, str]
    file: Path
    power: float
    peak: float
    largest_error: float | None
    wall_time: float


def sweep(
    scene: str | os.PathLike[str],
    parameters: Mapping[str, Iterable[object] | object],
    folder: str | os.PathLike[str],
    *,
    method: str | None = None,
    rtol: float | None = None,
    spp: int | None = None,
    seed: int | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> list[SweepRow]:
    """Rows of the index, one for every combination of the values, the last parameter changing fastest.

        fspt.sweep("scenes/nylon_cylinder.xml", {"f_number": [2.8, 5.6], "view": [0, 90]}, "nylon")

    Writes an EXR for each into `folder`, and `index.csv`. Points that are there already, from the same scene, data,
    values, settings and version, are not rendered again; so an interrupted sweep goes on where it was. The scene is
    loaded once for all points that differ only in numbers of the lens. The bits do not depend on `jobs` or `scheduler`
    (but for `ptracer`, whose sums take the order of the threads). `sweep_sheet.write_contact_sheet` draws the rows.

    Parameters
    ----------
    scene : name of a scene file
    parameters : values for `<default>` parameters of the scene, in a list or one alone
    folder : where the images go; made if its parent exists
    method, rtol, spp, seed : as in `render`
    jobs : processes, >= 1; None renders in this one (with scheduler 'local': as many as the machine has cores). Each
        imports the script that calls: keep the call behind `if __name__ == "__main__":`
    scheduler : address of a dask.distributed scheduler, for example 'tcp://10.0.0.1:8786', or 'local' to start one
        on this machine; needs the extra `cluster`. Workers must find the scene under the same path.
    progress : called with what is being done and the share done

    Raises
    ------
    SceneError, OpticsError, ExitanceError : a parameter, value or setting that cannot be used; where only the
        rendering showed it, the message names the point, and comes when the others are done.
    ImageError : the folder cannot be written.
    BackendError : no such scheduler, dask is missing, a worker died thrice at one point, no LLVM.
    """
    folder = Path(folder)
    jobs = None if jobs is None else whole("sweep: 'jobs'", jobs, SceneError, "2")
    _check_jobs(jobs, scheduler)
    wanted = points(Path(scene), parameters, _settings(method, rtol, spp, seed))
    _check_names(wanted)
    _check_folder(folder)
    return _completed(wanted, folder, jobs, scheduler, progress)


def _settings(method: str | None, rtol: float | None, spp: int | None, seed: int | None) -> dict[str, Setting]:
    """What every point is rendered with; SceneError for what is no number."""
    return {
        "method": method,
        "rtol": None if rtol is None else number("sweep: 'rtol'", rtol, SceneError, "1e-3"),
        "spp": None if spp is None else whole("sweep: 'spp'", spp, SceneError, "256"),
        "seed": None if seed is None else whole("sweep: 'seed'", seed, SceneError, "1"),
    }


def _completed(
    wanted: list[SweepPoint], folder: Path, jobs: int | None, scheduler: str | None, progress: Progress | None
) -> list[SweepRow]:
    """Rows of all points, rendered where their image is not there yet; the index tells those that are."""
    rows = {point.file: row for point in wanted if (row := _finished(point, folder)) is not None}
    missing = _by_geometry(point for point in wanted if point.file not in rows)
    failed: dict[str, FsptError] = {}

    def tell() -> None:
        if progress:
            done = len(rows) + len(failed)
            progress(f"{done} of {len(wanted)} points", done / len(wanted))

    tell()
    try:
        with closing(_images(missing, jobs, scheduler)) as images:
            for point, image in images:
                if isinstance(image, FsptError):
                    failed[point.label] = image
                    tell()
                    continue
                folder.mkdir(exist_ok=True)
                with ctrl_c_held():  # no image without its row in the index
                    image.write(folder / point.file)
                    rows[point.file] = _row(point, folder, image)
                tell()
    finally:
        if rows:
            with ctrl_c_held():
                _write_index([rows[point.file] for point in wanted if point.file in rows], folder / INDEX)
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
    named = ", ".join(others[:NAMED]) + (" and more" if others[NAMED:] else "")
    raise type(error)(f"{error} {len(labels)} of {len(wanted)} points failed; the others: {named}.") from error


def _images(missing: list[SweepPoint], jobs: int | None, scheduler: str | None) -> Images:
    """Points and their images, or why there is none, as they come: from here, other processes or a cluster."""
    if not missing:
        return
    if scheduler is not None:
        from .sweep_cluster import images_of_cluster

        yield from images_of_cluster(missing, scheduler, jobs)
    elif jobs is not None and jobs > 1:
        from .sweep_pool import images_of_processes

        yield from images_of_processes(missing, jobs)
    else:
        from .scene_cache import SceneCache

        cache = SceneCache()
        for point in missing:
            yield point, cache.image_or_error(point)


def _by_geometry(missing: Iterable[SweepPoint]) -> list[SweepPoint]:
    """The points with those together that one load of the scene serves."""
    groups: dict[str, list[SweepPoint]] = {}
    for point in missing:
        groups.setdefault(point.geometry, []).append(point)
    return [point for group in groups.values() for point in group]


def _finished(point: SweepPoint, folder: Path) -> SweepRow | None:
    """The row of an image that is there, whole, and made from all that would make it now."""
    if not os.path.isfile(folder / point.file):
        return None
    try:
        image = read(folder / point.file)
    except ImageError:
        return None
    return _row(point, folder, image) if image.metadata.get("fingerprint") == point.fingerprint else None


def _row(point: SweepPoint, folder: Path, image: Image) -> SweepRow:
    # As the file has it, in float32: a row says the same when it is made anew from the file.
    power = image.power.astype(np.float32)
    error = None if image.error is None else float(image.error.astype(np.float32).max())
    total, peak = float(power.sum(dtype=np.float64)), float(power.max())
    return SweepRow(point.parameters, folder / point.file, total, peak, error, float(image.metadata["wall_time"]))


def _write_index(rows: list[SweepRow], path: Path) -> None:
    with atomic_path(path, ImageError) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*rows[0].parameters, *COLUMNS])
        for row in rows:
            numbers = (row.power, row.peak, row.largest_error, row.wall_time)
            writer.writerow([*row.parameters.values(), row.file.name, *numbers])


def _check_jobs(jobs: int | None, scheduler: str | None) -> None:
    if jobs is not None and jobs < 1:
        raise SceneError(f"sweep: 'jobs' must be >= 1, got {jobs}. Give a number of processes, for example 2.")
    if jobs is not None and scheduler not in (None, "local"):
        raise SceneError(f"sweep: 'jobs' = {jobs} has no meaning for the scheduler '{scheduler}'. Leave it out.")


def _check_names(wanted: list[SweepPoint]) -> None:
    for name in wanted[0].parameters:
        if name in COLUMNS:
            raise SceneError(f"sweep: parameter '{name}' has the name of a column of {INDEX}. Rename the <default>.")


def _check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written before the work, not after it."""
    if os.path.exists(folder) and not folder.is_dir():
        raise ImageError(f"sweep: the folder '{folder}' is a file. Give another name with -o.")
    standing = folder if os.path.isdir(folder) else folder.parent
    if not os.path.isdir(standing):
        raise ImageError(f"sweep: '{folder}': the folder '{standing}' does not exist. Make it, or write elsewhere.")
    if not os.access(standing, os.W_OK):
        raise ImageError(f"sweep: the folder '{standing}' is not writable. Write elsewhere with -o.")
    try:
        os.stat(folder)
    except FileNotFoundError:
        pass
    except OSError as cause:  # a name too long
        raise ImageError(f"sweep: the folder '{folder}' cannot be made: {cause.strerror}. Give -o a name.") from cause
