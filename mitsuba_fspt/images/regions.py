"""Regions of interest: selection of pixels, and radiometric quantities of the light from them."""

from __future__ import annotations

import csv
import io
import math
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..optics.light import Light
from ..runtime.errors import ImageError
from .image_data import ImageData
from .pixel_axes import PixelAxes
from .radiometry import SQUARE_MM_PER_CM, in_unit
from .tiff_pages import read_tiff
from .z_test import is_deterministic

Mask = NDArray[np.bool_]
FORMS = "x,y,width,height, circle:x,y,radius, 25% or mask.tif"


@dataclass(frozen=True)
class Measurement:
    """Light of a region, in the columns that imaging programs print.

    total_flux, total_flux_error : photons/s that a Lambertian surface in focus emits there, π Σ L ΔA over its pixels
    mean_radiance, mean_radiance_error, sd_radiance, min_radiance, max_radiance : photons/s/cm²/sr; sd of the pixels
    area : cm² on the virtual detector plane
    pixels : number of pixels
    power : W on the pixels
    masked : number of the region's pixels that the image masks, such as saturated ones; no number above counts them

    The errors are None for an image without errors. Those of the integral are bounds and add up; standard errors of
    Monte Carlo and of counts add up in squares, with the `gain_error` of counts, which is common to all pixels.
    """

    total_flux: float
    total_flux_error: float | None
    mean_radiance: float
    mean_radiance_error: float | None
    sd_radiance: float
    min_radiance: float
    max_radiance: float
    area: float
    pixels: int
    power: float
    masked: int = 0


HEADINGS = {
    "total_flux": "total_flux [photons/s]",
    "total_flux_error": "total_flux_error [photons/s]",
    "mean_radiance": "mean_radiance [photons/s/cm^2/sr]",
    "mean_radiance_error": "mean_radiance_error [photons/s/cm^2/sr]",
    "sd_radiance": "sd_radiance [photons/s/cm^2/sr]",
    "min_radiance": "min_radiance [photons/s/cm^2/sr]",
    "max_radiance": "max_radiance [photons/s/cm^2/sr]",
    "area": "area [cm^2]",
    "pixels": "pixels",
    "power": "power [W]",
    "masked": "masked [pixels left out]",
}


def measure(
    image: ImageData, region: str | os.PathLike[str] | Mask | None = None, light: Light | None = None
) -> Measurement:
    """Radiometric quantities of the light from a region of an image, without its masked pixels.

    Parameters
    ----------
    image : power [W]
    region : mask (h, w) of True and False, or text or a file's name as of `region_mask`; None: all pixels
    light : None: that of the image, by its lens and filter

    Raises
    ------
    ImageError : no such region, no pixel in it that is not masked, or as in `in_unit`.
    """
    if isinstance(region, os.PathLike):
        region = os.fspath(region)
    if region is None:
        region = np.ones(image.shape, bool)
    mask = region_mask(image, region) if isinstance(region, str) else np.asarray(region)
    _check_mask(image, mask, "region")
    mask, masked = mask & image.kept, int(np.count_nonzero(mask & ~image.kept))
    if not mask.any():
        name = f"region '{region}'" if isinstance(region, str) else "region"
        raise ImageError(f"{name}: all its {masked} pixels are masked. Give another one, or expose for a shorter time.")
    converted = in_unit(image, "p/s/cm2/sr", light)
    side = PixelAxes.of(image.shape, image.metadata).step
    area = side**2 / SQUARE_MM_PER_CM  # of a pixel
    values, count = converted.values[mask], int(mask.sum())
    error = None
    if converted.error is not None:
        errors = converted.error[mask]
        error = float(errors.sum() if is_deterministic(image) else math.sqrt(np.square(errors).sum()))
        error = math.hypot(error, (image.gain_error or 0.0) * float(values.sum()))
    return Measurement(
        total_flux=math.pi * area * float(values.sum()),
        total_flux_error=None if error is None else math.pi * area * error,
        mean_radiance=float(values.mean()),
        mean_radiance_error=None if error is None else error / count,
        sd_radiance=float(values.std()),
        min_radiance=float(values.min()),
        max_radiance=float(values.max()),
        area=area * count,
        pixels=count,
        power=float(image.power[mask].sum(dtype=np.float64)),
        masked=masked,
    )


