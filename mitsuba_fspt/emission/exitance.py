"""J_n on the surface: the texture a scene gives for it, its values on one shape, and what they must be."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..jit.mesh_buffers import triangles
from ..jit.spectra import at_one_wavelength, scalar
from ..runtime.errors import ExitanceError
from .elements import elements_of

SLIVER = 1e-6  # of the mean area: on a smaller face single precision may find no place to interpolate at
NEGATIVE_ROUNDING = 1e-6  # share of the largest J_n by which interpolation in float32 may fall below a zero
FEWEST, MOST_TEXELS = 1 << 14, 1 << 20  # of a shape's elements that are looked at, of the texels that tell how many
# How the names of Mitsuba's classes begin that hold a colour, or a value for each wavelength.
COLOURS, SPECTRA = ("SRGB", "D65"), ("Regular", "Irregular", "BlackBody")
CORNERS_AND_CENTRE = ((0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0.5))


def texture_of(props: mi.Properties) -> mi.Texture:
    """J_n as a texture; a number is the same at all wavelengths, where Mitsuba would make it white light.

    ExitanceError for a colour or a spectrum, whose watts would depend on the variant, for a bitmap that is none of
    W/mm² and for what is no number.
    """
    value = props["exitance"]
    if isinstance(value, bool):
        raise ExitanceError(
            f"fspt_surface: 'exitance' must be a number or a texture, got {value}. Give W/mm² as a float."
        )
    if not isinstance(value, int | float):
        texture = props.get_emissive_texture("exitance")
        held = texture.class_name()
        if held.startswith(COLOURS + SPECTRA):
            kind = "colour" if held.startswith(COLOURS) else "spectrum"
            raise ExitanceError(
                f"fspt_surface: 'exitance' is a {kind} ({held}), J_n is one number. Give W/mm² as a float or a texture "
                "of one channel."
            )
        _check_bitmap(texture)
        return texture
    uniform = mi.Properties("uniform")
    uniform["value"] = float(value)
    return mi.PluginManager.instance().create_object(uniform)


@dataclass(frozen=True, eq=False)
class ExitanceState:
    """Where J_n comes from: the values of the mesh attribute or of the bitmap that `texture` reads, None where it reads
    none, and its plain numbers, `value` or `scale`.
    """

    attribute: mi.Float | None
    bitmap: mi.Float | None
    numbers: tuple[float, ...]

    @classmethod
    def of(cls, shape: mi.Shape, texture: mi.Texture) -> ExitanceState:
        """As it is now; a mesh that lacks the attribute has none."""
        name, parameters = _attribute_name(texture), mi.traverse(texture)
        on_mesh = {} if name is None else mi.traverse(shape)
        numbers = (n for key in ("value", "scale") if key in parameters for n in np.ravel(parameters[key]))
        return cls(
            mi.Float(on_mesh[name]) if name in on_mesh else None,
            mi.Float(parameters["data"].array) if "data" in parameters else None,
            tuple(map(float, numbers)),
        )

    def state(self) -> tuple[object, ...]:
        """What tells it from any other for as long as it is kept."""
        return *(values if values is None else values.index for values in (self.attribute, self.bitmap)), *self.numbers


def function_on(shape: mi.Shape, texture: mi.Texture) -> Callable[[mi.SurfaceInteraction3f], mi.Float]:
    """J_n [W/mm²] on one shape as a function that calls no pointer; ExitanceError where an attribute is missing.

    A mesh attribute the shape does not have would render black without a word.
    """
    name = _attribute_name(texture)
    if name is None:

        def value(si: mi.SurfaceInteraction3f) -> mi.Float:
            at_one_wavelength(si)
            return scalar(texture.eval(si))

        return value
    if not dr.all(shape.has_attribute(name)):
        kind, _, plain = name.partition("_")
        raise ExitanceError(
            f"fspt_surface: shape '{shape.id()}' has no mesh attribute '{name}'. In a PLY name the {kind} property "
            f"'{plain}_x', or bring the values in with 'fspt flux import'."
        )
    values = ExitanceState.of(shape, texture).attribute
    if values is not None and dr.width(values) != _places(shape, name):
        raise ExitanceError(
            f"fspt_surface: mesh attribute '{name}' of shape '{shape.id()}' has several numbers for each "
            f"{name.partition('_')[0]}, J_n is one. Give an attribute of one channel."
        )
    scale = float(mi.traverse(texture)["scale"])
    return lambda si: shape.eval_attribute_1(name, si) * scale


def at_corners(mesh: mi.Shape, texture: mi.Texture) -> tuple[mi.Float, mi.Float, mi.Float] | None:
    """J_n [W/mm²] at the three corners of every face, between which it is linear; None where it is something else."""
    faces = triangles(mesh)[1]
    count = dr.width(faces) // 3
    if is_uniform(texture):
        everywhere = function_on(mesh, texture)(dr.zeros(mi.SurfaceInteraction3f)) + dr.zeros(mi.Float, count)
        return everywhere, everywhere, everywhere
    name, values = _attribute_name(texture), ExitanceState.of(mesh, texture).attribute
    if name is None or values is None or dr.width(values) != _places(mesh, name):
        return None
    values = values * float(mi.traverse(texture)["scale"])
    if name.startswith("face"):
        return values, values, values
    corner = dr.gather(mi.Vector3u, faces, dr.arange(mi.UInt32, count))
    return tuple(dr.gather(mi.Float, values, index) for index in corner)


def _check_bitmap(texture: mi.Texture) -> None:
    """ExitanceError if `texture` is a bitmap in colour, or of whole numbers that Mitsuba takes for sRGB."""
    values = mi.traverse(texture)
    if "data" not in values:
        return
    height, width, channels = values["data"].shape
    texels = values["data"].numpy()
    if channels > 1 and (texels != texels[..., :1]).any():
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a bitmap of {channels} channels that differ, J_n is one number. Give one of "
            "one channel, as a float EXR."
        )
    if not dr.is_float_v(values["data"]) and "raw = 0" in str(texture):  # which nothing but its description tells
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a picture of {width} × {height} whole numbers, which are decoded as sRGB. "
            'Give W/mm² as a float EXR, or add <boolean name="raw" value="true"/> for shares of the largest number.'
        )


def is_uniform(texture: mi.Texture) -> bool:
    """True where J_n is one number."""
    return texture.class_name() == "UniformSpectrum"


def texels_of(texture: mi.Texture) -> int:
    """How many pixels of the bitmap that is J_n lie on the unit square of (u, v), up to `MOST_TEXELS`; 1 if none is."""
    values = mi.traverse(texture)
    if "data" not in values:
        return 1
    tiles = abs(np.linalg.det(np.array(values["to_uv"].matrix, np.float64).reshape(3, 3)[:2, :2]))
    return round(min(math.prod(values["data"].shape[:2]) * tiles, MOST_TEXELS))


def check_values(shape: mi.Shape, texture: mi.Texture) -> float:
    """Largest J_n [W/mm²] of all corners and centres; ExitanceError if one is negative or not finite, or all are 0."""
    if shape.is_mesh() and not dr.all(dr.isfinite(triangles(shape)[0])):
        raise ExitanceError(f"fspt_surface: shape '{shape.id()}' has vertices that are not finite. Mend its mesh.")
    values, areas = _values_and_areas(shape, texture)
    values, areas = values[areas > 0], areas[areas > 0]  # a face without area emits nothing
    name = f"fspt_surface: 'exitance' of shape '{shape.id()}'"
    if not values.size:
        raise ExitanceError(f"fspt_surface: shape '{shape.id()}' has no area to glow. Mend its mesh.")
    finite = np.isfinite(values)
    if not finite[areas > SLIVER * areas.mean()].all():
        raise ExitanceError(f"{name} has NaN or infinite values. Mend the data before rendering.")
    values = values[finite]
    if values.min() < -NEGATIVE_ROUNDING * values.max(initial=0):
        raise ExitanceError(
            f"{name} must be >= 0 W/mm², its lowest value is {values.min():.4g}. Clip it on import: "
            "'fspt flux import --clip'."
        )
    brightest = float(values.max())
    texels = ExitanceState.of(shape, texture).bitmap
    if brightest == 0 and texels is not None:  # points all over the shape may miss the only bright one
        brightest = float(dr.max(texels)[0])
    if brightest <= 0:
        raise ExitanceError(f"{name} is 0 everywhere: nothing glows. Give J_n in W/mm².")
    return brightest


def _values_and_areas(shape: mi.Shape, texture: mi.Texture) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """J_n [W/mm²] all over a shape and the areas that it counts for; at corners as it was given where it is linear."""
    corners = at_corners(shape, texture) if shape.is_mesh() else None
    elements = elements_of(shape, minimum=1 if corners else max(FEWEST, texels_of(texture)))
    if corners:
        # Interpolation far from the world's origin would make a zero negative.
        area = elements.areas()
        everywhere = [(value, area) for value in corners]
    else:
        value_at, index = function_on(shape, texture), dr.arange(mi.UInt32, elements.count)
        points = [elements.place(index, mi.Point2f(*point)) for point in CORNERS_AND_CENTRE]
        everywhere = [(value_at(si), area) for si, area in points]
    arrays = [np.broadcast_arrays(value.numpy(), area.numpy()) for value, area in everywhere]
    values, areas = (np.concatenate(columns) for columns in zip(*arrays, strict=True))
    return values, areas


def _places(mesh: mi.Shape, attribute: str) -> int:
    """How many vertices or faces of a mesh an attribute of this name is for."""
    positions, faces = triangles(mesh)
    return dr.width(faces if attribute.startswith("face") else positions) // 3


def _attribute_name(texture: mi.Texture) -> str | None:
    """The mesh attribute a texture reads, which only its description tells."""
    found = re.match(r'MeshAttribute\[\s*name = "([^"]*)"', str(texture))
    return found[1] if found else None
