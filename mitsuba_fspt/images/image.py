"""Image of a camera: power [W] on every pixel, its error and coverage, and metadata."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..runtime.errors import ImageError
from ..runtime.numbers import number
from .exr import Metadata, read_exr, write_exr


@dataclass(frozen=True, eq=False)
class Image:
    """Power on the pixels of a detector; row 0 is the top of the upright picture.

    Parameters
    ----------
    power : array, shape (h, w) [W], power on each pixel
    error : array, shape (h, w) [W], estimated absolute error of the power (Monte Carlo: standard error), or None
    coverage : array, shape (h, w), unweighted share in [0, 1] of a pixel's lines of sight that reach a shape with
        `fspt_surface`, or None
    metadata : text and numbers that record the origin of the image; `quantity` and `unit` are added
    mask : bool array, shape (h, w), True for pixels to leave out, as saturated ones, or None

    The arrays are stored as read-only views with at least 32-bit floats.

    Raises
    ------
    ImageError : an array is not of shape (h, w), the shapes differ, a value is NaN or infinite, or the
        metadata name another quantity or unit than power in W.
    """

    power: NDArray[np.floating]
    error: NDArray[np.floating] | None = None
    coverage: NDArray[np.floating] | None = None
    metadata: Metadata = field(default_factory=dict)
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.power)
        if self.mask is not None:
            object.__setattr__(self, "mask", _mask_plane(self.mask, shape))
        for name in ("power", "error", "coverage"):
            values = getattr(self, name)
            if values is None and name != "power":
                continue
            plane = _plane(name, values)
            if plane.shape != shape:
                raise ImageError(f"image: '{name}' must have the shape {shape} of 'power', got {plane.shape}. Crop it.")
            object.__setattr__(self, name, plane)
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

    def scaled(self, source_power: float) -> Image:
        """Image of the same scene with a light source of `source_power` [W], where this one is per 1 W of source.

        Power and error are multiplied by it; coverage stays. The metadata record it as `source_power`.

        Raises
        ------
        ImageError : `source_power` is not finite and > 0, or the metadata hold a `source_power` already.
        """
        watt = required_source_power(source_power)
        if "source_power" in self.metadata:
            raise ImageError(
                f"image: 'source_power' is {self.metadata['source_power']:g} W already, got {watt:g} W. "
                "Leave it out, or render the image without it."
            )
        error = None if self.error is None else self.error.astype(np.float64) * watt
        metadata = self.metadata | {"source_power": watt}
        return Image(self.power.astype(np.float64) * watt, error, self.coverage, metadata, self.mask)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[np.floating]:
        """The power, shape (h, w) [W], for `np.asarray(image)`; read-only unless it is a copy."""
        return np.array(self.power, dtype=dtype, copy=copy)  # type: ignore[arg-type]  # copy=None: if needed

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write an EXR file: channels `Y`, `error.Y`, `coverage.Y`, `mask.Y` (float32), metadata under `fspt:`.

        The file is written completely or not at all. Pixels below float32's 1e-38 may become 0; an image whose
        brightest pixel lies below that is refused.

        Raises
        ------
        ImageError : the suffix is not .exr, a value does not fit into float32, or the file cannot be written.
        """
        peak = max(self.power.max(), -self.power.min())
        if 0 < peak < np.finfo(np.float32).tiny:
            raise ImageError(
                f"image: the brightest pixel has {peak:g} W, below what the file can hold (1.2e-38 W). "
                "Scale the exitance up."
            )
        planes = {"Y": self.power, "error.Y": self.error, "coverage.Y": self.coverage}
        planes["mask.Y"] = None if self.mask is None else self.mask.astype(np.float32)
        write_exr(path, {name: p for name, p in planes.items() if p is not None}, self.metadata)


def read(path: str | os.PathLike[str]) -> Image:
    """Image of an EXR file with a channel `Y`, whose values count as power [W] on a pixel.

    `error`, `coverage` and `mask` are None if the file has no channel `error.Y`, `coverage.Y`, `mask.Y`.

    Raises
    ------
    ImageError : the file does not exist, is no EXR file or damaged, has no channel `Y`, or holds values that are
        not finite or, by its metadata, no power.
    """
    channels, metadata = read_exr(path)
    if "Y" not in channels:
        raise ImageError(
            f"image file '{path}' has no channel 'Y' (power in W), its channels are {', '.join(channels)}. "
            "Give a file that fspt wrote."
        )
    try:
        mask = channels["mask.Y"] != 0 if "mask.Y" in channels else None
        return Image(channels["Y"], channels.get("error.Y"), channels.get("coverage.Y"), metadata, mask)
    except ImageError as cause:
        raise ImageError(f"image file '{path}': {cause}") from cause


def required_source_power(watt: float) -> float:
    """Power of a light source [W] as a float; ImageError unless it is finite and > 0."""
    found = number("image: 'source_power'", watt, ImageError, "1e-9")
    if not 0 < found < math.inf:
        raise ImageError(f"image: 'source_power' must be finite and > 0 W, got {found:g}. Give for example 1e-9.")
    return found


def _mask_plane(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """`values` as a read-only array of True and False of this shape; ImageError for anything else."""
    array = np.asarray(values)
    if array.dtype != bool or array.shape != shape:
        raise ImageError(
            f"image: 'mask' must be True and False of the shape {shape} of 'power', got {array.dtype} of shape "
            f"{array.shape}. Give True for pixels to leave out."
        )
    view = array.view()
    view.flags.writeable = False
    return view


def _plane(name: str, values: ArrayLike) -> NDArray[np.floating]:
    """`values` as a read-only array (h, w) of at least 32-bit floats; ImageError if shape, type or a value is wrong."""
    array = np.asarray(values)
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
    view = array.astype(np.result_type(array.dtype, np.float32), copy=False).view()
    view.flags.writeable = False
    return view
