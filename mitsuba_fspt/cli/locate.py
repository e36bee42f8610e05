"""`fspt locate`: the light sources inside a phantom from images of several views, in one band or several."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import InversionError
from ..runtime.progress_bar import progress_bar
from .options import AsJson, GainError, GainPerView, Quiet, Sampled, require_writable
from .terminal import print_result

if TYPE_CHECKING:
    from ..inverse.location import Location


Shape = Annotated[
    str,
    typer.Option(metavar="point|sphere", help="sphere: fit a radius, too.", autocompletion=lambda: ["point", "sphere"]),
]
Bands = Annotated[list[str] | None, typer.Option(help="Name of [bands.NAME] in PHANTOM.toml; one for each T.npz.")]
BandCorrelation = Annotated[
    float, typer.Option(metavar="RHO", help="Of the bands' factors (gain_error), 0 to 1; 1: one common factor.")
]


def locate(
    phantom: Annotated[Path, typer.Argument(metavar="PHANTOM.toml", help="Geometry, optics and mesh.")],
    matrix: Annotated[Path, typer.Argument(metavar="T.npz", help="Transport matrix of 'fspt matrix'.")],
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE...", help="One a view, in the order of T.npz; T.npz of a next band."),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Tetrahedra with the density to write, .vtu.")
    ] = None,
    sources: Annotated[int, typer.Option(help="Number of sources.")] = 1,
    shape: Shape = "point",
    band: Bands = None,
    confidence: Annotated[float, typer.Option(help="Of the intervals.")] = 0.9,
    gain_error: GainError = None,
    gain_per_view: GainPerView = 0.0,
    band_correlation: BandCorrelation = 0.0,
    sampled: Sampled = False,
    scene: Annotated[Path | None, typer.Option(metavar="SCENE.xml", help="Scene of T.npz, where it has moved.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find position [mm] and power [W] of light sources inside, with intervals.

    In several bands: T.npz and images of each, one after the other, and
    --band for each, in the same order.
    """
    from ..detector.reduction import read_measured
    from ..inverse.locate import locate
    from ..inverse.transport_matrix import read_transport
    from ..tissue.phantom_file import PhantomFile

    described = PhantomFile.read(phantom)
    if output:
        require_writable(output, ".vtu", InversionError)
        require_apart(output, [phantom, *described.files, matrix, *images], error=InversionError)
    groups = _groups([matrix, *images], band or [])
    with progress_bar(quiet) as progress:
        quiet_mitsuba()
        matrices = {name: read_transport(paths[0]) for name, paths in groups.items()}
        planes = {name: [read_measured(path) for path in paths[1:]] for name, paths in groups.items()}
        found = locate(
            described,
            matrices if band else next(iter(matrices.values())),
            planes if band else next(iter(planes.values())),
            sources=sources,
            confidence=confidence,
            gain_error=gain_error,
            gain_per_view=gain_per_view,
            band_correlation=band_correlation,
            shape=shape,
            sampled=sampled,
            scene=scene,
            progress=progress,
        )
    if output:
        found.write(output)
    record: dict[str, Any] = ({"output": str(output)} if output else {}) | found.summary()
    print_result(_text(found, output), record, as_json=as_json, quiet=quiet)


def _groups(paths: list[Path], bands: list[str]) -> dict[str, list[Path]]:
    """Files of each band, a transport matrix first; raises InversionError where their numbers differ."""
    from ..inverse.transport_file import is_transport

    starts = [k for k, path in enumerate(paths) if k == 0 or is_transport(path)]
    names = bands or [""]
    if len(starts) != len(names) or len(set(names)) != len(names):
        raise InversionError(
            f"locate: {len(starts)} transport matrices for the bands {', '.join(bands) or '(none)'}. Give each matrix "
            "before its images, and --band once for each, with different names."
        )
    ends = [*starts[1:], len(paths)]
    return {name: paths[start:end] for name, start, end in zip(names, starts, ends, strict=True)}


def _text(found: Location, output: Path | None) -> str:
    """A line for each source, and one about the fit."""
    lines = []
    for number, source in enumerate(found.sources, start=1):
        (low, high), (least, most) = source.position_interval, source.power_interval
        place = ", ".join(
            f"{name} {value:.5g} ({a:.5g} to {b:.5g})"
            for name, value, a, b in zip("xyz", source.position, low, high, strict=True)
        )
        lines.append(f"source {number}: {place} mm, {source.power:.5g} W ({least:.5g} to {most:.5g} W)")
        if source.radius is not None and source.radius_interval:
            inner, outer = source.radius_interval
            text = f"{source.radius:.3g} mm ({inner:.3g} to {outer:.3g} mm)" if inner else f"at most {outer:.3g} mm"
            lines[-1] += f", radius {text}"
    lines.append(f"{100 * found.confidence:g} % intervals; chi2 {found.chi2:.3g} over {found.pixels} pixels")
    if output:
        lines.append(f"{output}: source density and sources")
    return "\n".join(lines)
