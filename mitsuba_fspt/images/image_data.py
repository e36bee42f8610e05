"""Data of an image: power [W] on every pixel, its error and coverage, and metadata, checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..runtime.errors import FsptError, ImageError
from .formats import BESIDE, Metadata
from .recorded_number import recorded_number


@dataclass(frozen=True, eq=False, repr=False)
class ImageData:
    """Planes and metadata of an image, as `Image` describes them; `Image` adds what can be done with them."""

    power: NDArray[np.floating]
    error: NDArray[np.floating] | None = None
    coverage: NDArray[np.floating] | None = None
    metadata: Metadata = field(default_factory=dict)
    mask: NDArray[np.bool_] | None = None
    flat: NDArray[np.floating] | None = None
    flat_error: NDArray[np.floating] | None = None
    dark_noise: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.power)
        masks = [] if self.mask is None else [_mask_plane(self.mask, shape)]
        for name in ("power", *(name for name in BESIDE if name != "mask")):
            values = getattr(self, name)
            if values is None and name != "power":
                continue
            plane = _plane(name, values)
            if plane.shape != shape:
                raise ImageError(f"image: '{name}' must have the shape {shape} of 'power', got {plane.shape}. Crop it.")
            object.__setattr__(self, name, plane)
            if np.ma.is_masked(values):
                masks.append(np.ma.getmaskarray(values))
        object.__setattr__(self, "mask", _own(np.logical_or.reduce(masks), bool) if masks else None)
        if self.error is not None:
            counted = self.error if self.mask is None else self.error[~self.mask]
            if (counted < 0).any():
                raise ImageError(f"image: 'error' must be >= 0, got {counted.min():g}. Give an absolute error [W].")
        if self.flat is not None and not (self.flat > 0).all():
            raise ImageError(f"image: 'flat' must be > 0, got {self.flat.min():g}. Mask such pixels, with 1 in 'flat'.")
        for name in ("flat_error", "dark_noise"):
            if (given := getattr(self, name)) is not None and not (given >= 0).all():
                raise ImageError(f"image: '{name}' must be >= 0, got {given.min():g}. Give a standard deviation.")
        if not isinstance(self.metadata, Mapping):
            kind = type(self.metadata).__name__
            raise ImageError(f"image: 'metadata' must be texts and numbers by name, got {kind}. Give a dict, or none.")
        metadata: Metadata = {"quantity": "power", "unit": "W"}
        metadata |= {k: v.item() if isinstance(v, np.generic) else v for k, v in self.metadata.items()}
        if (metadata["quantity"], metadata["unit"]) != ("power", "W"):
            raise ImageError(
                f"image: the values are {metadata['quantity']} in {metadata['unit']}, not power in W. "
                "Give an image as the camera renders it."
            )
        object.__setattr__(self, "metadata", metadata)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width (h, w) [pixels]."""
        return self.power.shape

    @property
    def kept(self) -> NDArray[np.bool_]:
        """True (h, w) on the pixels that are not masked."""
        return np.ones(self.shape, bool) if self.mask is None else ~self.mask

    @property
    def masked(self) -> int:
        """Number of masked pixels, which totals and comparisons leave out."""
        return 0 if self.mask is None else int(self.mask.sum())

    @property
    def total_power(self) -> float:
        """Sum [W] over the pixels that are not masked."""
        return float(self.power.sum(dtype=np.float64, where=self.kept))

    @property
    def electrons_per_watt(self) -> float | None:
        """Photoelectrons per watt on a pixel, before an electron-multiplying register, of an image that
        `Detector.reduce` made; None of any other."""
        return self._recorded("electrons_per_watt", "> 0", lambda v: v > 0)

    @property
    def read_noise(self) -> float | None:
        """Read noise [e-] of the sum of its frames over `em_gain`, of an image that `Detector.reduce` made; else None.

        Of a map, it is the root mean square.
        """
        return self._recorded("read_noise", ">= 0 e-", lambda v: v >= 0)

    @property
    def gain_error(self) -> float | None:
        """Relative uncertainty common to all pixels, of an image that `Detector.reduce` made; None of any other."""
        return self._recorded("gain_error", "in [0, 1)", lambda v: 0 <= v < 1)

    def _recorded(self, name: str, rule: str, holds: Callable[[float], bool]) -> float | None:
        """A number of the metadata; ImageError for one that does not keep the rule."""
        if self.metadata.get(name) is None:
            return None
        if not holds(found := recorded_number(self.metadata, name, math.nan)):
            raise ImageError(f"image: '{name}' of the metadata must be {rule}, got {found:g}. Correct it.")
        return found


def _mask_plane(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """`values` as an array of True and False of this shape; ImageError for anything else."""
    array = np.asarray(values)
    if array.dtype != bool or array.shape != shape:
        raise ImageError(
            f"image: 'mask' must be True and False of the shape {shape} of 'power', got {array.dtype} of shape "
            f"{array.shape}. Give True for pixels to leave out."
        )
    return array


def _plane(name: str, values: ArrayLike) -> NDArray[np.floating]:
    """`values` as a read-only array (h, w) of at least 32-bit floats; ImageError if shape, type or a value is wrong.

    Where a masked array hides them, they are 1 in 'flat' and 0 in others.
    """
    require_upright(f"image: '{name}'", values, ImageError)
    array = np.ma.filled(values, 1 if name == "flat" else 0)
    if array.ndim != 2 or array.size == 0 or array.dtype.kind not in "fiu":
        raise ImageError(
            f"image: '{name}' must be numbers of shape (h, w), got {array.dtype} of shape {array.shape}. "
            "Give one value a pixel."
        )
    finite = np.isfinite(array)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise ImageError(
            f"image: '{name}' must be finite, got {array[row, column]} at row {row}, column {column} "
            f"({np.sum(~finite)} such pixels). Check the exitance."
        )
    return _own(array, np.result_type(array.dtype, np.float32))


def _own(array: NDArray, dtype: DTypeLike) -> NDArray:
    """The values of an array, read-only: a copy, unless the array is read-only and no view of another one."""
    if type(array) is np.ndarray and array.dtype == dtype and array.base is None and not array.flags.writeable:
        return array
    own = np.array(array, dtype)
    own.flags.writeable = False
    return own


def require_upright(thing: str, values: object, error: type[FsptError]) -> None:
    """Raise `error` for an array of xarray with x before y, or whose x or y [mm] runs the other way than an `Image`'s.

    An `Image` has the largest y in row 0, the least x in column 0.
    """
    dimensions, coordinates = getattr(values, "dims", ())[-2:], getattr(values, "coords", {})
    if dimensions == ("x", "y"):
        raise error(f"{thing} has the dimensions (x, y). Give .transpose(..., 'y', 'x').")
    for axis, descends in (("y", True), ("x", False)) if dimensions == ("y", "x") else ():
        place = coordinates.get(axis)
        if place is None or place.attrs.get("units") != "mm" or len(place) < 2 or (place[0] > place[-1]) == descends:
            continue
        order, sign = ("descend", "upwards") if descends else ("ascend", "to the right")
        raise error(
            f"{thing} has {axis} [mm] that must {order}, as {axis} counts {sign}. Give .sortby('{axis}', "
            f"{not descends}), or .values if your {axis} counts the other way."
        )
