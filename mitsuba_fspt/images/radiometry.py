"""Units of images: watts, photons per second, and the apparent radiance of a surface in focus."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optics.light import SURFACE, Light
from ..optics.pixel_etendue import pixel_etendues
from ..optics.thin_lens import Lens, number_names
from ..optics.vignetting import Vignetting
from ..runtime.errors import ImageError, OpticsError
from ..runtime.numbers import whole
from .formats import Metadata, write_planes
from .image_data import ImageData
from .pixel_axes import CROP, PixelAxes
from .recorded_number import recorded_number, recorded_positive
from .vignetting_file import recorded_vignetting

UNITS = {"W": "power", "photons/s": "photon_rate", "p/s/cm2/sr": "radiance"}  # with the quantity of each
RADIANCE = "photons/s/cm²/sr"
SQUARE_MM_PER_CM = 100.0
DERIVED = ("focal_length", "magnification", "image_distance", "diaphragm_diameter")  # follow from other numbers
Plane = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Converted:
    """An image in another unit.

    values, error : shape (h, w) [unit]; error None if the image has none
    quantity, unit : 'power' in 'W', 'photon_rate' in 'photons/s' or 'radiance' in 'photons/s/cm²/sr'
    light : None for watts
    """

    values: NDArray[np.floating]
    error: NDArray[np.floating] | None
    quantity: str
    unit: str
    light: Light | None

    def write(self, path: str | os.PathLike[str], image: ImageData) -> None:
        """Write values, error and the coverage and metadata of `image`, which this is made of, as `Image.write` does.

        The metadata state quantity, unit and light. Raises as `Image.write`.
        """
        planes = {self.quantity: self.values, "error": self.error, "coverage": image.coverage}
        entries: Metadata = {"quantity": self.quantity, "unit": self.unit}
        entries |= {} if self.light is None else self.light.metadata()
        write_planes(path, {name: p for name, p in planes.items() if p is not None}, image.metadata | entries)


def require_unit(unit: str, light: Light | None) -> None:
    """Raise ImageError for a unit that does not exist, or a light given with watts."""
    if unit not in UNITS:
        raise ImageError(f"image: 'unit' must be one of {', '.join(UNITS)}, got '{unit}'. Give one of these.")
    if unit == "W" and light is not None:
        raise ImageError(f"image: {light.argument} has no meaning for watts. Leave it out.")


def in_unit(image: ImageData, unit: str, light: Light | None = None) -> Converted:
    """Image in a unit of `UNITS`: W, photons/s or p/s/cm2/sr.

    The radiance is that of a surface in focus: P/(τ G ⟨cos⁴θ⟩), with the étendue of each pixel (Eq. M.6), in photons
    as the surface emits them, before a filter; 0 on pixels that no light can reach.

    Raises
    ------
    ImageError : there is no such unit; the light is missing, not the one that the image was rendered for, or given for
        watts; the metadata do not describe the lens.
    """
    require_unit(unit, light)
    if unit == "W":  # without copies, to save memory
        return Converted(image.power, image.error, UNITS[unit], unit, None)
    light = Light.of_image(image.metadata, light)
    factor: Plane | float = light.photons_per_joule
    if unit != "photons/s":
        etendues = etendue(image)
        inverse = np.divide(SQUARE_MM_PER_CM, etendues, out=np.zeros_like(etendues), where=etendues > 0)
        factor, unit = factor * inverse * surface_ratio(image.metadata, light), RADIANCE
    quantity = "radiance" if unit == RADIANCE else UNITS[unit]
    error = None if image.error is None else (image.error * factor).astype(np.float64)
    return Converted((image.power * factor).astype(np.float64), error, quantity, unit, light)


def surface_ratio(metadata: Metadata, light: Light) -> float:
    """Photons per joule of the light that the surface emits over those of the `light` at the detector.

    It is 1 but for a spectrum behind filters of a curve τ(λ), where P/τ is the power of the whole spectrum.
    """
    return (recorded_positive(metadata, SURFACE) or light.mean_wavelength_nm) / light.mean_wavelength_nm


def etendue(image: ImageData) -> Plane:
    """Étendue τ G ⟨cos⁴θ⟩ of every pixel, shape (h, w) [mm² sr]; ImageError if the metadata lack the lens.

    Of an image that the integral computed with `pixel` = centre, it is that of the centres, as in the integral.
    """
    return etendue_of(image.shape, image.metadata)


def etendue_of(shape: tuple[int, int], known: Metadata) -> Plane:
    """Étendue as of `etendue`, of an image of this shape (h, w) with the metadata `known`."""
    if missing := [name for name in ("focal_length", "f_number", "focus_distance", "pixel_pitch") if name not in known]:
        raise ImageError(
            f"image: its metadata have no '{missing[0]}', so that the étendue of its pixels is unknown. Give an image "
            "as fspt rendered it."
        )
    names = [name for name in number_names() if name in known and name not in DERIVED]
    focal_length, *values = (recorded_number(known, name, math.nan) for name in ("focal_length", *names))
    try:
        lens = Lens.focused(
            focal_length,
            model=str(known.get("model", "diaphragm")),
            distortion=known.get("distortion"),
            **dict(zip(names, values, strict=True)),  # type: ignore[arg-type]
        )
    except (OpticsError, TypeError, ValueError) as cause:
        raise ImageError(f"image: its metadata describe no lens: {cause}") from cause
    axes = PixelAxes.of(shape, known | {"magnification": lens.magnification})
    passed, pixel = recorded_number(known, "transmittance", 1.0), str(known.get("pixel", "area"))
    if not 0 < passed <= 1:
        raise ImageError(
            f"image: 'transmittance' of the metadata must be > 0 and at most 1, got {passed:g}. Correct it."
        )
    etendues = pixel_etendues(lens, axes.step, axes.x, -axes.y, passed, pixel)
    try:
        vignetting = recorded_vignetting(known)
        return etendues if vignetting is None else etendues * _shares(vignetting, shape, known)
    except OpticsError as cause:
        raise ImageError(f"image: {cause}") from cause


def _shares(vignetting: Vignetting, shape: tuple[int, int], known: Metadata) -> Plane:
    """Shares of the pixels (h, w) of an image with the metadata `known`."""
    height, width = shape
    usual = (*zip(CROP, (width, height, 0, 0), strict=True), ("binning", 1), ("pixel_pitch", 0))
    wide, high, left, top, bins, pitch = (recorded_number(known, name, value) for name, value in usual)
    sides = whole("image: 'binning' of the metadata", bins, ImageError, "1")
    return vignetting.on_pixels(pitch, (round(wide), round(high)), (left, top), (width, height), sides)
