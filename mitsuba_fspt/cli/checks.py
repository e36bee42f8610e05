"""`fspt doctor`, `fspt stability` and `fspt explain`: checks of the installation, of the accuracy and of a scene."""

from __future__ import annotations

from typing import Annotated

import typer

from ..runtime.backend import quiet_mitsuba
from ..runtime.progress_bar import progress_bar
from .given_scene import Camera, FNumber, FocalLength, SceneOrPhantom, View, framing_of, one_scene
from .options import AsJson, Domain, Parameters, Quiet, Rows, Rtol, Sensor, definitions
from .terminal import print_result, print_warnings


def doctor(as_json: AsJson = False, quiet: Quiet = False) -> None:
    """Print versions, the chosen LLVM and why, devices, and a timed first kernel."""
    from ..runtime.doctor import diagnose

    diagnosis = diagnose()
    print_result(diagnosis.render_text(), diagnosis.to_dict(), as_json=as_json, quiet=quiet)
    raise typer.Exit(0 if diagnosis.usable else 2)


def stability(
    everything: Annotated[bool, typer.Option("--all", help="Also the row of 3 million triangles.")] = False,
    as_json: Rows = False,
    quiet: Quiet = False,
) -> None:
    """Compute stiff and extreme cases: each must agree with its reference to a tolerance, or be refused."""
    from ..validation.stability import check
    from ..validation.stiff_cases import cases

    quiet_mitsuba()
    results = []
    for case in cases():
        if everything or not case.slow:
            results.append(check(case))
            if not (as_json or quiet):
                typer.echo(results[-1].render_text())
    held = sum(result.ok for result in results)
    summary = f"{held} of {len(results)} hold, {sum(result.seconds for result in results):.0f} s"
    print_result(summary, [result.to_dict() for result in results], as_json=as_json, quiet=quiet)
    raise typer.Exit(0 if held == len(results) else 1)


def explain(
    scene: SceneOrPhantom,
    view: View = None,
    focal_length: FocalLength = None,
    f_number: FNumber = None,
    camera: Camera = None,
    define: Parameters = None,
    rtol: Rtol = None,
    domain: Domain = None,
    sensor: Sensor = 0,
    as_json: Rows = False,
    quiet: Quiet = False,
) -> None:
    """List the integral's shortcuts on a scene, with reason and time saved, and lines of sight and seconds by step.

    'render --no-shortcuts' takes no shortcuts. Last come the ten pixels with most lines of sight.

    Of PHANTOM.ply, the scene is that of 'fspt render PHANTOM.ply'.
    """
    with progress_bar(quiet) as progress:
        from ..rendering.render import warnings_of
        from ..rendering.scene import load
        from ..studies.explain import HEADER, WORK_HEADER, explain, work

        quiet_mitsuba()
        given = one_scene(scene, definitions(define), framing_of(view, focal_length, f_number, camera))
        loaded = load(given.scene, **given.parameters)
        rows = explain(loaded, sensor=sensor, rtol=rtol, domain=domain, progress=progress)
        steps = work(loaded, sensor=sensor, rtol=rtol, domain=domain, progress=progress)
        warnings = [*warnings_of(loaded, sensor), *filter(None, [given.warning])]
    table = "\n".join(
        [HEADER, *(row.render_text() for row in rows), "", WORK_HEADER, *(step.render_text() for step in steps)]
    )
    print_result(
        table, [*(row.to_dict() for row in rows), *(step.to_dict() for step in steps)], as_json=as_json, quiet=quiet
    )
    print_warnings(scene, warnings)
