"""`fspt render`: the image of a scene, or images of a phantom from several sides."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ..rendering.scene_source import SceneSource
from ..runtime.atomic_files import require_apart
from ..runtime.backend import quiet_mitsuba
from ..runtime.deadline import LEAST_TIME, Deadline, required_time
from ..runtime.errors import ImageError, SceneError
from ..runtime.progress_bar import progress_bar
from .given_scene import Camera, FNumber, FocalLength, GivenScene, SceneOrPhantom, Views, framing_of, scenes_of
from .options import (
    AsJson,
    Domain,
    MaxDepth,
    MaxTime,
    Method,
    Parameters,
    Quiet,
    Rtol,
    Seed,
    Sensor,
    SourcePower,
    SpectrumFile,
    Spp,
    Unit,
    WavelengthNm,
    definitions,
    require_image,
    require_picture,
)
from .terminal import Interrupted, print_result, print_warnings

if TYPE_CHECKING:
    from ..images.image import Image
    from ..optics.light import Light


class Shot(NamedTuple):
    """One image to render.

    given : the scene
    source : what is read of it
    output : the image to write
    """

    given: GivenScene
    source: SceneSource
    output: Path


class Output(NamedTuple):
    """How images are written.

    source_power : of the light source [W], None for images as they are
    unit, light : of the values, see `images.radiometry`
    png : a picture beside each image
    """

    source_power: float | None
    unit: str
    light: Light | None
    png: bool

    def write(self, image: Image, output: Path, picture: Path | None) -> None:
        """Write the image and, if `picture` is given, its PNG: both files or none."""
        from ..images.picture import png_file
        from ..images.radiometry import in_unit

        with png_file(image, picture, self.unit, self.light) if picture else nullcontext():
            if self.unit == "W":
                image.write(output)
            else:
                in_unit(image, self.unit, self.light).write(output, image)


def render(
    scene: SceneOrPhantom,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Image to write: .exr, .tif, .h5, .npz or .fits.")
    ] = None,
    view: Views = None,
    focal_length: FocalLength = None,
    f_number: FNumber = None,
    camera: Camera = None,
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
    spectrum: SpectrumFile = None,
    define: Parameters = None,
    png: Annotated[bool, typer.Option("--png", help="Also write the image as a PNG picture.")] = False,
    shortcuts: Annotated[bool, typer.Option(help="Leave out what the scene does not need, see 'fspt explain'.")] = True,
    max_time: MaxTime = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render a scene to an image with the power [W], its error and the coverage of every pixel.

    Of PHANTOM.ply, as 'fspt flux' writes it, the camera stands on the +x
    axis, is focused on the front and sees the whole phantom, up is +z. The
    images of several views are OUT_view0.exr, OUT_view90.exr; -D sets the
    parameters of scene_xml.
    """
    framing = framing_of(view, focal_length, f_number, camera)
    shots = _shots(scene, output, scenes_of(scene, definitions(define), framing), png)
    _check_outputs(shots, [scene, camera] if camera else [scene], png)
    light = required_scaling(source_power, unit, wavelength_nm, spectrum)
    settings = {"method": method, "rtol": rtol, "domain": domain, "shortcuts": shortcuts, "spp": spp, "seed": seed}
    images = _rendered(
        shots,
        settings | {"max_depth": max_depth, "sensor": sensor},
        Output(source_power, unit, light, png),
        required_time("render", max_time, SceneError),
        quiet,
    )
    summaries = [
        _summary(image, shot.output, _picture(shot, png), unit, light)
        for shot, image in zip(shots, images, strict=True)
    ]
    text = "\n".join(map(_summary_text, summaries))
    print_result(text, {"images": summaries}, as_json=as_json, quiet=quiet)
    for summary in summaries:
        if "warnings" in summary:
            print_warnings(summary["output"], [summary["warnings"]])


def _rendered(
    shots: list[Shot], settings: dict[str, Any], output: Output, max_time: float | None, quiet: bool
) -> list[Image]:
    """Images of all shots, each written as soon as it is there; `settings` as of `rendering.render`.

    max_time : of all of them [s]; each gets an equal part of what is left
    """
    images: list[Image] = []
    deadline = Deadline(max_time)
    with _kept(shots, images), progress_bar(quiet) as progress:
        from ..camera.of_sensor import camera_of
        from ..optics.light import Light
        from ..rendering.render import render, sensor_of
        from ..rendering.scene import load_source
        from ..runtime.plugin_types import is_lens

        quiet_mitsuba()
        for number, shot in enumerate(shots):
            scene = load_source(shot.source)
            lens: Any = sensor_of(scene, settings["sensor"])
            if output.unit != "W" and is_lens(lens):  # before the work
                Light.of_image(camera_of(lens).numbers(), output.light)
            if deadline.is_set:
                settings["max_time"] = max(deadline.left / (len(shots) - number), LEAST_TIME)
            image = render(scene, progress=progress, **settings)
            image = image if output.source_power is None else image.scaled(output.source_power)
            if shot.given.origin:
                image = replace(image, metadata=image.metadata | {"scene": shot.given.origin})
            if shot.given.warning:
                warnings = filter(None, [image.metadata.get("warnings"), shot.given.warning])
                image = replace(image, metadata=image.metadata | {"warnings": "; ".join(map(str, warnings))})
            output.write(image, shot.output, _picture(shot, output.png))
            images.append(image)
    return images


def required_scaling(
    source_power: float | None, unit: str, wavelength_nm: float | None, spectrum: Path | None
) -> Light | None:
    """The light that is given; ImageError, before the work, for a source power or a unit that no image can have."""
    from ..images.image import required_source_power
    from ..images.radiometry import require_unit
    from ..optics.light import Light

    if source_power is not None:
        required_source_power(source_power)
    light = Light.given(wavelength_nm, spectrum)
    require_unit(unit, light)
    return light


def _shots(scene: Path, output: Path | None, scenes: list[GivenScene], png: bool) -> list[Shot]:
    """The scenes with the images to write: the name that was given, of several views with the view in the name.

    Raises ImageError for an image or picture that cannot be written, before the scene is read.
    """
    output = output or Path((scene.stem or "image") + ".exr")
    suffix = output.suffix or ".exr"
    outputs = [output]
    if len(scenes) > 1:
        outputs = [output.with_name(f"{output.stem}_view{one.view}{suffix}") for one in scenes]
    for written in outputs:
        require_image(written)
        if png:
            require_picture(written.with_suffix(".png"))
    sources = [SceneSource.of(one.scene, one.parameters) for one in scenes]
    return [Shot(*shot) for shot in zip(scenes, sources, outputs, strict=True)]


def _picture(shot: Shot, png: bool) -> Path | None:
    """The PNG beside an image, if one is wanted."""
    return shot.output.with_suffix(".png") if png else None


def _check_outputs(shots: list[Shot], inputs: list[Path], png: bool) -> None:
    """Raise ImageError for an image or picture that would overwrite what is read."""
    for shot in shots:
        picture = _picture(shot, png)
        read = shot.source.files() if isinstance(shot.given.scene, Path) else inputs
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


def _summary(image: Image, output: Path, picture: Path | None, unit: str, light: Light | None) -> dict[str, Any]:
    """The files, the total power [W], the brightest pixel [unit], the time [s], and what the metadata warn of."""
    from ..images.radiometry import in_unit

    shown = in_unit(image, unit, light)
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
