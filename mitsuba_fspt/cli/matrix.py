"""`fspt matrix`: the transport matrix of a scene for several views."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import TransportError
from ..runtime.progress_bar import progress_bar
from .options import AsJson, ParameterLists, Quiet, SceneFile, require_picture, require_writable, value_lists
from .terminal import Interrupted, print_result, print_warnings

if TYPE_CHECKING:
    from ..inverse.transport_matrix import TransportMatrix


def matrix(
    scene: SceneFile,
    define: ParameterLists = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write, .npz.")] = None,
    on: Annotated[
        str,
        typer.Option(help="vertex (J_n linear on faces) or face.", autocompletion=lambda: ["vertex", "face"]),
    ] = "vertex",
    rtol: Annotated[float, typer.Option(help="Error of T @ J relative to the brightest pixel.")] = 1e-3,
    sensor: Annotated[str | None, typer.Option(metavar="0,1,...", help="Sensors of the scene, a view each.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS|local", help="Scheduler of a dask.distributed cluster.")
    ] = None,
    max_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Begin no view that would end later; run again to go on.")
    ] = None,
    as_json: AsJson = False,
    png: Annotated[bool, typer.Option("--png", help="Also a picture of the sensitivity in the views.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write the matrix from J_n on a mesh [W/mm2] to the power on the pixels of all views [W].

    Lists of values are multiplied out to views, the last one fastest. Run
    again after an interrupt, it goes on with the next view.
    """
    from ..inverse.transport import transport

    file = output or Path(f"{scene.stem}.npz")
    require_writable(file, ".npz", TransportError)
    picture = file.with_suffix(".png")
    if png:
        require_picture(picture)
    start = time.perf_counter()
    with _resumable(file), progress_bar(quiet) as progress:
        quiet_mitsuba()
        found = transport(
            scene,
            on=on,
            rtol=rtol,
            sensor=None if sensor is None else _numbers(sensor),
            file=file,
            scheduler=scheduler,
            max_time=max_time,
            progress=progress,
            **value_lists(define),
        )
    summary = _summary(found, file, time.perf_counter() - start)
    if png:
        from ..inverse.sensitivity_picture import write_sensitivity

        write_sensitivity(found, picture)
        summary["picture"] = str(picture)
    if "warnings" in found.metadata:
        summary["warnings"] = found.metadata["warnings"]
        print_warnings(file, [summary["warnings"]])
    print_result(_text(summary), summary, as_json=as_json, quiet=quiet)


@contextmanager
def _resumable(file: Path) -> Iterator[None]:
    """Ctrl-C in the block raises `Interrupted`, which says that the same command goes on."""
    try:
        yield
    except KeyboardInterrupt as cause:
        if not Path(f"{file}.views").is_dir():
            raise
        raise Interrupted(
            f"interrupted; finished views stay in {file}.views, the same command goes on from there."
        ) from cause


def _numbers(text: str) -> list[int]:
    """Whole numbers between commas; TransportError for anything else."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as cause:
        raise TransportError(f"--sensor {text}: must be whole numbers, for example 0,1.") from cause


def _summary(matrix: TransportMatrix, file: Path, seconds: float) -> dict[str, Any]:
    """Numbers about a matrix and its making."""
    made = {"bytes": file.stat().st_size, "seconds": round(seconds, 3)}
    return {"file": str(file)} | matrix.summary() | made


def _text(summary: dict[str, Any]) -> str:
    """The summary in two lines."""
    views, height, width = summary["image_shape"]
    low, high = summary["sensitivity"]
    return (
        f"{summary['file']}: {views} views of {width} x {height} pixels, {summary['shape'][1]} columns, "
        f"{summary['entries']} entries, {summary['bytes'] / 1e6:.3g} MB in {summary['seconds']:.3g} s\n"
        f"{100 * summary['seen']:.3g} % of the surface is seen; {low:.2e} to {high:.2e} of its light arrives"
    )
