"""Scene file of a phantom, with the camera placed such that the phantom fills the film in every view."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ..optics.distortion import distorted
from ..optics.focused_lens import FOCUS
from ..optics.thin_lens import Lens, number_names
from ..optics.transmittance import CURVE, SPECTRUM
from ..optics.transmittance import NUMBERS as LIGHT
from ..optics.vignetting import VIGNETTING
from ..runtime.errors import OpticsError, SceneError
from ..runtime.numbers import number, whole
from ..runtime.toml_file import read_toml
from .phantom import Phantom

FILLED = 0.9  # share of the film's side that the phantom covers in its widest view, blur included
LEAST, MOST = 1e-6, 1e6  # limits of the search for the magnification that fills the film
DIGITS = 3  # of the resulting magnification

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<!--
{comment}
-->
<scene version="3.0.0">
{defaults}

    <!-- Without it Embree loses rays that meet the edges of the mesh. -->
    <boolean name="embree_use_robust_intersections" value="true"/>

    <integrator type="fspt_integral">
        <float name="rtol" value="$rtol"/>
    </integrator>

    <sensor type="fspt_lens" id="camera">
        <float name="focal_length" value="$focal_length"/>
        <float name="f_number" value="$f_number"/>
        <float name="magnification" value="$magnification"/>
        <float name="pixel_pitch" value="$pixel_pitch"/>
{borders}        <transform name="to_world">
            <lookat origin="$distance, 0, 0" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <string name="component_format" value="float32"/>
            <string name="pixel_format" value="luminance"/>
            <rfilter type="box"/>
        </film>
    </sensor>

{shapes}
</scene>
"""

COMMENT = """{title} through a {focal_length:g} mm lens at f/{f_number:g}.

Units     mm; exitance in W/mm^2, so a pixel holds W.
World     z up, origin in the centre of the phantom's bounding box, which is {size} mm large; the camera
          stands on the +x axis, +y is to the right of the picture.
view      turns the phantom about the z axis by so many degrees, counterclockwise seen from above.
{notes}"""
FOCUSED = """\
Camera    magnification puts the virtual detector plane on the front of the phantom, which stands with its axis at
          distance from the lens. With another magnification t give distance = focal_length (1 + 1/t) + {radius:.6g}."""

PLY = """    <shape type="ply" id="phantom">
        <string name="filename" value={filename}/>
        <!-- The outward side is that of the flat face, at the rim too. -->
        <boolean name="face_normals" value="true"/>
        <transform name="to_world">
            <translate x="{shift[0]!r}" y="{shift[1]!r}" z="{shift[2]!r}"/>
            <rotate z="1" angle="$view"/>
        </transform>
        <emitter type="fspt_surface">
            <texture type="mesh_attribute" name="exitance">
                <string name="name" value="{attribute}"/>
            </texture>
        </emitter>
    </shape>"""
ORDER = ("f_number", "view", "rtol", "focal_length", "magnification", "distance", "width", "height", "pixel_pitch")


def scene_xml(
    phantom: str | os.PathLike[str],
    *,
    focal_length: float = 50.0,
    f_number: float = 1.8,
    magnification: float | None = None,
    distance: float | None = None,
    pixel_pitch: float = 0.108,
    width: int = 256,
    height: int = 256,
    rtol: float = 1e-3,
    view: float = 0.0,
    **lens: float | str,
) -> str:
    """XML text of a scene that shows a phantom, for `load` or to be saved; the arguments become its `<default>` values.

        scene = fspt.load(fspt.scene_xml("phantom.ply", focal_length=50, f_number=1.8), view=90)

    The lens is on the +x axis and looks at the centre of the phantom's bounding box, which is moved to the origin; up
    is +z. It is focused on the front: on the vertical plane that touches the phantom in the view in which it is
    nearest. Of a flat phantom the front may lie behind that plane in the view given; a comment in the text then says
    by how much, and which magnification at the same distance focuses on it. Magnification and distance are such that in
    every view the whole phantom, its blur included, lies within 0.9 of the film's width and height, and reaches this
    limit along one of them in the widest view.

    Parameters
    ----------
    phantom : PLY file with J_n as property `exitance_x` of its vertices or of its faces, as `fspt flux` writes it, or
        as its only property with a name like `jn_x`; see `Phantom.read`
    focal_length : F [mm]
    f_number : f_num = F/D
    magnification : t = v/u; None: the one that fills the film, or the one that follows from `distance`
    distance : from the lens to the axis about which the phantom turns [mm]; None: the one at which the front is in
        focus with this magnification
    pixel_pitch : side of a pixel [mm]
    width, height : of the film [pixels]
    rtol : error of the integral relative to the brightest pixel
    view : turns the phantom counterclockwise about +z [degrees]
    lens : further parameters of `fspt_lens` by name, such as lens_diameter [mm] or transmittance; also focus_distance
        or image_distance [mm] in place of the magnification

    Raises
    ------
    FluxError, ExitanceError : the file cannot be read, or has no exitance.
    OpticsError : a lens that cannot exist.
    SceneError : another value that cannot be used, or a camera that stands in the phantom.
    """
    settings = {"focal_length": focal_length, "f_number": f_number, "magnification": magnification} | lens
    settings |= {"distance": distance, "pixel_pitch": pixel_pitch, "width": width, "height": height}
    return text_and_outline(phantom, rtol=rtol, view=view, **settings)[0]


