"""Images as xarray's arrays: planes with coordinates in mm and units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..optics.light import Light
from ..runtime.extras import require
from .formats import units
from .image_data import ImageData
from .pixel_axes import PixelAxes
from .radiometry import in_unit

if TYPE_CHECKING:
    from xarray import DataArray, Dataset

DIMENSIONS = ("y", "x")


def dataset(image: ImageData, light: Light | None = None) -> Dataset:
    """As `Image.to_xarray`."""
    require("xarray", "image: to_xarray")
    import xarray as xr

    given = {name: getattr(image, name) for name in ("power", "error", "coverage")}
    planes = {name: _without_masked(image, plane) for name, plane in given.items() if plane is not None}
    arrays = {name: (DIMENSIONS, planes[name], {"units": unit}) for name, unit in units(planes, image.metadata).items()}
    known = dict(image.metadata)
    if light is not None:
        found = in_unit(image, "photons/s", light)
        arrays[found.quantity] = DIMENSIONS, _without_masked(image, found.values), {"units": found.unit}
        known |= light.metadata()
    return xr.Dataset(arrays, coords=_coordinates(image), attrs=known)


def radiance_array(image: ImageData, light: Light | None) -> DataArray:
    """As `Image.to_radiance`."""
    require("xarray", "image: to_radiance")
    import xarray as xr

    found = in_unit(image, "p/s/cm2/sr", light)
    beside = {"error": (found.error, found.unit), "coverage": (image.coverage, "1")}
    coordinates = {
        name: (DIMENSIONS, _without_masked(image, plane), {"units": unit})
        for name, (plane, unit) in beside.items()
        if plane is not None
    }
    attributes = {"units": found.unit} | (found.light.metadata() if found.light else {})
    values = _without_masked(image, found.values)
    return xr.DataArray(values, {**_coordinates(image), **coordinates}, DIMENSIONS, found.quantity, attributes)


def _without_masked(image: ImageData, plane: NDArray) -> NDArray:
    """`plane` (h, w) with NaN on the pixels that the image masks, which means over arrays leave out."""
    return plane if image.mask is None else np.where(image.mask, np.nan, plane).astype(plane.dtype)


def _coordinates(image: ImageData) -> dict[str, tuple]:
    """x and y of the pixels' centres, with their unit and plane."""
    axes = PixelAxes.of(image.shape, image.metadata)
    attributes = {"units": axes.unit, "long_name": axes.label}
    return {"y": ("y", axes.y, {**attributes}), "x": ("x", axes.x, {**attributes})}
