"""`fspt scene new`: a commented scene file to start from."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from ..runtime.atomic_files import atomic_path
from ..runtime.errors import SceneError
from .options import AsJson, Quiet, definitions, require_writable, typed
from .terminal import print_result

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def scene() -> None:
    """Write scene files."""


@app.command()
def new(
    name: Annotated[
        str,
        typer.Argument(
            help="cylinder, mouse, rig or a scene of this package, such as nylon_cylinder.",
            autocompletion=lambda: _names(),
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene to write, .xml, which must not exist.")],
    phantom: Annotated[Path | None, typer.Option(metavar="PHANTOM.ply", help="Phantom with J_n, for mouse.")] = None,
    focal_length: Annotated[float | None, typer.Option(help="F [mm], 50 if left out.")] = None,
    f_number: Annotated[float | None, typer.Option(help="F/D, 1.8 if left out.")] = None,
    camera: Annotated[Path | None, typer.Option(metavar="CAMERA.toml", help="Camera with a table [lens].")] = None,
    define: Annotated[
        list[str] | None,
        typer.Option("-D", "--define", metavar="NAME=VALUE", help="Value of a parameter of scene_xml; repeatable."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a commented scene that renders as it is.

    cylinder glows evenly. mouse is PHANTOM.ply as 'fspt flux' writes it. The
    camera sees all of it from every side, as with 'fspt render PHANTOM.ply'.
    rig is the cylinder before two mirrors, three views in one picture. Other
    names are those of scenes of this package, written with their data beside
    them: l_shape, mirror_rig, nylon_cylinder, nylon_cylinder_tissue,
    textured_sphere, two_spheres and uniform_disk.
    """
    from ..phantom.framed_scene import camera_lens
    from ..phantom.shipped_scenes import copy_scene, shipped_scenes
    from ..phantom.starter_scenes import starter_scene

    require_writable(output, ".xml", SceneError)
    if os.path.exists(output):
        raise SceneError(f"output file '{output}' exists, and may hold work of yours. Give another name.")
    options: dict[str, Any] = {"focal_length": focal_length, "f_number": f_number}
    given = {key: value for key, value in options.items() if value is not None}
    settings = (camera_lens(camera) if camera else {}) | typed(definitions(define)) | given
    if name in shipped_scenes():
        if settings or phantom:
            raise SceneError(f"scene new: {name} is copied as it is. Leave options out; give them to 'fspt render'.")
        copy_scene(name, output)
    else:
        text = starter_scene(name, phantom, **settings)
        with atomic_path(output, SceneError) as temporary:
            temporary.write_text(text, encoding="utf-8")
    print_result(
        f"{output}: render it by 'fspt render {output}'", {"output": str(output)}, as_json=as_json, quiet=quiet
    )


def _names() -> list[str]:
    """Names for the completion by the shell."""
    from ..phantom.shipped_scenes import shipped_scenes

    return ["cylinder", "mouse", "rig", *shipped_scenes()]
