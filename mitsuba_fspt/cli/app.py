"""The command line `fspt`: thin verbs over the Python API, one line and exit code 2 for whatever is wrong."""

from __future__ import annotations

import json
import os
import sys
from contextlib import nullcontext, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException

from ..rendering.scene_xml import read_xml
from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import FsptError, ImageError
from ..runtime.interrupt import ctrl_c_noted, terminated_as_by_ctrl_c
from .options import Domain, Method, Parameters, Rtol, SceneFile, Seed, Spp, definitions, require_writable
from .sweep import Interrupted
from .terminal import progress_bar

app = typer.Typer(
    name="fspt",
    help="Calibrated CCD images of glowing phantoms, in watts per pixel.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

INTERRUPTED = 130


@app.callback(invoke_without_command=True)
def fspt(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Calibrated CCD images of glowing phantoms, in watts per pixel."""
    if version:
        from importlib.metadata import version as of

        typer.echo(f"mitsuba-fspt {of('mitsuba-fspt')}")
        raise typer.Exit()


@app.command()
def render(
    scene: SceneFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Image to write, .exr.")] = None,
    method: Method = None,
    rtol: Rtol = None,
    domain: Domain = None,
    spp: Spp = None,
    seed: Seed = None,
    define: Parameters = None,
    png: Annotated[bool, typer.Option("--png", help="Also write a picture to look at, beside the image.")] = False,
    shortcuts: Annotated[bool, typer.Option(help="Leave out what the scene does not need, see 'fspt explain'.")] = True,
) -> None:
    """Render a scene to an EXR with the power [W], its error and the coverage of every pixel."""
    output = output or Path((scene.stem or "image") + ".exr")
    require_writable(output, ".exr")
    picture, parameters = output.with_suffix(".png"), definitions(define)
    if png:
        from ..images.picture import png_file, require_matplotlib

        require_writable(picture, ".png")
        require_matplotlib()
    for written in (output, picture) if png else (output,):
        require_apart(written, read_xml(scene, parameters).sources(), error=ImageError)
    with progress_bar() as progress:
        from ..rendering.render import render
        from ..rendering.scene import load

        quiet_mitsuba()
        image = render(
            load(scene, **parameters),
            method=method,
            rtol=rtol,
            domain=domain,
            shortcuts=shortcuts,
            spp=spp,
            seed=seed,
            progress=progress,
        )
    with png_file(image, picture) if png else nullcontext():  # both files or none
        image.write(output)
    power, peak = image.power.sum(), image.power.max()
    typer.echo(f"{output}: total {power:.6g} W, brightest pixel {peak:.6g} W, {image.metadata['wall_time']:.3g} s")
    if png:
        typer.echo(f"{picture}: the same to look at")
    if peak == 0:
        hint = "Check the lens's 'to_world', and that the faces' normals point outwards"
        typer.echo(f"fspt: {output}: the picture is dark, no light reaches the lens. {hint}.", err=True)


@app.command()
def compare(
    calculated: Annotated[Path, typer.Argument(metavar="CALCULATED.exr")],
    standard: Annotated[Path, typer.Argument(metavar="STANDARD.exr")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, profiles included.")] = False,
    png: Annotated[Path | None, typer.Option(help="Also draw both images and their difference.")] = None,
) -> None:
    """Compare two images: ME and CF as the paper defines them, largest and RMS error, a z-test."""
    from ..images.comparison import compare
    from ..images.image import read

    images = read(calculated), read(standard)
    result = compare(*images)
    if png:
        from ..images.picture import write_comparison_png

        write_comparison_png(*images, png)
    if as_json:
        typer.echo(json.dumps(result.to_dict()))
        return
    typer.echo(f"ME     {result.me:.3e}   mean error, each image over its own maximum")
    typer.echo(f"CF     {result.cf:.7f}   correlation factor")
    typer.echo(f"max    {result.max_error:.3e}   largest error over the standard's peak")
    typer.echo(f"RMS    {result.rms:.3e}   over the standard's peak")
    undefined = "none       the standard's powers add up to 0"
    typer.echo("ratio  " + (undefined if result.ratio is None else f"{result.ratio:.6f}   of the total powers"))
    if result.z_test:
        z = result.z_test
        typer.echo(
            f"chi2   {z.chi2:.3f}   per pixel; largest |z| {z.max_z:.2f} of {z.pixels} pixels, p {z.p_value:.2g}"
        )


@app.command()
def expose(
    image: Annotated[Path, typer.Argument(metavar="IMAGE.exr", help="Power image, as 'fspt render' writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Electrons to write, .exr.")],
    exposure_time: Annotated[float, typer.Option(help="Exposure time [s].")],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength [nm].")],
    binning: Annotated[int, typer.Option(help="Pixels per side binned before read-out.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    counts: Annotated[Path | None, typer.Option(help="Also write the counts [DN], 16-bit .png or .tif.")] = None,
) -> None:
    """Expose a typical cooled CCD (not a data sheet) to an image: electrons, and counts if asked."""
    from ..images.detector import Detector
    from ..images.image import read

    require_apart(output, [image], error=ImageError)
    exposure = Detector.typical_ccd().expose(
        read(image), exposure_time=exposure_time, wavelength_nm=wavelength_nm, binning=binning, seed=seed
    )
    with exposure.counts_file(counts) if counts else nullcontext():  # both files or none
        exposure.write(output)
    saturated = exposure.metadata["saturated_pixels"]
    typer.echo(f"{output}: brightest pixel {exposure.electrons.max():.6g} electrons, {saturated} pixels saturated")


@app.command()
def doctor() -> None:
    """Print versions, the chosen LLVM and why, devices, and a timed first kernel."""
    from ..runtime.doctor import diagnose

    diagnosis = diagnose()
    typer.echo(diagnosis.render_text())
    raise typer.Exit(0 if diagnosis.usable else 2)


@app.command()
def stability(
    everything: Annotated[bool, typer.Option("--all", help="Also the row of 3 million triangles.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON array of all rows.")] = False,
) -> None:
    """Try stiff and extreme cases against the truth: each must be right to its tolerance, or refused."""
    from ..validation.stability import check
    from ..validation.stiff_cases import cases

    quiet_mitsuba()
    rows = [case for case in cases() if everything or not case.slow]
    results = []
    for row in rows:
        results.append(check(row))
        if not as_json:
            typer.echo(results[-1].render_text())
    failed = sum(not result.ok for result in results)
    if as_json:
        typer.echo(json.dumps([result.to_dict() for result in results]))
    else:
        seconds = sum(result.seconds for result in results)
        typer.echo(f"{len(rows) - failed} of {len(rows)} hold, {seconds:.0f} s")
    raise typer.Exit(1 if failed else 0)


@app.command()
def explain(
    scene: SceneFile,
    define: Parameters = None,
    rtol: Rtol = None,
    domain: Domain = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON array of all rows.")] = False,
) -> None:
    """Tell what the integral leaves out of a scene, why, and what that saves: 'render --no-shortcuts' goes without."""
    with progress_bar():
        from ..rendering.scene import load
        from ..studies.explain import HEADER, explain

        quiet_mitsuba()
        rows = explain(load(scene, **definitions(define)), rtol=rtol, domain=domain)
    if as_json:
        typer.echo(json.dumps([row.to_dict() for row in rows]))
        return
    for line in (HEADER, *(row.render_text() for row in rows)):
        typer.echo(line)


def _add_flux() -> None:
    from .flux import app as flux

    app.add_typer(flux, name="flux")


def _add_sweep() -> None:
    from .sweep import sweep

    app.command()(sweep)


def _add_converge() -> None:
    from .converge import converge

    app.command()(converge)


_add_flux()
_add_sweep()
_add_converge()


def main() -> None:
    """Entry point: run the command line and exit with 0, 2 for bad input or 130 for Ctrl-C and SIGTERM."""
    terminated_as_by_ctrl_c()
    if isinstance(sys.stdout, TextIOWrapper):  # what a terminal or a pipe cannot show does not end the work
        sys.stdout.reconfigure(errors="backslashreplace")
    code = run(sys.argv[1:])
    if code == INTERRUPTED:  # at once: the renderer, stopped while it recorded, may not survive being taken down
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Exit code of `fspt` with these arguments; errors are one line on stderr and leave nothing behind."""
    try:
        with ctrl_c_noted():
            code = app(args=arguments, prog_name="fspt", standalone_mode=False)
        if code == INTERRUPTED:  # typer's own answer to Ctrl-C
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except Interrupted as error:
        return _fail(str(error), INTERRUPTED)
    except FsptError as error:
        return _fail(str(error))
    except TyperException as error:
        message = getattr(error, "format_message", error.__str__)() or "Missing command"
        return _fail(f"{message.rstrip('.')}. See 'fspt --help'.")
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written.", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except MemoryError as error:
        return _fail(f"out of memory: {error}. Give fewer pixels, or a smaller mesh.")
    except Exception as error:
        if os.environ.get("FSPT_DEBUG"):
            raise
        return _fail(f"{type(error).__name__}: {error} (FSPT_DEBUG=1 shows where)", 1)


def _fail(message: str, code: int = 2) -> int:
    with suppress(OSError):  # nobody listens
        typer.echo(f"fspt: {' '.join(message.split())}", err=True)
    return code
