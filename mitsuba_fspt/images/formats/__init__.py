"""Formats of image files: float32 planes with metadata. Each Python file here has one format, found by its suffix.

A format is a subclass of `Format` that is named like its Python file: `Exr` in exr.py reads and writes .exr. The first
plane is `power` or `electrons`, further planes are those of `BESIDE`. Row 0 is the top in every format.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...runtime.atomic_files import atomic_path, file_path
from ...runtime.by_name import class_named, names_in
from ...runtime.errors import FsptError, ImageError
from ...runtime.extras import require

Metadata = dict[str, str | int | float]
Planes = dict[str, NDArray[np.float32]]

BESIDE = ("error", "coverage", "mask", "flat", "flat_error", "dark_noise")  # planes beside that of the values
OWN_UNIT = {"coverage": "1", "mask": "1", "flat": "1", "flat_error": "1", "dark_noise": "e-"}  # whatever the values' is
ALIASES = {"tiff": "tif"}


class Format:
    """Base class of the formats of image files.

    kind : name of the kind of file, for messages
    package : import name of the optional package that reads and writes it; None if none is needed
    """

    kind: ClassVar[str]
    package: ClassVar[str | None] = None

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """Write planes, shape (h, w), and metadata to the file `path`, which may be overwritten."""
        raise NotImplementedError

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """Planes by name, shape (h, w), and metadata of an existing file.

        The caller takes any exception other than an FsptError as the sign of a damaged file or of another program's
        file.
        """
        raise NotImplementedError


def suffixes() -> tuple[str, ...]:
    """Suffixes of all formats, without alternative spellings such as .tiff."""
    return tuple(f".{name}" for name in names_in(sys.modules[__name__]))


def format_of(path: str | os.PathLike[str]) -> type[Format]:
    """Format of a file by its suffix.

    Raises
    ------
    ImageError : the suffix is that of no format.
    BackendError : the format needs a package that is not installed.
    """
    name = Path(path).suffix.lower().removeprefix(".")
    try:
        found: type[Format] = class_named(sys.modules[__name__], ALIASES.get(name, name))
    except KeyError:
        raise ImageError(
            f"image file '{path}' must end in {', '.join(suffixes()[:-1])} or {suffixes()[-1]}. Give a name such as "
            "image.exr."
        ) from None
    if found.package:
        require(found.package, f"image file '{path}'")
    return found


def write_planes(
    path: str | os.PathLike[str], planes: Mapping[str, NDArray], metadata: Mapping[str, str | int | float]
) -> None:
    """Write planes, all of the same shape (h, w), as 32-bit floats with metadata, completely or not at all.

    A value too large for float32 is refused; one too small for it becomes 0.

    Raises
    ------
    ImageError : no format has the suffix, a value cannot be stored, or the file cannot be written.
    BackendError : the format needs a package that is not installed.
    """
    path = file_path("image file", path, ImageError, "image.exr")
    kind = format_of(path)
    stored = {key: _plain(key, value) for key, value in metadata.items()}
    floats = {name: _float32(name, values) for name, values in planes.items()}
    with atomic_path(path, ImageError) as temporary:
        try:
            kind.write(temporary, floats, stored)
        except ImageError:  # of the metadata
            raise
        except (RuntimeError, ValueError) as cause:
            reason = " ".join(str(cause).split()).replace(str(temporary), str(path)).rstrip(".")
            raise ImageError(f"image file '{path}': {reason}. Make room or give another place for it.") from cause


def read_planes(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray], Metadata]:
    """Planes by name, each of shape (h, w), and metadata of a file.

    Raises
    ------
    ImageError : no format has the suffix, the file does not exist, is damaged or that of another program.
    BackendError : the format needs a package that is not installed.
    """
    path = file_path("image file", path, ImageError, "image.exr")
    if not os.path.isfile(path):
        wrong = "is a folder" if os.path.isdir(path) else "does not exist"
        raise ImageError(f"image file '{path}' {wrong}. Give the path of an image that fspt wrote.")
    kind = format_of(path)
    try:
        return kind.read(path)
    except FsptError:
        raise
    except Exception as cause:  # whatever a damaged file makes the libraries raise
        raise ImageError(
            f"image file '{path}' is damaged, or no {kind.kind} of an image that fspt wrote. Write or copy it again."
        ) from cause


def units(planes: Mapping[str, object], metadata: Metadata) -> dict[str, str]:
    """Unit of each plane: that of the metadata, W or e-, but for those that have one of their own, '1' for none."""
    return {name: OWN_UNIT.get(name, str(metadata.get("unit", "W"))) for name in planes}


def _plain(key: str, value: object) -> str | int | float:
    """`value` as text, int or float; ImageError for anything else, and for an integer that no double holds."""
    if isinstance(value, str):
        return value
    if isinstance(value, Integral):
        integer = int(value)
        if abs(integer) > 2**53:
            raise ImageError(f"image metadata '{key}' = {integer} is too large to be stored. Keep it below 2^53.")
        return integer
    if isinstance(value, Real):
        return float(value)
    raise ImageError(
        f"image metadata '{key}' must be text or a number, got {type(value).__name__}. Convert or drop it."
    )


def _float32(name: str, values: NDArray) -> NDArray[np.float32]:
    """`values` as contiguous float32; ImageError if one is not finite or too large."""
    limit = float(np.finfo(np.float32).max)
    # Temporary arrays of the size of a plane only on failure, to save memory. The comparisons are False for NaN, too.
    if not (values.min() >= -limit and values.max() <= limit):
        unfit = ~(np.abs(values) <= limit)
        row, column = np.argwhere(unfit)[0]
        raise ImageError(
            f"image: '{name}' is {values[row, column]:g} at row {row}, column {column}; the file "
            f"holds finite values up to {limit:.3g}. Scale the exitance down."
        )
    return np.ascontiguousarray(values, dtype=np.float32)
