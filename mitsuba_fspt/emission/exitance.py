"""J_n on the surface: the texture of the scene file, its values on one shape, and the checks of both."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..jit.mesh_buffers import flat, triangles
from ..jit.spectra import at_one_wavelength, scalar
from ..runtime.errors import ExitanceError
from .elements import elements_of

SLIVER = 1e-6  # of the mean area: on a smaller face the interpolation in single precision may fail
NEGATIVE_ROUNDING = 1e-6  # of the largest J_n: interpolation in float32 may turn 0 into as small a negative number
FEWEST, MOST_TEXELS = 1 << 14, 1 << 20  # elements checked on a shape: at least FEWEST, one a texel up to MOST_TEXELS
# Beginnings of the names of Mitsuba's classes for a colour, and for a value at each wavelength.
COLOURS, SPECTRA = ("SRGB", "D65"), ("Regular", "Irregular", "BlackBody")
HALF_FLOATS = re.compile(r'name = "[^"]*\.exr"', re.IGNORECASE)  # in the description of a bitmap of 16-bit floats
SMALLEST_HALF = 2.0**-14  # smallest 16-bit float with all its digits, to 5e-4
COARSE_HALF = SMALLEST_HALF / 20  # below it a 16-bit float may be wrong by more than 1 %
LOG = logging.getLogger("mitsuba_fspt")
CORNERS_AND_CENTRE = ((0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0.5))


def texture_of(props: mi.Properties) -> mi.Texture:
    """J_n [W/mm²] as a texture. A number applies at all wavelengths; Mitsuba's own reader would make it white light.

    Raises
    ------
    ExitanceError : the value is a colour or a spectrum, whose watts would depend on the variant, a bitmap that does
        not hold W/mm², or no number.
    """
    value = props["exitance"]
    if isinstance(value, bool):
        raise ExitanceError(
            f"fspt_surface: 'exitance' must be a number or a texture, got {value}. Give W/mm² as a float."
        )
    if props.type("exitance") == mi.Properties.Type.Color:  # a monochrome variant would take its luminance
        colour = ", ".join(f"{share:g}" for share in np.ravel(value))
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a colour ({colour}), J_n is one number. Give W/mm² as a float or a texture "
            "of one channel."
        )
    if props.type("exitance") == mi.Properties.Type.Spectrum and not value.is_uniform():
        raise ExitanceError(
            "fspt_surface: 'exitance' is a spectrum, J_n is one number. Give W/mm² as a float or a texture of one "
            "channel."
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
    return uniform(float(value))


def uniform(value: float) -> mi.Texture:
    """Texture with the same J_n = `value` [W/mm²] everywhere."""
    properties = mi.Properties("uniform")
    properties["value"] = value
    return mi.PluginManager.instance().create_object(properties)


@dataclass(frozen=True, eq=False)
class ExitanceState:
    """Data behind J_n, for the detection of changes.

    attribute, bitmap : values of the mesh attribute or of the bitmap that the texture reads; None if it reads none
    numbers : plain numbers of the texture, `value` or `scale`
    """

    attribute: mi.Float | None
    bitmap: mi.Float | None
    numbers: tuple[float, ...]

    @classmethod
    def of(cls, shape: mi.Shape, texture: mi.Texture) -> ExitanceState:
        """Present data of a texture on a shape; `attribute` is None on a mesh that lacks it."""
        name, parameters = attribute_name(texture), mi.traverse(texture)
        on_mesh = {} if name is None else mi.traverse(shape)
        numbers = (n for key in ("value", "scale") if key in parameters for n in np.ravel(parameters[key]))
        return cls(
            mi.Float(flat(on_mesh[name])) if name in on_mesh else None,
            mi.Float(parameters["data"].array) if "data" in parameters else None,
            tuple(map(float, numbers)),
        )

    def state(self) -> tuple[object, ...]:
        """Key of the data, different from that of any other data for as long as this object exists."""
        return *(values if values is None else values.index for values in (self.attribute, self.bitmap)), *self.numbers


def function_on(shape: mi.Shape, texture: mi.Texture) -> Callable[..., mi.Float]:
    """J_n [W/mm²] on one shape, as a function of the surface interaction that calls no Dr.Jit pointer.

    The function takes a surface interaction and, optionally, a mask of the array entries to evaluate.

    Raises
    ------
    ExitanceError : the shape lacks the mesh attribute, which would silently render black, or it has several channels.
    """
    name = attribute_name(texture)
    if name is None:

        def value(si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Float:
            at_one_wavelength(si)
            return scalar(texture.eval(si, active))

        return value
    if not dr.all(shape.has_attribute(name)):
        kind, _, plain = name.partition("_")
        raise ExitanceError(
            f"fspt_surface: shape '{shape.id()}' has no mesh attribute '{name}'. In a PLY name the {kind} property "
            f"'{plain}_x', or bring the values in with 'fspt flux import'."
        )
    values = ExitanceState.of(shape, texture).attribute
    if values is not None and dr.width(values) != _attribute_size(shape, name):
        raise ExitanceError(
            f"fspt_surface: mesh attribute '{name}' of shape '{shape.id()}' has several numbers for each "
            f"{name.partition('_')[0]}, J_n is one. Give an attribute of one channel."
        )
    scale = float(mi.traverse(texture)["scale"])
    return lambda si, active=True: shape.eval_attribute_1(name, si, active) * scale


def values_on(mesh: mi.Shape, texture: mi.Texture) -> mi.Float:
    """J_n [W/mm²] on each vertex or face of a mesh, whichever carries the attribute; on each vertex if J_n is a number.

    The values carry the gradients of the numbers behind J_n.

    Raises ExitanceError as `function_on`.
    """
    value = function_on(mesh, texture)
    if is_uniform(texture):
        return value(dr.zeros(mi.SurfaceInteraction3f)) + dr.zeros(mi.Float, dr.width(triangles(mesh)[0]) // 3)
    return ExitanceState.of(mesh, texture).attribute * float(mi.traverse(texture)["scale"])


def at_corners(mesh: mi.Shape, texture: mi.Texture) -> tuple[mi.Float, mi.Float, mi.Float] | None:
    """J_n [W/mm²] at the three corners of every face, each of shape (F,); None if J_n is not linear on the faces."""
    faces = triangles(mesh)[1]
    count = dr.width(faces) // 3
    if is_uniform(texture):
        everywhere = function_on(mesh, texture)(dr.zeros(mi.SurfaceInteraction3f)) + dr.zeros(mi.Float, count)
        return everywhere, everywhere, everywhere
    name, values = attribute_name(texture), ExitanceState.of(mesh, texture).attribute
    if name is None or values is None or dr.width(values) != _attribute_size(mesh, name):
        return None
    values = values * float(mi.traverse(texture)["scale"])
    if name.startswith("face"):
        return values, values, values
    corner = dr.gather(mi.Vector3u, faces, dr.arange(mi.UInt32, count))
    return tuple(dr.gather(mi.Float, values, index) for index in corner)


def _check_bitmap(texture: mi.Texture) -> None:
    """Raise ExitanceError for a bitmap in colour, of whole numbers that Mitsuba decodes as sRGB, or too dark for its
    16-bit floats.

    Mitsuba stores whole numbers of 16 bits as floats of 16 bits, as it stores an EXR of such floats.
    """
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
    half, described = dr.is_half_v(values["data"]), str(texture)  # no other way to ask a texture for `raw` and its file
    if half and 'name = ""' in described and "raw = 0" in described:
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a bitmap in memory of {width} × {height} texels of 16 bits, and Mitsuba does "
            "not tell whether they are floats or whole numbers, which it decodes as sRGB. Convert it to Float32 in "
            "W/mm², or set raw to true."
        )
    whole = not dr.is_float_v(values["data"]) or (half and not HALF_FLOATS.search(described))
    if whole and "raw = 0" in described:
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a picture of {width} × {height} whole numbers, which are decoded as sRGB. "
            'Give W/mm² as a float EXR, or add <boolean name="raw" value="true"/> for shares of the largest number.'
        )
    if half and 0 < (largest := float(texels.max())) < SMALLEST_HALF:
        raise ExitanceError(
            f"fspt_surface: 'exitance' is a bitmap of 16-bit floats up to {largest:.3g} W/mm², where these have steps "
            "of 6e-8. Save it with 32-bit floats."
        )
    if half and (coarse := (texels > 0) & (texels < COARSE_HALF)).any():
        LOG.warning(
            "fspt: fspt_surface: %d of %d texels of 'exitance' are 16-bit floats below %.2g W/mm², which have steps of "
            "6e-8: J_n there is wrong by up to %.0f %%. Save it with 32-bit floats.",
            *(np.count_nonzero(coarse[..., 0]), coarse[..., 0].size),
            *(COARSE_HALF, 100 * 2.0**-25 / float(texels[coarse].min())),
        )


def is_uniform(texture: mi.Texture) -> bool:
    """True if J_n is one number."""
    return texture.class_name() == "UniformSpectrum"


def texels_of(texture: mi.Texture) -> int:
    """Number of texels of the bitmap of J_n on the unit square of (u, v), at most `MOST_TEXELS`; 1 without a bitmap."""
    values = mi.traverse(texture)
    if "data" not in values:
        return 1
    tiles = abs(np.linalg.det(np.array(values["to_uv"].matrix, np.float64).reshape(3, 3)[:2, :2]))
    return round(min(math.prod(values["data"].shape[:2]) * tiles, MOST_TEXELS))


def square_texels_of(texture: mi.Texture) -> int:
    """Number of squares on the unit square of (u, v) of which each has a texel's shorter side, at most `MOST_TEXELS`; 1
    without a bitmap.
    """
    values = mi.traverse(texture)
    if "data" not in values:
        return 1
    of_texels = np.array(values["data"].shape[1::-1])[:, None]  # columns and rows on the unit square of the bitmap
    along = of_texels * np.abs(np.array(values["to_uv"].matrix, np.float64).reshape(3, 3)[:2, :2])
    return round(min(max(float(along.max()), 1.0) ** 2, MOST_TEXELS))


def check_values(shape: mi.Shape, texture: mi.Texture) -> float:
    """Largest J_n [W/mm²] of the corners and centres of a shape's elements; 0 where nothing glows.

    Raises
    ------
    ExitanceError : a value is negative or not finite, or the shape has no area or vertices that are not finite.
    """
    if shape.is_mesh() and not dr.all(dr.isfinite(triangles(shape)[0])):
        raise ExitanceError(f"fspt_surface: shape '{shape.id()}' has vertices that are not finite. Fix its mesh.")
    values, areas = _values_and_areas(shape, texture)
    values, areas = values[areas > 0], areas[areas > 0]  # a face without area emits nothing
    name = f"fspt_surface: 'exitance' of shape '{shape.id()}'"
    if not values.size:
        raise ExitanceError(f"fspt_surface: shape '{shape.id()}' has no area to glow. Fix its mesh.")
    finite = np.isfinite(values)
    if not finite[areas > SLIVER * areas.mean()].all():
        raise ExitanceError(f"{name} has NaN or infinite values. Fix the data before rendering.")
    values = values[finite]
    if values.min() < -NEGATIVE_ROUNDING * values.max(initial=0):
        raise ExitanceError(
            f"{name} must be >= 0 W/mm², its lowest value is {values.min():.4g}. Clip it on import: "
            "'fspt flux import --clip'."
        )
    brightest = float(values.max())
    texels = ExitanceState.of(shape, texture).bitmap
    if brightest == 0 and texels is not None:  # the checked points may miss the only bright texel
        brightest = float(dr.max(texels)[0])
    return max(brightest, 0.0)


def _values_and_areas(shape: mi.Shape, texture: mi.Texture) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """J_n [W/mm²] at points all over a shape, and the area [mm²] of the element that each point lies on.

    If J_n is linear on the faces of a mesh, the points are the corners of the faces.
    """
    corners = at_corners(shape, texture) if shape.is_mesh() else None
    elements = elements_of(shape, minimum=1 if corners else max(FEWEST, texels_of(texture)))
    if corners:
        # Far from the world's origin, interpolation could turn a zero into a negative number.
        area = elements.areas()
        everywhere = [(value, area) for value in corners]
    else:
        value_at, index = function_on(shape, texture), dr.arange(mi.UInt32, elements.count)
        points = [elements.place(index, mi.Point2f(*point)) for point in CORNERS_AND_CENTRE]
        everywhere = [(value_at(si), area) for si, area in points]
    arrays = [np.broadcast_arrays(value.numpy(), area.numpy()) for value, area in everywhere]
    values, areas = (np.concatenate(columns) for columns in zip(*arrays, strict=True))
    return values, areas


def _attribute_size(mesh: mi.Shape, attribute: str) -> int:
    """Number of vertices or faces of a mesh, the elements of an attribute with this name."""
    positions, faces = triangles(mesh)
    return dr.width(faces if attribute.startswith("face") else positions) // 3


def attribute_name(texture: mi.Texture) -> str | None:
    """Name of the mesh attribute that a texture reads, taken from the texture's description; None if it reads none."""
    found = re.match(r'MeshAttribute\[\s*name = "([^"]*)"', str(texture))
    return found[1] if found else None
