"""`fspt flux`: surface flux density from other codes and from SP3 or diffusion, as a phantom to render."""

from __future__ import annotations

import time
from contextlib import nullcontext
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ..runtime.atomic_files import atomic_path, require_apart
from ..runtime.errors import FluxError
from .options import AsJson, Quiet, require_writable
from .terminal import print_result

if TYPE_CHECKING:
    from ..phantom.phantom import Phantom
    from ..tissue.fluence_volume import Volume

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def flux() -> None:
    """Make the phantom that a scene shows: J_n from other codes, or solved for."""


class LengthUnit(str, Enum):
    mm = "mm"
    cm = "cm"
    m = "m"


class Per(str, Enum):
    vertex = "vertex"
    face = "face"


@app.command("import")
def import_(
    mesh: Annotated[
        Path,
        typer.Argument(metavar="MESH", help="Mesh: .ply .stl .obj .off .glb .npz .vtu .vtk .msh .xdmf ..."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The phantom to write, .ply.")],
    values: Annotated[Path | None, typer.Option(help="File of one value per vertex or face.")] = None,
    field: Annotated[str | None, typer.Option(help="Array, property or column that holds the values.")] = None,
    per: Annotated[Per | None, typer.Option(help="What the values stand on, where that is open.")] = None,
    format: Annotated[str, typer.Option(help="auto, mmc, nirfast, meshio, trimesh, ply, obj, off or npz.")] = "auto",
    length_unit: Annotated[
        LengthUnit | None,
        typer.Option(help="Of the mesh; the values are W per square of it. Left out: m of a .glb or .gltf, else mm."),
    ] = None,
    a: Annotated[
        str | None, typer.Option(help="The values are fluence, J_n = phi/(2A): robin, haskell or a number.")
    ] = None,
    n: Annotated[float | None, typer.Option(help="Refractive index for A; 1.37 where not given.")] = None,
    clip: Annotated[bool, typer.Option("--clip", help="Set negative values to 0 and say how much.")] = False,
    flip: Annotated[bool, typer.Option("--flip", help="Turn all faces over.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a phantom from a mesh and values on it, as other codes write them.

    Values are the surface flux density J_n in W per square of the mesh's
    length unit, or, with --a, the fluence phi in that unit, J_n = phi/(2A).

    MMC: MESH is node_ID.dat beside elem_ID.dat, --values SESSION_dref.dat,
    the energy that leaves each face. NIRFAST: MESH is NAME.node beside
    NAME.elem, --values the fluence at the nodes.
    """
    from ..phantom.flux_import import import_flux

    require_writable(output, ".ply", FluxError)
    # Other files that belong to a mesh (node, elem, param, ...) never end in .ply.
    require_apart(output, [mesh, values] if values else [mesh], error=FluxError)
    phantom = import_flux(
        mesh,
        values,
        field=field,
        per=per.value if per else None,
        format=format,
        length_unit=length_unit.value if length_unit else None,
        a=a,
        n=n,
        clip=clip,
        flip=flip,
    )
    phantom.write(output)
    report = phantom.report() | {"output": str(output)}
    print_result(report_text(report), report, as_json=as_json, quiet=quiet)
    if "warning" in phantom.provenance:
        typer.echo(f"fspt: {output}: {phantom.provenance['warning']}", err=True)


@app.command()
def solve(
    description: Annotated[Path, typer.Argument(metavar="PHANTOM.toml", help="Geometry, optics, light sources, mesh.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The phantom to write, .ply.")],
    volume: Annotated[
        Path | None, typer.Option(help="Also write the fluence inside on a grid, for gridvolume: .vol.")
    ] = None,
    band: Annotated[
        str | None, typer.Option(help="Name of [bands.NAME]: its coefficients, and its share of the power.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Solve SP3 or diffusion in a phantom and write its surface with J_n.

    The surface's power is what leaves by finite elements; absorbed and exit
    power together are the sources' to the balance printed.
    """
    from ..tissue.phantom_file import PhantomFile

    start = time.perf_counter()
    require_writable(output, ".ply", FluxError)
    if volume:
        require_writable(volume, ".vol", FluxError)
    tissue = PhantomFile.read(description)
    _require_apart(output, volume, [description, *tissue.files])
    with Console(stderr=True, quiet=quiet).status("mesh") as status:
        solution = tissue.solve(status.update, band)
        status.update("surface")
        phantom = solution.phantom(tissue.surface_edge)
        report = phantom.report() | solution.report()
        grid = None
        if volume:
            status.update("volume")
            grid = solution.volume(tissue.voxel)
            report |= {"volume": str(volume)} | grid.report()
    _write(phantom, output, grid, volume)
    report |= {"seconds": time.perf_counter() - start, "output": str(output)}
    print_result(report_text(report), report, as_json=as_json, quiet=quiet)


def _require_apart(output: Path, volume: Path | None, inputs: list[Path]) -> None:
    """Raise FluxError where an output file would overwrite an input file, or the volume the phantom."""
    require_apart(output, inputs, error=FluxError)
    if volume:
        require_apart(volume, [*inputs, output], "--volume", FluxError)


def _write(phantom: Phantom, output: Path, grid: Volume | None, volume: Path | None) -> None:
    """Write the phantom and, if given, the fluence on a grid to the file `volume`: both files or none."""
    with atomic_path(volume, FluxError) if volume else nullcontext() as temporary:
        if grid and temporary:
            grid.write(temporary)
        phantom.write(output)


def report_text(report: dict[str, object]) -> str:
    """The report as text, a line of name, value and unit for each entry."""
    units = {"area": "mm^2", "bounding_box": "mm", "removed_percent": "% of the power", "seconds": "s"}
    units |= dict.fromkeys(("power", "removed_power", "source_power", "absorbed_power", "exit_power"), "W")
    units |= {"min": str(report["unit"]), "max": str(report["unit"])}
    lines = []
    for name, value in report.items():
        if value is None:
            text = "all of it" if name == "removed_percent" else "undecided (open surface)"
        elif isinstance(value, bool):
            text = "yes" if value else "no"
        elif name == "bounding_box" and isinstance(value, list):
            text = " to ".join(" ".join(f"{x:.6g}" for x in corner) for corner in value)
        else:
            text = f"{value:.6g}" if isinstance(value, float) else str(value)
        lines.append(f"{name.replace('_', ' '):<16}{text} {units.get(name, '')}".rstrip())
    return "\n".join(lines)
