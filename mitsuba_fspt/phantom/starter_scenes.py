"""Scenes to start from: commented XML that renders as it is, by the name of what it shows."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from ..runtime.errors import SceneError
from .framed_scene import Outline, framed_text, scene_xml

RADIUS, HEIGHT = 15.0, 30.0  # mm, of the cylinder: the paper's phantom
EXITANCE = 1e-4  # W/mm²

CYLINDER = """    <!-- J_n is one number here. Where it varies over the surface, give in its place
             <texture type="bitmap" name="exitance"> <string name="filename" value="jn.exr"/>
                 <boolean name="raw" value="true"/> </texture>
         or solve the diffusion equation for it, 'fspt flux solve PHANTOM.toml -o phantom.ply', and render that mesh,
         'fspt render phantom.ply'. -->
    <shape type="cylinder" id="side">
        <point name="p0" x="0" y="0" z="{bottom:g}"/>
        <point name="p1" x="0" y="0" z="{top:g}"/>
        <float name="radius" value="{radius:g}"/>
        <transform name="to_world"> <rotate z="1" angle="$view"/> </transform>
        <emitter type="fspt_surface"> <float name="exitance" value="$exitance"/> </emitter>
    </shape>

    <!-- A disk faces +z: the lower one is turned over, for a surface glows on its outward side only. -->
    <shape type="disk" id="upper_end">
        <transform name="to_world">
            <scale value="{radius:g}"/>
            <rotate z="1" angle="$view"/>
            <translate z="{top:g}"/>
        </transform>
        <emitter type="fspt_surface"> <float name="exitance" value="$exitance"/> </emitter>
    </shape>

    <shape type="disk" id="lower_end">
        <transform name="to_world">
            <scale value="{radius:g}"/>
            <rotate x="1" angle="180"/>
            <rotate z="1" angle="$view"/>
            <translate z="{bottom:g}"/>
        </transform>
        <emitter type="fspt_surface"> <float name="exitance" value="$exitance"/> </emitter>
    </shape>"""


def starter_scene(name: str, phantom: str | os.PathLike[str] | None = None, **camera: Any) -> str:
    """Text of the starter scene of this name.

    name : cylinder (15 mm in radius, 30 mm high, of uniform J_n) or mouse (a phantom's PLY, framed)
    phantom : the PLY with J_n, for mouse
    camera : keywords of `scene_xml`

    Raises
    ------
    SceneError : there is no scene of this name, or a phantom is missing or has no place in it; and as `scene_xml`.
    """
    if name not in STARTERS:
        raise SceneError(f"scene new: the name must be one of {', '.join(STARTERS)}, got '{name}'. Give one of these.")
    return STARTERS[name](phantom, camera)


def _cylinder(phantom: str | os.PathLike[str] | None, camera: dict[str, Any]) -> str:
    if phantom is not None:
        raise SceneError(f"scene new: cylinder has no place for '{phantom}'. Leave --phantom out, or give mouse.")
    top = HEIGHT / 2
    size = np.array([2 * RADIUS, 2 * RADIUS, HEIGHT])
    outline = Outline(np.zeros(3), size, np.array([RADIUS]), np.array([top]))
    shapes = CYLINDER.format(radius=RADIUS, top=top, bottom=-top)
    title = f"A cylinder of {2 * RADIUS:g} mm diameter and {HEIGHT:g} mm height with the exitance {EXITANCE:g} W/mm^2"
    return framed_text(outline, title, shapes, parameters={"exitance": EXITANCE}, **camera)


def _mouse(phantom: str | os.PathLike[str] | None, camera: dict[str, Any]) -> str:
    if phantom is None:
        raise SceneError("scene new: mouse frames a phantom, whose PLY is missing. Give --phantom mouse.ply.")
    return scene_xml(phantom, **camera)


STARTERS: dict[str, Callable[[str | os.PathLike[str] | None, dict[str, Any]], str]] = {
    "cylinder": _cylinder,
    "mouse": _mouse,
}
