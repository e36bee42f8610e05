"""Map of a detector: a parameter's value on every pixel, in a FITS, TIFF or NPY file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import DetectorError, FsptError
from .frame_file import FIRST, read_frame
from .recorded_number import recorded_number

Array = NDArray[np.float64]
MAP, DIGEST = "_map", "_map_digest"  # ends of the metadata's keys beside that of a parameter, whose value is the mean
DIGITS = 16  # of a digest


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Values (h, w) of a parameter on the pixels read out, row 0 at the top.

    path : absolute name of the file;  digest : first digits of its SHA-256
    top_row : of its file, as of `read_frame`; None if it is a FITS file that does not state it
    """

    path: str
    digest: str
    values: Array
    top_row: str | None = FIRST

    @classmethod
    def read(cls, path: str | Path, thing: str) -> PixelMap:
        """Map of a file; `thing` is the parameter in messages, such as "detector: 'read_noise'".

        Raises
        ------
        DetectorError : the file cannot be read, is no plane of numbers, or has NaN or infinite values.
        BackendError : a package that reads the file is not installed.
        """
        path = Path(path).absolute()
        named = f"{thing} = '{path}'"
        if not path.is_file():
            raise DetectorError(f"{named} does not exist. Give a number, or the name of a .tif, .fits or .npy file.")
        try:
            array, header = read_frame(path, named)
        except ImportError:
            raise
        except FsptError as cause:
            raise DetectorError(str(cause)) from cause
        if array.dtype.kind not in "uif" or array.ndim != 2 or array.size == 0:
            raise DetectorError(
                f"{named} must be numbers of shape (h, w), got {array.dtype} of shape {array.shape}. Give one plane."
            )
        values = array.astype(np.float64)
        if not np.isfinite(values).all():
            raise DetectorError(
                f"{named} has {int(np.sum(~np.isfinite(values)))} values that are NaN or infinite. Replace them, and "
                "mask such pixels by 'bad_pixels'."
            )
        values.flags.writeable = False
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]
        return cls(str(path), digest, values, header.get("top_row", FIRST))

    def on(self, shape: tuple[int, ...], thing: str) -> Array:
        """The values, if they are of this shape (h, w); else DetectorError."""
        if self.values.shape != shape:
            height, width = self.values.shape
            raise DetectorError(
                f"{thing} = '{self.path}' has {width} × {height} pixels, the pixels read out are {shape[1]} × "
                f"{shape[0]}. Give a map of the same pixels."
            )
        return self.values

    def recorded(self, name: str) -> dict[str, str]:
        """Entries of the metadata of an exposure: path and digest of the map of a parameter."""
        return {name + MAP: self.path, name + DIGEST: self.digest}


def recorded(metadata: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> float | Array:
    """A parameter in the metadata of an exposure of this shape (h, w): its number, or its map, which is read again.

    Raises
    ------
    DetectorError : the number is none, or the map cannot be read, has another shape, or has changed since.
    """
    if (found := recorded_map(metadata, name)) is not None:
        return found.on(shape, f"detector: '{name}'")
    return recorded_number(metadata, name, math.nan, "detector: the exposure", DetectorError)


def recorded_map(metadata: Mapping[str, Any], name: str) -> PixelMap | None:
    """Map of a parameter in the metadata of an exposure, or None; DetectorError if it is missing or has changed."""
    if name + MAP not in metadata:
        return None
    found = PixelMap.read(str(metadata[name + MAP]), f"detector: '{name}'")
    if found.digest != metadata.get(name + DIGEST):
        raise DetectorError(
            f"detector: '{name}' = '{found.path}' is not the map that the exposure was made with, its digest is "
            f"{found.digest}, not {metadata.get(name + DIGEST)}. Restore that file, or reduce the counts."
        )
    return found
