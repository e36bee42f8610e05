"""OpenEXR files: 32-bit float channels by name, and metadata as header attributes under `fspt:`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from numbers import Integral, Real
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..runtime.atomic_files import atomic_path
from ..runtime.errors import ImageError

Metadata = dict[str, str | int | float]

PREFIX = "fspt:"
STREAM_BUFFER = 1 << 16  # bytes, more than any C++ library buffers
_mute = Lock()  # the process has one standard output and one standard error: one thread at a time mutes them


def write_exr(
    path: str | os.PathLike[str], channels: Mapping[str, NDArray], metadata: Mapping[str, str | int | float]
) -> None:
    """Write `channels`, all of one shape (h, w), and `metadata` to an EXR file, completely or not at all.

    Channels become 32-bit floats (zip compression, row 0 at the top); a value beyond float32 is refused, one too
    small for it becomes 0. The metadata key `f_number` becomes the attribute `fspt:f_number`: text a `string`, an
    integer an `int`, a float a `double` (EXR's `float` has 32 bits). An integer beyond 32 bits becomes a `double` of
    the same value.

    Raises
    ------
    ImageError : the suffix is not .exr, a value cannot be stored, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".exr":
        raise ImageError(f"image file '{path}': images are written as OpenEXR. Give a name that ends in .exr.")
    header = {PREFIX + key: _attribute(key, value) for key, value in metadata.items()}
    header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: OpenEXR.Channel(_float32(name, values)) for name, values in channels.items()}
    with atomic_path(path, ImageError) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
            if os.path.getsize(temporary) < STREAM_BUFFER:
                # Such a file stays in the stream's buffer until the close, which reports no failure: read it back.
                OpenEXR.File(str(temporary))
        except (RuntimeError, ValueError) as cause:
            reason = _one_line(cause).replace(str(temporary), str(path)).rstrip(".")
            raise ImageError(f"image file '{path}': {reason}. Make room or give another place for it.") from cause


def read_exr(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray], Metadata]:
    """Channels by name, each of shape (h, w) and the type stored in the file, and the metadata under `fspt:`.

    Of several parts the first is read. Attributes under `fspt:` that are neither text nor number are left out.

    Raises
    ------
    ImageError : the file does not exist, is no OpenEXR file, is damaged or holds no pixels.
    """
    path = Path(path)
    if not os.path.isfile(path):
        wrong = "is a folder" if os.path.isdir(path) else "does not exist"
        raise ImageError(f"image file '{path}' {wrong}. Give the path of an EXR file.")
    if not OpenEXR.isOpenExrFile(str(path)):
        raise ImageError(f"image file '{path}' is no readable OpenEXR file. Give an EXR file.")
    try:
        with _muted():
            file = OpenEXR.File(str(path), separate_channels=True)
            channels = {name: channel.pixels for name, channel in file.channels().items()}
            header = file.header()
    except (RuntimeError, ValueError, MemoryError) as cause:
        raise ImageError(f"image file '{path}' is damaged or incomplete. Write or copy it again.") from cause
    metadata: Metadata = {}
    for key, value in header.items():
        if key.startswith(PREFIX):
            if isinstance(value, np.ndarray) and value.shape == (1,):
                value = float(value[0])  # OpenEXR returns a double as an array of one
            if isinstance(value, (str, int, float)):
                metadata[key.removeprefix(PREFIX)] = value
    return channels, metadata


def _attribute(key: str, value: object) -> str | int | NDArray[np.float64]:
    """`value` in a type that OpenEXR stores; ImageError for any other value."""
    if isinstance(value, str):
        return value
    if isinstance(value, Integral):
        integer = int(value)
        if abs(integer) < 2**31:
            return integer
        if abs(integer) <= 2**53:
            return np.array([integer], dtype=np.float64)
        raise ImageError(f"image metadata '{key}' = {integer} is too large to be stored. Keep it below 2^53.")
    if isinstance(value, Real):
        return np.array([value], dtype=np.float64)
    raise ImageError(
        f"image metadata '{key}' must be text or a number, got {type(value).__name__}. Convert or drop it."
    )


def _float32(name: str, values: NDArray) -> NDArray[np.float32]:
    """`values` as contiguous float32; ImageError if one is not finite or too large."""
    limit = float(np.finfo(np.float32).max)
    # Whole planes of temporaries only on failure: a large picture hardly fits. NaN is neither larger nor smaller.
    if not (values.min() >= -limit and values.max() <= limit):
        unfit = ~(np.abs(values) <= limit)
        row, column = np.argwhere(unfit)[0]
        raise ImageError(
            f"image channel '{name}' is {values[row, column]:g} at row {row}, column {column}; the file "
            f"holds finite values up to {limit:.3g}. Scale the exitance down."
        )
    return np.ascontiguousarray(values, dtype=np.float32)


def _one_line(cause: BaseException) -> str:
    return " ".join(str(cause).split())


@contextmanager
def _muted() -> Iterator[None]:
    """Context manager that discards OpenEXR's output about a damaged file, for which it raises an exception as well.

    Its Python part prints to `sys.stdout`; its C part bypasses `sys.stderr`, so that the whole process has no
    standard error during the block. One thread at a time: two would restore each other's muted streams.
    """
    with _mute, redirect_stdout(StringIO()):
        try:
            stderr = os.dup(2)
        except OSError:  # standard error is closed already
            yield
            return
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
