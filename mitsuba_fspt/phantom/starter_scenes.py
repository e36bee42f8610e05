"""Commented scene files to start from, by name; each renders without changes."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from ..optics.focused_lens import FOCUS
from ..runtime.errors import SceneError
from .framed_scene import Outline, framed_text, scene_xml
from .shipped_scenes import shipped_scenes

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


# Two mirrors behind the cylinder, and a camera that sees all three views: those of scenes/mirror_rig.xml.
MIRROR = """

    <shape type="rectangle" id="mirror_{side}">
        <transform name="to_world">
            <scale x="20" y="22"/>
            <lookat origin="-30, {sign}51.9615, 0" target="-13.4628, {sign}40.7134, 0" up="0, 0, 1"/>
        </transform>
        <bsdf type="conductor">
            <string name="material" value="none"/>
            <float name="specular_reflectance" value="$reflectance"/>
        </bsdf>
    </shape>"""
RIG = """\
Mirrors   flat, 40 x 44 mm, their centres 60 mm from the axis at azimuths of 120 and 240 degrees. Each is turned so
          that the camera sees the middle of the phantom in the mirror's centre. The direct view is in the middle of
          the picture, the two mirror images, left and right exchanged, are on either side. reflectance: of the mirrors.
Camera    the virtual detector plane lies between the front of the phantom and its mirror images, which are farther
          away; a small stop keeps all of them sharp."""
RIG_CAMERA = {"focal_length": 55.0, "f_number": 8.0, "distance": 320.0, "focus_distance": 340.0}
RIG_FILM = {"width": 384, "height": 128, "pixel_pitch": 0.0675}
REFLECTANCE = 0.95


def starter_scene(name: str, phantom: str | os.PathLike[str] | None = None, **camera: Any) -> str:
    """Text of the starter scene of this name.

    name : cylinder (radius 15 mm, height 30 mm, uniform J_n), mouse (a PLY with J_n, seen by a camera that it fills) or
        rig (the cylinder in front of two mirrors)
    phantom : the PLY with J_n, for mouse
    camera : keywords of `scene_xml`

    Raises
    ------
    SceneError : there is no scene of this name, `phantom` is missing or not used by it; further as `scene_xml`.
    """
    if name not in STARTERS:
        names = ", ".join([*STARTERS, *shipped_scenes()])
        raise SceneError(f"scene new: the name must be one of {names}, got '{name}'. Give one of these.")
    return STARTERS[name](phantom, camera)


def _cylinder(phantom: str | os.PathLike[str] | None, camera: dict[str, Any]) -> str:
    _require_none("cylinder", phantom)
    return _of_cylinder("", {"exitance": EXITANCE}, camera)


def _rig(phantom: str | os.PathLike[str] | None, camera: dict[str, Any]) -> str:
    _require_none("rig", phantom)
    own = {name: value for name, value in RIG_CAMERA.items() if name not in FOCUS or not set(FOCUS) & set(camera)}
    mirrors = "".join(MIRROR.format(side=side, sign=sign) for side, sign in (("right", ""), ("left", "-")))
    parameters = {"exitance": EXITANCE, "reflectance": REFLECTANCE}
    return _of_cylinder(mirrors, parameters, {**own, **RIG_FILM, "notes": RIG, **camera})


def _require_none(name: str, phantom: object) -> None:
    """Raise SceneError if a phantom is given for a scene that does not use one."""
    if phantom is not None:
        raise SceneError(f"scene new: {name} has no place for '{phantom}'. Leave --phantom out, or give mouse.")


def _of_cylinder(others: str, parameters: dict[str, float], settings: dict[str, Any]) -> str:
    """Text of a scene of the cylinder and other shapes, with these `<default>`s and settings of `framed_text`."""
    top = HEIGHT / 2
    size = np.array([2 * RADIUS, 2 * RADIUS, HEIGHT])
    outline = Outline(np.zeros(3), size, np.array([RADIUS]), np.array([top]))
    shapes = CYLINDER.format(radius=RADIUS, top=top, bottom=-top) + others
    title = f"A cylinder of {2 * RADIUS:g} mm diameter and {HEIGHT:g} mm height with the exitance {EXITANCE:g} W/mm^2"
    return framed_text(outline, title, shapes, parameters=parameters, **settings)


def _mouse(phantom: str | os.PathLike[str] | None, camera: dict[str, Any]) -> str:
    if phantom is None:
        raise SceneError("scene new: mouse frames a phantom, whose PLY is missing. Give --phantom mouse.ply.")
    return scene_xml(phantom, **camera)


STARTERS: dict[str, Callable[[str | os.PathLike[str] | None, dict[str, Any]], str]] = {
    "cylinder": _cylinder,
    "mouse": _mouse,
    "rig": _rig,
}