def region_mask(image: ImageData, text: str) -> Mask:
    """Pixels (h, w) of a region described by text; pixels count from the upper left corner.

    'x,y,width,height' : a rectangle, with the first pixel x, y
    'circle:x,y,radius' : the pixels whose centres lie in the circle; x, y of its centre from the image's corner
    '25%' : the pixels with at least this share of the brightest pixel's power, masked ones left out
    name of a TIFF file of the image's size : the pixels whose value there is not 0

    Raises
    ------
    ImageError : the text is none of these, or no pixel lies in the region.
    BackendError : tifffile, which reads masks, is not installed.
    """
    if Path(text).suffix.lower() in (".tif", ".tiff"):
        mask = _mask_of_file(text)
    elif text.endswith("%"):
        (share,) = _numbers(text[:-1], text, 1)
        if not 0 < share <= 100:
            raise ImageError(f"region '{text}': a threshold is above 0% and at most 100%. Give for example 25%.")
        power = np.where(image.kept, image.power, 0)
        mask = power >= share / 100 * power.max() if power.max() > 0 else np.zeros(image.shape, bool)
    elif text.startswith("circle:"):
        x, y, radius = _numbers(text.removeprefix("circle:"), text, 3)
        rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
        mask = np.hypot(columns + 0.5 - x, rows + 0.5 - y) <= radius
    else:
        x, y, width, height = _numbers(text, text, 4)
        if any(value != int(value) for value in (x, y, width, height)) or min(x, y) < 0 or min(width, height) < 1:
            raise ImageError(
                f"region '{text}': a rectangle has whole pixels, x and y from 0. Give for example 10,20,8,8."
            )
        if x + width > image.shape[1] or y + height > image.shape[0]:
            size = " x ".join(map(str, image.shape[::-1]))
            raise ImageError(f"region '{text}': reaches beyond the image of {size} pixels. Give a smaller one.")
        mask = np.zeros(image.shape, bool)
        mask[int(y) : int(y + height), int(x) : int(x + width)] = True
    _check_mask(image, mask, f"region '{text}'")
    return mask


def _mask_of_file(name: str) -> Mask:
    """Pixels of a TIFF file that are neither 0 nor NaN, which stands for what is outside."""
    if not os.path.isfile(name):
        raise ImageError(f"region '{name}': there is no such file. Give a mask, or {FORMS}.")
    values = np.asarray(read_tiff(Path(name), f"region '{name}'"))
    return (values != 0) & ~np.isnan(values)


def _check_mask(image: ImageData, mask: Mask, what: str) -> None:
    """Raise ImageError for a mask of another size, or without a pixel."""
    if mask.shape != image.shape or mask.dtype != bool:
        size = " x ".join(map(str, image.shape[::-1]))
        raise ImageError(
            f"{what}: a mask of shape {mask.shape} does not fit the image of {size} pixels. Give one of it."
        )
    if not mask.any():
        raise ImageError(f"{what}: no pixel of the image lies in it. Give another one.")


def _numbers(text: str, region: str, count: int) -> list[float]:
    """`count` finite numbers, separated by commas in the text; ImageError for any other text."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ImageError(f"region '{region}': must be {FORMS}, in pixels. Give for example 10,20,8,8.")
    return found


def csv_table(rows: list[tuple[str, str, Measurement]]) -> str:
    """CSV text of measurements, each with the names of its image and of its region; columns state their units."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image", "region", *(HEADINGS[field.name] for field in fields(Measurement))])
    for image, region, found in rows:
        numbers = (f"{value:.6g}" if isinstance(value, float) else value for value in asdict(found).values())
        writer.writerow([image, region, *numbers])
    return text.getvalue()
