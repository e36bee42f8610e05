"""Light of measured images, as their metadata state it: that of one fit is the same, that of a band is its own, and
that of a view is the one of its lens with its filter.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..images.image import Image
from ..optics.light import Light
from ..runtime.errors import InversionError, TransportError

LOG = logging.getLogger("mitsuba_fspt")
ALIKE = 5.0  # nm, between mean wavelengths of the same light by two cameras, from their measured curves
FILTER = 10.0  # nm, from the light of a filter: half of its usual width, within which that is named by one wavelength
FAR = 30.0  # nm, from a band's wavelength: more than between the ways to name the light of a filter, 40 nm wide


def light_of_images(images: Sequence[Image], verb: str) -> float:
    """Mean wavelength [nm] of the images' light, NaN where no metadata state it; a line tells of different light.

    Raises InversionError, in the name of `verb`, for a light that is none.
    """
    found = [Light.recorded(image.metadata, InversionError, f"{verb}: image {k}") for k, image in enumerate(images)]
    each = [light.mean_wavelength_nm for light in found if light is not None]
    if not each:
        return math.nan
    if max(each) - min(each) > ALIKE:
        LOG.warning(
            "fspt: images of one fit are of different light, %.4g and %.4g nm, of which a surface sends out different "
            "amounts. Give images of one band, others for another fit or band.",
            *(min(each), max(each)),
        )
    return float(np.mean(each))


def light_notes(number: int, metadata: Mapping[str, Any], lens: Mapping[str, Any]) -> list[str]:
    """Note of image `number` whose light is not that for which the lens of its view has its transmittance; else [].

    Raises TransportError for metadata of a light that is none.
    """
    own = Light.recorded(lens, TransportError, "transport: the lens")
    light = None if own is None else Light.recorded(metadata, TransportError, f"transport: image {number}")
    if own is None or light is None or abs(light.mean_wavelength_nm - own.mean_wavelength_nm) <= FILTER:
        return []
    return [
        f"image {number} has light of {light.mean_wavelength_nm:.4g} nm, the lens of its view "
        f"{own.mean_wavelength_nm:.4g} nm, for which it has the transmittance {float(lens['transmittance']):.4g}. Give "
        "the lens that light."
    ]


def tell_bands(verb: str, lights: Mapping[str | None, float], stated: Mapping[str, float | None]) -> None:
    """Say in one line on stderr that the images of a band have not its light.

    lights : mean wavelength [nm] of the images of the bands that are given, NaN where it is unknown
    stated : `wavelength_nm` of all bands of the phantom file, None where it does not name it
    """
    known = {name: at for name, at in stated.items() if at is not None}
    for name, light in lights.items():
        if name is None or math.isnan(light):
            continue
        same = [one for one, other in lights.items() if one != name and abs(other - light) <= ALIKE]
        nearest = min(known, key=lambda one: abs(known[one] - light), default=name)
        if same:
            told = f"as have those of band '{same[0]}'"
        elif name in known and nearest != name and abs(known[nearest] - light) < abs(known[name] - light) - ALIKE:
            told = f"that of band '{nearest}' rather than its own, {known[name]:.4g} nm"
        elif name in known and abs(known[name] - light) > FAR:
            told = f"the phantom file has {known[name]:.4g} nm for it"
        else:
            continue
        LOG.warning(
            "fspt: %s: the images of band '%s' have light of %.4g nm, %s. Check the images of each band.",
            *(verb, name, light, told),
        )
        return