def text_and_outline(phantom: str | os.PathLike[str], **settings: Any) -> tuple[str, Outline]:
    """Text of `scene_xml`, whose keywords these are, and the outline of the phantom."""
    if not isinstance(phantom, (str, os.PathLike)):
        raise SceneError(
            f"scene: the phantom must be the name of a PLY file, got {type(phantom).__name__}. A scene names the file: "
            "write it, as by phantom.write('phantom.ply')."
        )
    path = Path(phantom)
    if "$" in str(path.absolute()):
        raise SceneError(f"scene: '{path}' has a $ in its path, which marks a parameter in a scene file. Rename it.")
    mesh = Phantom.read(path)
    shape = PLY.format(
        filename=quoteattr(str(path.absolute())),
        shift=tuple(-float(c) + 0.0 for c in (mesh.bounds[0] + mesh.bounds[1]) / 2),
        attribute=f"{mesh.per}_{mesh.attribute}",
    )
    title = f"The phantom {path.name.replace('--', '- -')}"
    outline = Outline.of(mesh)
    return framed_text(outline, title, shape, **settings), outline


def framed_text(
    outline: Outline,
    title: str,
    shapes: str,
    *,
    focal_length: float = 50.0,
    f_number: float = 1.8,
    magnification: float | None = None,
    distance: float | None = None,
    pixel_pitch: float = 0.108,
    width: int = 256,
    height: int = 256,
    rtol: float = 1e-3,
    view: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    notes: str = FOCUSED,
    **lens: float | str,
) -> str:
    """Text of a scene that shows shapes with this `outline`, about the origin; other arguments as of `scene_xml`.

    title : what is shown, the beginning of the comment
    shapes : their XML, which may use $view and the `parameters`, further `<default>`s
    notes : end of the comment, on the camera and whatever else the scene has
    """
    numbers = _numbers(focal_length=focal_length, f_number=f_number, pixel_pitch=pixel_pitch, rtol=rtol, view=view)
    film = {"width": _pixels("width", width), "height": _pixels("height", height)}
    known = ("model", "distortion", VIGNETTING, *number_names(), *LIGHT, CURVE, SPECTRUM)
    if unknown := [name for name in lens if name not in known]:
        raise SceneError(f"scene: 'fspt_lens' has no parameter {unknown[0]}. Leave it out, or give {', '.join(known)}.")
    lens |= _files(lens, Path.cwd())  # the text may be saved anywhere
    frame = Frame(outline, focal_length, f_number, numbers["pixel_pitch"], film, lens)
    found = dict(zip(("magnification", "distance"), frame.placed(magnification, distance), strict=True))
    values = numbers | found | film | dict(parameters or {})
    magnified = float(lens.get("pupil_magnification", 1.0))
    if notes == FOCUSED and (behind := front_behind_focus(outline, values, numbers["view"], magnified)):
        notes += f"\n          {behind}."
    size = " x ".join(f"{side:.4g}" for side in outline.size)
    camera = {"focal_length": values["focal_length"], "f_number": values["f_number"]}
    names = (*ORDER, *(parameters or ()))
    return SCENE.format(
        comment=COMMENT.format(title=title, size=size, notes=notes.format(radius=outline.radius), **camera),
        defaults="\n".join(f'    <default name="{name}" value="{values[name]:.10g}"/>' for name in names),
        borders="".join(_property(name, value) for name, value in lens.items() if name not in FOCUS),
        shapes=shapes,
    )


