"""`fspt render`: the image of a scene, or images of a phantom from several sides."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import read_text, read_xml
from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.errors import ImageError, SceneError
from ..runtime.progress_bar import progress_bar
from .options import (
    AsJson,
    Domain,
    MaxDepth,
    Method,
    Parameters,
    Quiet,
    Rtol,
    Seed,
    Sensor,
    SourcePower,
    Spp,
    Unit,
    WavelengthNm,
    definitions,
    require_image,
    require_picture,
    several,
    typed,
)
from .terminal import Interrupted, print_result

if TYPE_CHECKING:
    from ..images.image import Image


class Shot(NamedTuple):
    """One image to render.

    scene : name of the scene file, or its text
    parameters : values for its `<default>` parameters
    output : the image to write
    origin : what the metadata call the scene, with its parameters; None leaves that to `load`
    """

    scene: Path | str
    parameters: dict[str, str]
    output: Path
    origin: str | None = None


class Output(NamedTuple):
    """How images are written.

    source_power : of the light source [W], None for images as they are
    unit, wavelength_nm : of the values, see `images.radiometry`
    png : a picture beside each image
    """

    source_power: float | None
    unit: str
    wavelength_nm: float | None
    png: bool

    def write(self, image: Image, output: Path, picture: Path | None) -> None:
        """Write the image and, if `picture` is given, its PNG: both files or none."""
        from ..images.picture import png_file
        from ..images.radiometry import in_unit

        with png_file(image, picture, self.unit, self.wavelength_nm) if picture else nullcontext():
            if self.unit == "W":
                image.write(output)
            else:
                in_unit(image, self.unit, self.wavelength_nm).write(output, image)


def render(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE.xml|PHANTOM.ply", help="Mitsuba scene with an fspt_lens, or a phantom.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Image to write: .exr, .tif, .h5, .npz or .fits.")
    ] = None,
    view: Annotated[
        str | None, typer.Option(metavar="0,90,...", help="Of a phantom: turns about +z [degrees], an image each.")
    ] = None,
    focal_length: Annotated[float | None, typer.Option(help="Before a phantom: F [mm], 50 if left out.")] = None,
    f_number: Annotated[float | None, typer.Option(help="Before a phantom: F/D, 1.8 if left out.")] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="CAMERA.toml", help="Before a phantom: camera with a table [lens].")
    ] = None,
    method: Method = None,
    rtol: Rtol = None,
    domain: Domain = None,
    spp: Spp = None,
    max_depth: MaxDepth = None,
    seed: Seed = None,
    sensor: Sensor = 0,
    source_power: SourcePower = None,
    unit: Unit = "W",
    wavelength_nm: WavelengthNm = None,
    define: Parameters = None,
    png: Annotated[bool, typer.Option("--png", help="Also write the image as a PNG picture.")] = False,
    shortcuts: Annotated[bool, typer.Option(help="Leave out what the scene does not need, see 'fspt explain'.")] = True,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render a scene to an image with the power [W], its error and the coverage of every pixel.

    Of PHANTOM.ply, as 'fspt flux' writes it, the camera stands on the +x
    axis, is focused on the front and sees the whole phantom, up is +z. The
    images are OUT_view0.exr, OUT_view90.exr, one for each view; -D sets
    the parameters of scene_xml.
    """
    framing = {"view": view, "focal_length": focal_length, "f_number": f_number, "camera": camera}
    shots = _shots(scene, output, definitions(define), {name: v for name, v in framing.items() if v is not None})
    _check_outputs(shots, [scene, camera] if camera else [scene], png)
    require_scaling(source_power, unit, wavelength_nm)
    settings = {"method": method, "rtol": rtol, "domain": domain, "shortcuts": shortcuts, "spp": spp, "seed": seed}
    images = _rendered(
        shots,
        settings | {"max_depth": max_depth, "sensor": sensor},
        Output(source_power, unit, wavelength_nm, png),
        quiet,
    )
    summaries = [
        _summary(image, shot.output, _picture(shot, png), unit, wavelength_nm)
        for shot, image in zip(shots, images, strict=True)
    ]
    text = "\n".join(map(_summary_text, summaries))
    print_result(text, {"images": summaries}, as_json=as_json, quiet=quiet)
    for summary in summaries:
        if "warnings" in summary:
            typer.echo(f"fspt: {summary['output']}: {summary['warnings']}.", err=True)


def _rendered(shots: list[Shot], settings: dict[str, Any], output: Output, quiet: bool) -> list[Image]:
    """Images of all shots, each written as soon as it is there; `settings` as of `rendering.render`."""
    images: list[Image] = []
    with _kept(shots, images), progress_bar(quiet) as progress:
        from ..rendering.render import render
        from ..rendering.scene import load

        quiet_mitsuba()
        for shot in shots:
            image = render(load(shot.scene, **shot.parameters), progress=progress, **settings)
            image = image if output.source_power is None else image.scaled(output.source_power)
            if shot.origin:
                image = replace(image, metadata=image.metadata | {"scene": shot.origin})
            output.write(image, shot.output, _picture(shot, output.png))
            images.append(image)
    return images


