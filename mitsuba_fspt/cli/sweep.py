"""`fspt sweep`: a scene over all combinations of some parameters' values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import BackendError
from ..runtime.progress_bar import progress_bar
from .options import (
    AsJson,
    MaxTime,
    Method,
    ParameterLists,
    Quiet,
    Rtol,
    SceneFile,
    Seed,
    Sensor,
    SourcePower,
    Spp,
    value_lists,
)
from .terminal import Interrupted, print_result, print_warnings

if TYPE_CHECKING:
    from ..studies.sweep import SweepRow

Format = Annotated[
    str,
    typer.Option(
        help="Of the images: exr, tif, h5, npz or fits.", autocompletion=lambda: ["exr", "tif", "h5", "npz", "fits"]
    ),
]


def sweep(
    scene: SceneFile,
    define: ParameterLists = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the images, SCENE_sweep if left out.")
    ] = None,
    method: Method = None,
    rtol: Rtol = None,
    spp: Spp = None,
    seed: Seed = None,
    sensor: Sensor = 0,
    source_power: SourcePower = None,
    format: Format = "exr",
    jobs: Annotated[int | None, typer.Option(help="Processes on this machine.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS|local", help="Scheduler of a dask.distributed cluster.")
    ] = None,
    max_time: MaxTime = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render all combinations of values: an image each, index.csv and a contact sheet.

    Run again, it renders only what is missing, was stopped by --max-time or
    made from something else: another scene, data file, value, setting or
    version.
    """
    from ..studies.sweep import INDEX, sweep

    folder = output or Path(f"{scene.stem}_sweep")
    values = value_lists(define)
    with _resumable(folder):
        with progress_bar(quiet) as progress:
            quiet_mitsuba()
            settings: dict[str, Any] = {"method": method, "rtol": rtol, "spp": spp, "seed": seed}
            settings |= {
                "sensor": sensor,
                "source_power": source_power,
                "format": format,
                "jobs": jobs,
                "scheduler": scheduler,
                "max_time": max_time,
                "progress": progress,
            }
            rows = sweep(scene, values, folder, **settings)
        sheet = _written_sheet(rows, folder / "contact_sheet.png")
    record = {"index": str(folder / INDEX), "contact_sheet": sheet and str(sheet)}
    text = f"{folder / INDEX}: {len(rows)} points, {_work(rows)}" + (
        f"\n{sheet}: all of them as pictures" if sheet else ""
    )
    points = [asdict(row) | {"file": str(row.file)} for row in rows]
    print_result(text, record | {"points": points}, as_json=as_json, quiet=quiet)
    for warning in dict.fromkeys(row.warnings for row in rows if row.warnings):
        first, *others = (row.file for row in rows if row.warnings == warning)
        print_warnings(f"{first}{f' and {len(others)} more' if others else ''}", [warning])


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Ctrl-C after the first image raises `Interrupted`, which says that the same command continues the sweep."""
    try:
        yield
    except KeyboardInterrupt as cause:
        if not folder.is_dir():
            raise
        raise Interrupted(
            f"interrupted; finished images stay in {folder}, the same command goes on from there."
        ) from cause


def _work(rows: list[SweepRow]) -> str:
    """How many points were rendered, in what time, and how many images were there already."""
    rendered = [row for row in rows if not row.reused]
    reused = f"{len(rows) - len(rendered)} reused"
    if not rendered:
        return reused
    return f"{len(rendered)} rendered in {sum(row.wall_time for row in rendered):.3g} s, {reused}"


def _written_sheet(rows: list[SweepRow], path: Path) -> Path | None:
    """Write the contact sheet to `path`; where that cannot be drawn, say so on stderr and return None."""
    from ..studies.sweep import write_contact_sheet

    try:
        write_contact_sheet(rows, path)
    except BackendError as error:
        typer.echo(f"fspt: no contact sheet: {error}", err=True)
        return None
    return path
