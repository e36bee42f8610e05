"""`fspt converge`: error against run time of every method on a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..runtime.backend import quiet_mitsuba
from ..runtime.progress_bar import progress_bar
from .options import AsJson, Parameters, Quiet, SceneFile, definitions, require_writable
from .terminal import print_result, print_warnings


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
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure error against run time of every method: both forms of the integral, the paper's sum, Monte Carlo.

    Writes SCENE_converge.csv and SCENE_converge.png, prints the fitted orders
    and the times to an error. Takes about rounds x 20 x budget and two minutes.
    """
    from ..images.picture import require_matplotlib
    from ..studies.converge import converge, empty_kernel_cache
    from ..studies.convergence_report import png_file, write_csv

    figure, sheet = (output / f"{scene.stem}_converge{suffix}" for suffix in (".png", ".csv"))
    require_writable(figure, ".png")
    require_writable(sheet, ".csv")
    require_matplotlib()
    with progress_bar(quiet) as progress, empty_kernel_cache() as kernels:
        from ..rendering.render import warnings_of
        from ..rendering.scene import load

        quiet_mitsuba()
        loaded = load(scene, **definitions(define))
        found = converge(loaded, rounds=rounds, budget=budget, reference=reference, kernels=kernels, progress=progress)
        warnings = warnings_of(loaded)
    with png_file(found, figure):  # both files or none
        write_csv(found, sheet)
    text = f"{found.render_text()}\n\n{sheet}: every setting; {figure}: the same as a figure"
    print_result(text, found.to_dict(), as_json=as_json, quiet=quiet)
    print_warnings(scene, warnings)
