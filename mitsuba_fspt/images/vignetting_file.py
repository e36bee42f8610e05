"""Files of the vignetting of a lens: a CSV of image height [mm] and share, or an image of the film's shape."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..optics.curve_file import read_rows
from ..optics.vignetting import DIGEST, VIGNETTING, Vignetting
from ..runtime.errors import BackendError, FsptError, OpticsError
from .formats import Metadata, read_planes
from .frame_file import FIRST, read_frame, tell_open_rows
from .pixel_axes import CROP
from .recorded_number import recorded_number

DIGITS = 16  # of a digest
FRAMES = (".tif", ".tiff", ".fits", ".fit", ".fts", ".npy")  # of other programs, without planes
CURVES = (".csv", ".txt")


def read_vignetting(path: str | os.PathLike[str]) -> Vignetting:
    """Vignetting of a file: .csv is a curve, all else an image, with its plane `vignetting`, else its first one.

    Raises
    ------
    OpticsError : the file cannot be read, or its shares cannot be used, see `Vignetting`.
    BackendError : a package that reads the file is not installed.
    """
    path = Path(path).absolute()
    if not path.is_file():
        raise OpticsError(f"'{VIGNETTING}' = '{path}' is no file. Give a CSV of mm,share or an image of the film.")
    if path.suffix.lower() in CURVES:
        heights, shares = read_rows(path, VIGNETTING, OpticsError, "mm, share", "9.5,0.83")
        metadata: Metadata = {}
    else:
        heights, (shares, metadata) = None, _plane(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]
    return Vignetting(str(path), digest, heights, shares, _crop(metadata, path))


def recorded_vignetting(metadata: Mapping[str, Any]) -> Vignetting | None:
    """Vignetting in the metadata of an image, whose file is read again; None without one.

    Raises OpticsError where the file is missing or has changed since.
    """
    if VIGNETTING not in metadata:
        return None
    found = read_vignetting(str(metadata[VIGNETTING]))
    if found.digest != metadata.get(DIGEST):
        raise OpticsError(
            f"'{VIGNETTING}' = '{found.file}' is not the file that the image was made with, its digest is "
            f"{found.digest}, not {metadata.get(DIGEST)}. Restore it, or make the image again."
        )
    return found


def _crop(metadata: Metadata, path: Path) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Size of the film and first pixel of the crop window of an image with these metadata; None without one."""
    if not all(name in metadata for name in CROP):
        return None
    thing = f"'{VIGNETTING}' = '{path}'"
    width, height, left, top = (round(recorded_number(metadata, name, 0.0, thing, OpticsError)) for name in CROP)
    return (width, height), (left, top)


def _plane(path: Path) -> tuple[np.ndarray[Any, np.dtype[np.float64]], Metadata]:
    """Values of an image file (h, w), and its metadata."""
    metadata: Metadata = {}
    named = f"'{VIGNETTING}' = '{path}'"
    try:
        values, header = read_frame(path, named) if path.suffix.lower() in FRAMES else (None, {})
        if values is None or (values.ndim > 2 and path.suffix.lower() != ".npy"):
            planes, metadata = read_planes(path)
            values = planes.get(VIGNETTING, next(iter(planes.values())))
        else:
            tell_open_rows(named, header.get("top_row", FIRST))
    except BackendError:
        raise
    except FsptError as cause:
        raise OpticsError(str(cause) if str(cause).startswith(named) else f"{named}: {cause}") from cause
    if values.dtype.kind not in "uif":
        raise OpticsError(f"{named} must hold numbers, got {values.dtype}. Give shares in (0, 1].")
    return np.asarray(values, np.float64), metadata
