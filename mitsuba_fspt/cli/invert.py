"""`fspt invert`: J_n on the phantom's surface from images of several views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import InversionError
from ..runtime.progress_bar import progress_bar
from .options import AsJson, GainError, GainPerView, Quiet, Sampled, require_picture, require_writable
from .terminal import print_result

if TYPE_CHECKING:
    from ..inverse.inversion import Inversion


def invert(
    matrix: Annotated[Path, typer.Argument(metavar="T.npz", help="Transport matrix of 'fspt matrix'.")],
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE...", help="One a view, in the order of T.npz."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Mesh with J_n to write, .ply or .vtu.")],
    samples: Annotated[int, typer.Option(help="Random draws for the intervals, 19 or more for 90 %; 0: none.")] = 0,
    seed: Annotated[int, typer.Option(help="Of the draws, not without 'samples'.")] = 0,
    confidence: Annotated[float, typer.Option(help="Of the intervals, not without 'samples'.")] = 0.9,
    weight: Annotated[float | None, typer.Option(help="Of the penalty on roughness [mm2]; found if left out.")] = None,
    gain_error: GainError = None,
    gain_per_view: GainPerView = 0.0,
    sampled: Sampled = False,
    method: Annotated[
        str,
        typer.Option(help="smooth, or mlem: without penalty and intervals.", autocompletion=lambda: ["smooth", "mlem"]),
    ] = "smooth",
    crease_angle: Annotated[
        float, typer.Option(help="Angle of an edge [degree] above which J_n is not smoothed across it; 180: none.")
    ] = 45.0,
    scene: Annotated[Path | None, typer.Option(metavar="SCENE.xml", help="Scene of T.npz, where it has moved.")] = None,
    report: Annotated[Path | None, typer.Option(help="Also a picture of images, residuals and J_n, .png.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Infer J_n [W/mm2] on the surface from the images of all views, with intervals."""
    from ..detector.reduction import read_measured
    from ..inverse.inversion import FORMATS
    from ..inverse.invert import invert
    from ..inverse.transport_matrix import read_transport

    require_writable(output, error=InversionError)
    if output.suffix.lower() not in FORMATS:
        raise InversionError(f"output file '{output}' must end in .ply or .vtu. Give a name such as phantom.ply.")
    require_apart(output, [matrix, *images], error=InversionError)
    if report:
        require_picture(report)
    with progress_bar(quiet) as progress:
        quiet_mitsuba()
        found = invert(
            read_transport(matrix),
            [read_measured(path) for path in images],
            weight=weight,
            gain_error=gain_error,
            gain_per_view=gain_per_view,
            sampled=sampled,
            samples=samples,
            seed=seed,
            confidence=confidence,
            method=method,
            crease_angle=crease_angle,
            scene=scene,
            progress=progress,
        )
    found.write(output)
    if report:
        found.report(report)
    record: dict[str, Any] = {"output": str(output), **found.summary()}
    print_result(_text(found, output), record, as_json=as_json, quiet=quiet)


def _text(found: Inversion, output: Path) -> str:
    """The result in two lines, in a third what of it is not known."""
    numbers = found.summary()
    total = f"{found.total:.5g} W"
    if "total_interval" in numbers:
        low, high = numbers["total_interval"]
        total += f" ({100 * found.confidence:g} %: {low:.5g} to {high:.5g} W)"
    left_out = f" ({100 * numbers['left_out']:.2g} % of it, seen in part, left out)" if numbers["left_out"] else ""
    return (
        f"{output}: {total} from the {100 * numbers['seen']:.3g} % of the surface that is seen{left_out}, peak "
        f"{numbers['peak']:.4g} W/mm^2\n"
        f"chi2 {found.chi2:.3g} over {found.pixels} pixels, weight {found.weight:.3g} mm^2{_unknown(found, output)}"
    )


def _unknown(found: Inversion, output: Path) -> str:
    """A line on vertices or faces that the images do not determine, at which a PLY file has J_n = 0; else empty."""
    unknown = int((~found.seen).sum())
    if not unknown or output.suffix.lower() != ".ply":
        return ""
    elements = "vertices" if found.matrix.on == "vertex" else "faces"
    return (
        f"\n{unknown} of {found.seen.size} {elements} are not determined by these images: J_n is 0 there in {output}, "
        "with seen_x = 0, and its renderings show them dark"
    )
