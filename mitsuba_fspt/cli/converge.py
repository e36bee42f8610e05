"""`fspt converge`: error against run time of every method on a scene."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.backend import quiet_mitsuba
from .options import Parameters, SceneFile, definitions, require_writable
from .terminal import progress_bar

CACHE = "DRJIT_CACHE_DIR"


def converge(
    scene: SceneFile,
    define: Parameters = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for SCENE_converge.csv and .png, which must exist.")
    ] = Path("."),
    rounds: Annotated[int, typer.Option(min=1, help="Timed rounds through all settings.")] = 5,
    budget: Annotated[float, typer.Option(help="Longest time of one picture [s]; finer settings are left out.")] = 2.0,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE.npz|.exr", help="Power and its error [W]; made where not given.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure error against run time of every method: both forms of the integral, the paper's sum, Monte Carlo.

    Writes SCENE_converge.csv and SCENE_converge.png, prints the fitted orders
    and the times to an error. Takes about rounds x 20 x budget and two minutes.
    """
    from ..images.picture import require_matplotlib
    from ..studies.converge_sheet import png_file, write_csv
    from ..studies.converge_table import render_text

    figure, sheet = (output / f"{scene.stem}_converge{suffix}" for suffix in (".png", ".csv"))
    require_writable(figure, ".png")
    require_writable(sheet, ".csv")
    require_matplotlib()
    with progress_bar() as progress, _empty_kernel_cache() as kernels:
        from ..rendering.scene import load
        from ..studies.converge import converge

        quiet_mitsuba()
        loaded = load(scene, **definitions(define))
        found = converge(loaded, rounds=rounds, budget=budget, reference=reference, kernels=kernels, progress=progress)
    with png_file(found, figure):  # both files or none
        write_csv(found, sheet)
    if as_json:
        typer.echo(json.dumps(found.to_dict(), allow_nan=False))
        return
    typer.echo(render_text(found))
    typer.echo(f"\n{sheet}: every setting; {figure}: the same to look at")


@contextmanager
def _empty_kernel_cache() -> Iterator[Path | None]:
    """A folder of our own for Dr.Jit's kernels, so that cold is cold; None where Dr.Jit has chosen one already."""
    if "drjit" in sys.modules:
        yield None
        return
    before = os.environ.get(CACHE)
    with tempfile.TemporaryDirectory(prefix="fspt-kernels-", ignore_cleanup_errors=True) as folder:
        os.environ[CACHE] = folder
        try:
            yield Path(folder)
        finally:
            os.environ.pop(CACHE)
            os.environ.update({CACHE: before} if before is not None else {})