def front_behind_focus(
    outline: Outline, values: Mapping[str, float], view: float, pupil_magnification: float = 1.0
) -> str | None:
    """That the front is out of focus in a view [degrees], by how much, and the remedy; None where its blur is small.

    values : of the text's `<default>` parameters; a blur radius of one pixel counts as small
    """
    focal_length, distance = values["focal_length"], values["distance"]
    u, z = focal_length * (1 + 1 / values["magnification"]), distance - outline.front(view)
    if not z > u:
        return None
    depth = focal_length * (1 - 1 / pupil_magnification)  # of the entrance pupil (Eq. M.39)
    blur = values["magnification"] * focal_length / values["f_number"] / 2 * (z - u) / (z - depth)
    blur /= values["pixel_pitch"]
    if blur <= 1:
        return None
    sharp = focal_length / (z - focal_length)
    return (
        f"In view {view:g} the front lies {z - u:.3g} mm behind the virtual detector plane, blurred over a radius of "
        f"{blur:.2g} pixels; magnification = {sharp:.4g} with distance = {distance:.6g} focuses on it"
    )


def camera_lens(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Keywords of `scene_xml` from the table [lens] of a camera's TOML file; other tables are not read.

    A key `name` is for people and left out. Files of `transmittance_curve`, `spectrum` and `vignetting` are beside the
    TOML.

    Raises
    ------
    SceneError : the file cannot be read, has no table [lens], or a value there is neither number nor text.
    """
    content = read_toml(path, SceneError)
    if not isinstance(content.get("lens"), dict):
        raise SceneError(f"'{path}' has no table [lens]. Give it one, with focal_length [mm] and f_number.")
    lens = {name: value for name, value in content["lens"].items() if name != "name"}
    for name, value in lens.items():
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise SceneError(f"'{path}' [lens]: '{name}' must be a number or a text, got {value!r}. Correct it.")
    return lens | _files(lens, Path(path).parent)


def _files(lens: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Paths of the files that the numbers of a lens name, relative to a folder."""
    return {name: str(folder / lens[name]) for name in (CURVE, SPECTRUM, VIGNETTING) if isinstance(lens.get(name), str)}


@dataclass(frozen=True, eq=False)
class Outline:
    """Extent of a phantom that turns about the vertical axis of its bounding box.

    centre, size : of the bounding box (3,) [mm]
    radii, heights : of each vertex, its distance from that axis and from the middle plane (V,) [mm]
    across : of each vertex, x and y from that axis (V, 2) [mm]; None for a body of revolution about it
    """

    centre: NDArray[np.float64]
    size: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    across: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, phantom: Phantom) -> Outline:
        """Outline of a phantom."""
        low, high = phantom.bounds
        points = phantom.vertices[np.unique(phantom.faces)] - (low + high) / 2
        across, heights = points[:, :2], np.abs(points[:, 2])
        return cls((low + high) / 2, high - low, np.hypot(*across.T), heights, across)

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the axis [mm]."""
        return float(self.radii.max())

    def front(self, view: float) -> float:
        """Distance of the front from the axis [mm], in the view that is turned counterclockwise by so many degrees."""
        if self.across is None:
            return self.radius
        angle = math.radians(view)
        return float((self.across @ (math.cos(angle), -math.sin(angle))).max())


@dataclass(frozen=True)
class Frame:
    """Camera before a phantom: the lens without its focus, and the film.

    focal_length : F [mm]; f_number; pixel_pitch [mm]; film : width and height [pixels]
    lens : further parameters of `fspt_lens`
    """

    outline: Outline
    focal_length: float
    f_number: float
    pixel_pitch: float
    film: dict[str, int]
    lens: dict[str, float | str]

    def placed(self, magnification: float | None, distance: float | None) -> tuple[float, float]:
        """Magnification and distance [mm] of the axis from the lens; see `scene_xml`."""
        radius = self.outline.radius
        magnification = self._focus(magnification)
        if distance is not None:
            distance = number("scene: 'distance'", distance, SceneError, "180")
            nearest = radius if magnification else radius + self.focal_length
            if not nearest < distance < math.inf:
                raise SceneError(
                    f"scene: 'distance' must be > {nearest:.6g} mm and finite, got {distance:g}: the phantom reaches "
                    f"{radius:.6g} mm from its axis. Give a larger one, or leave it out."
                )
            return magnification or self.focal_length / (distance - radius - self.focal_length), distance
        magnification = magnification or self._filling()
        return magnification, self.focal_length * (1 + 1 / magnification) + radius

    def _focus(self, magnification: float | None) -> float | None:
        """The given magnification, or that of a given focus_distance or image_distance; None if none is given.

        Raises OpticsError for a lens that cannot exist.
        """
        known = number_names()
        numbers = {name: value for name, value in self.lens.items() if name in known}
        if magnification is not None:
            numbers["magnification"] = magnification
        focused = any(name in numbers for name in FOCUS)
        model = str(self.lens.get("model", "diaphragm"))
        start = {} if focused else {"magnification": 1.0}
        found = Lens.focused(self.focal_length, self.f_number, model=model, **numbers, **start)  # type: ignore[arg-type]
        return found.magnification if focused else None

    def _filling(self) -> float:
        """Magnification at which the phantom fills the film, rounded down."""
        low, high = LEAST, MOST
        if not self._filled(low) < FILLED < self._filled(high):
            raise OpticsError(
                f"scene: no magnification from {LEAST:g} to {MOST:g} fills the film of {self.film['width']} x "
                f"{self.film['height']} pixels of {self.pixel_pitch:g} mm with a phantom of radius "
                f"{self.outline.radius:.3g} mm. Check the units, or give 'magnification'."
            )
        while high / low > 1 + 1e-9:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self._filled(middle) < FILLED else (low, middle)
        step = 10.0 ** (math.floor(math.log10(low)) - DIGITS + 1)
        return float(f"{math.floor(low / step) * step:.{DIGITS}g}")

    def _filled(self, magnification: float) -> float:
        """Share that the phantom covers of the film's width or height in its widest view; the larger of the two.

        A silhouette at the distance z from the entrance pupil and the angle α to the optical axis extends to the slope
        tan α + R (1/ℓ - 1/z), with the pupil's radius R and its distance ℓ from the focus; at F (1 + t/P) times that,
        distorted, lies its image (Eqs. M.41, M.44).
        """
        lens = self._lens(magnification)
        u, pupil = lens.pupil_distance, self.focal_length / self.f_number / 2
        radius = self.outline.radius
        axis = u + radius
        across = radius / math.sqrt(u * (u + 2 * radius)) + pupil * (1 / u - 1 / axis)
        depths = u + (radius - self.outline.radii)  # > 0 however far a vertex lies
        up = float((self.outline.heights / depths + pupil * (1 / u - 1 / depths)).max())
        if lens.distortion is not None:
            corners = np.array([[across, across, 0], [0, up, up]])  # of the outline's rectangle, and its sides
            signs = np.array([[1, 1, -1, -1], [1, -1, 1, -1]])[:, :, None]
            ends = signs * corners[:, None]
            x, y = distorted(ends[0], ends[1], lens.distortion.coefficients)
            across, up = float(np.abs(x).max()), float(np.abs(y).max())
        half = {name: pixels * self.pixel_pitch / 2 for name, pixels in self.film.items()}
        return lens.magnification * u * max(across / half["width"], up / half["height"])

    def _lens(self, magnification: float) -> Lens:
        """The lens as far as the place and the distortion of images depend on it, focused at this magnification."""
        given = {name: self.lens[name] for name in ("pupil_magnification", "distortion") if name in self.lens}
        return Lens.focused(self.focal_length, self.f_number, magnification=magnification, **given)  # type: ignore[arg-type]


def _pixels(name: str, value: int) -> int:
    """A side of the film [pixels]; SceneError unless it is a whole number >= 1."""
    found = whole(f"scene: '{name}'", value, SceneError, "256")
    if found < 1:
        raise SceneError(f"scene: '{name}' must be >= 1 pixel, got {found}. Give for example 256.")
    return found


def _numbers(**given: float) -> dict[str, float]:
    """The values as floats; SceneError for a value that is no finite number, and for a pixel pitch that is not > 0."""
    examples = {"focal_length": "50", "f_number": "1.8", "pixel_pitch": "0.108", "rtol": "1e-3", "view": "90"}
    found = {name: number(f"scene: '{name}'", value, SceneError, examples[name]) for name, value in given.items()}
    for name, value in found.items():
        if not math.isfinite(value) or (name == "pixel_pitch" and value <= 0):
            rule = "> 0 mm and finite" if name == "pixel_pitch" else "finite"
            raise SceneError(f"scene: '{name}' must be {rule}, got {value:g}. Give for example {examples[name]}.")
    return found


def _property(name: str, value: float | str) -> str:
    """Line of a parameter of the lens."""
    tag = "string" if isinstance(value, str) else "float"
    return f"        <{tag} name={quoteattr(name)} value={quoteattr(str(value))}/>\n"
