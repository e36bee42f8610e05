"""Inputs of `fspt_lens`: its numbers, a sampler, and a film whose pixels each store one independent float32 number."""

from __future__ import annotations

import mitsuba as mi

from ..jit.plugin_objects import made
from ..runtime.errors import OpticsError


def own_film(props: mi.Properties) -> None:
    """Replace the film in `props` by a monochrome float32 film with a box filter and the same size and crop window."""
    size, crop_offset, crop_size = (256, 256), (0, 0), None
    for name, child in props.objects():
        if isinstance(child, mi.Film):
            size, crop_offset, crop_size = child.size(), child.crop_offset(), child.crop_size()
            del props[name]
            break
    crop_size = size if crop_size is None else crop_size
    film = mi.Properties("hdrfilm")
    film["width"], film["height"] = int(size[0]), int(size[1])
    film["crop_offset_x"], film["crop_offset_y"] = int(crop_offset[0]), int(crop_offset[1])
    film["crop_width"], film["crop_height"] = int(crop_size[0]), int(crop_size[1])
    film["pixel_format"], film["component_format"] = "luminance", "float32"
    film["rfilter"] = made("box")
    props["film"] = mi.PluginManager.instance().create_object(film)


def default_sampler(props: mi.Properties) -> None:
    """Add Mitsuba's most efficient sampler for light straight from the surface to `props` if the scene names none."""
    if not any(isinstance(child, mi.Sampler) for _, child in props.objects()):
        props["sampler"] = made("multijitter", sample_count=64)


def number(props: mi.Properties, name: str) -> mi.Float64:
    """Value of a lens parameter in double precision; OpticsError if it is no number."""
    value = props[name]
    try:
        if not isinstance(value, bool):
            return mi.Float64(float(value))
    except (TypeError, ValueError):
        pass
    raise OpticsError(f"fspt_lens: '{name}' must be a number, got {value!r}. Give it as a float.")
