"""`fspt calibrate`: pose, focus, magnification or gain of a scene from images of a known surface."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import InversionError
from ..runtime.progress_bar import progress_bar
from .options import AsJson, Quiet, Sampled, SceneFile, Sensor, require_writable, value_lists
from .terminal import print_result

if TYPE_CHECKING:
    from ..inverse.calibrate import Calibration
    from ..inverse.calibration_fit import UndeterminedError


Views = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=V1,V2,...",
        help="Values for another <default> of the scene, a view each, or start:stop:step; repeatable.",
    ),
]


def calibrate(
    scene: SceneFile,
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGE...", help="One a view, with its error; of 'fspt reduce' or a render.")
    ],
    free: Annotated[
        str, typer.Option(metavar="A,B,...", help="<default> parameters to find, or gain, a factor on all powers.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FITTED.xml", help="Also the scene with the values found.")
    ] = None,
    define: Views = None,
    rtol: Annotated[
        float | None, typer.Option(help="Error of the integrals over the brightest pixel; from the noise if left out.")
    ] = None,
    sensor: Sensor = 0,
    sampled: Sampled = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find values of <default> parameters for which a scene gives the images.

    The scene's own values are the start. Parameters that the images do not
    determine separately are refused with the combination that stays free.
    """
    from ..detector.reduction import read_measured
    from ..inverse.calibrate import GAIN, calibrate
    from ..inverse.calibrated_scene import require_files_found, require_own_defaults
    from ..inverse.calibration_fit import CalibrationSettings, UndeterminedError

    names = [name.strip() for name in free.split(",")]
    if rtol is not None and not 0 < rtol < 1:
        raise InversionError(f"--rtol must be in (0, 1), got {rtol:g}. Give for example 1e-4.")
    if output is not None:
        require_writable(output, ".xml", InversionError)
        require_own_defaults(scene, [name for name in names if name != GAIN])
        require_files_found(scene, output)
        require_apart(output, [scene, *images], error=InversionError)
    with progress_bar(quiet) as progress:
        quiet_mitsuba()
        try:
            found = calibrate(
                scene,
                [read_measured(path) for path in images],
                free=names,
                sensor=sensor,
                sampled=sampled,
                settings=CalibrationSettings(rtol=rtol),
                progress=progress,
                **value_lists(define),
            )
        except UndeterminedError as error:
            if as_json:
                print_result("", _refusal(error), as_json=True, quiet=quiet)
            raise
    record: dict[str, Any] = {"determined": True, **found.summary()}
    if output is not None:
        found.write(output)
        record["output"] = str(output)
    print_result(_text(found), record, as_json=as_json, quiet=quiet)


def _refusal(error: UndeterminedError) -> dict[str, Any]:
    """What the images do not determine, ready for JSON."""
    return {"determined": False, "condition": error.condition, "combinations": error.combinations}


def _text(found: Calibration) -> str:
    """The result, a line a parameter."""
    lines = [f"{name} = {value:.8g} +- {found.sd[name]:.2g}" for name, value in found.values.items()]
    last = f"chi2 {found.chi2:.3g} over {found.pixels} pixels, condition number {found.condition:.3g}; "
    return "\n".join([*lines, f"{last}+- one standard deviation, units as in the scene"])