def require_scaling(source_power: float | None, unit: str, wavelength_nm: float | None) -> None:
    """Raise ImageError, before the work, for a source power or a unit that no image can have."""
    from ..images.image import required_source_power
    from ..images.radiometry import require_unit

    if source_power is not None:
        required_source_power(source_power)
    require_unit(unit, wavelength_nm)


def _shots(scene: Path, output: Path | None, parameters: dict[str, str], framing: dict[str, Any]) -> list[Shot]:
    """What to render: the scene, or every view of a phantom; SceneError for an option that does not go with it."""
    output = output or Path((scene.stem or "image") + ".exr")
    if scene.suffix.lower() == ".ply":
        return _views(scene, output, parameters, framing)
    if framing:
        option = "--" + next(iter(framing)).replace("_", "-")
        raise SceneError(
            f"{option} goes with PHANTOM.ply, '{scene}' is a scene with parameters of its own. Give -D NAME=VALUE."
        )
    return [Shot(scene, parameters, output)]


def _views(phantom: Path, output: Path, parameters: dict[str, str], framing: dict[str, Any]) -> list[Shot]:
    """A phantom's views, in the order given; -D and options overrule the camera's file."""
    from ..phantom.framed_scene import camera_lens, scene_xml

    if twice := set(parameters) & set(framing):
        name = min(twice)
        raise SceneError(f"-D {name}={parameters[name]}: --{name.replace('_', '-')} gives it already. Give it once.")
    numbers = typed({name: text for name, text in parameters.items() if name != "view"})
    lens = camera_lens(framing.pop("camera")) if "camera" in framing else {}
    views = several("view", framing.pop("view", parameters.get("view", "0")))
    if wrong := [view for view in views if not is_number(view) or views.count(view) > 1]:
        raise SceneError(f"--view: must be different numbers of degrees, got '{wrong[0]}'. Give for example 0,90,180.")
    text = scene_xml(phantom, **lens | numbers | framing)
    shots = []
    for view in views:
        values = read_text(text, {}).defaults | {"view": view}
        origin = " ".join([str(phantom), *(f"{name}={value}" for name, value in values.items())])
        image = output.with_name(f"{output.stem}_view{view}{output.suffix or '.exr'}")
        shots.append(Shot(text, {"view": view}, image, origin))
    return shots


def _picture(shot: Shot, png: bool) -> Path | None:
    """The PNG beside an image, if one is wanted."""
    return shot.output.with_suffix(".png") if png else None


def _check_outputs(shots: list[Shot], inputs: list[Path], png: bool) -> None:
    """Raise ImageError for an image or picture that cannot be written, or that would overwrite what is read."""
    for shot in shots:
        require_image(shot.output)
        picture = _picture(shot, png)
        if picture:
            require_picture(picture)
        read = read_xml(shot.scene, shot.parameters).sources() if isinstance(shot.scene, Path) else inputs
        for written in (shot.output, picture) if picture else (shot.output,):
            require_apart(written, read, error=ImageError)


@contextmanager
def _kept(shots: list[Shot], images: list[Image]) -> Iterator[None]:
    """Ctrl-C in the block after the first of several images raises `Interrupted`, which says what is written."""
    try:
        yield
    except KeyboardInterrupt as cause:
        if not images:
            raise
        names = ", ".join(str(shot.output) for shot in shots[: len(images)])
        raise Interrupted(f"interrupted; {len(images)} of {len(shots)} images are written: {names}.") from cause


def _summary(
    image: Image, output: Path, picture: Path | None, unit: str, wavelength_nm: float | None
) -> dict[str, Any]:
    """The files, the total power [W], the brightest pixel [unit], the time [s], and what the metadata warn of."""
    from ..images.radiometry import in_unit

    shown = in_unit(image, unit, wavelength_nm)
    summary: dict[str, Any] = {"output": str(output), "total_power": image.total_power, "power_unit": "W"}
    summary |= {"peak": float(shown.values.max()), "unit": shown.unit, "wall_time": image.metadata["wall_time"]}
    if picture:
        summary["picture"] = str(picture)
    return summary | {key: image.metadata[key] for key in ("warnings",) if key in image.metadata}


def _summary_text(summary: dict[str, Any]) -> str:
    """A line for each file of an image."""
    numbers = f"total {summary['total_power']:.6g} W, brightest pixel {summary['peak']:.6g} {summary['unit']}"
    line = f"{summary['output']}: {numbers}, {summary['wall_time']:.3g} s"
    return f"{line}\n{summary['picture']}: the same as a picture" if "picture" in summary else line
