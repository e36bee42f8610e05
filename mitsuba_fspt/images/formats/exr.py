"""OpenEXR: 32-bit float channels `Y` and `NAME.Y` of further planes, such as `error.Y`; metadata under `fspt:`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ...runtime.errors import ImageError
from . import BESIDE, Format, Metadata, Planes

PREFIX = "fspt:"
VALUES = "Y"  # channel of the power, or of the electrons
STREAM_BUFFER = 1 << 16  # bytes, more than any C++ library buffers
_mute = Lock()  # the process has one standard output and one standard error: one thread at a time mutes them


class Exr(Format):
    """Zip compression, row 0 at the top.

    The metadata key `f_number` becomes the attribute `fspt:f_number`: text a `string`, an integer an `int`, a float a
    `double` (EXR's `float` has 32 bits). An integer beyond 32 bits becomes a `double` of the same value.
    """

    kind = "OpenEXR file"

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """As `Format.write`; the plane that is none of `BESIDE` becomes the channel Y."""
        header = {PREFIX + key: _attribute(value) for key, value in metadata.items()}
        header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        pixels = {_channel(name): OpenEXR.Channel(values) for name, values in planes.items()}
        OpenEXR.File(header, pixels).write(str(path))
        if os.path.getsize(path) < STREAM_BUFFER:
            # So small a file stays in the stream's buffer until the close, which reports no failure: read it back.
            OpenEXR.File(str(path))

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """As `Format.read`, in the type stored in the file; Y is named by the metadata's `quantity`, else `power`.

        Of several parts the first is read. Attributes under `fspt:` that are neither text nor number are left out.
        """
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
        quantity = str(metadata.get("quantity", "power"))
        return {_plane(name, quantity): values for name, values in channels.items()}, metadata


def _channel(plane: str) -> str:
    return f"{plane}.{VALUES}" if plane in BESIDE else VALUES


def _plane(channel: str, quantity: str) -> str:
    """Name of the plane in a channel; channels of other programs keep their names."""
    return quantity if channel == VALUES else channel.removesuffix(f".{VALUES}")


def _attribute(value: str | int | float) -> str | int | NDArray[np.float64]:
    """`value` in a type that OpenEXR stores."""
    if isinstance(value, str) or (isinstance(value, int) and abs(value) < 2**31):
        return value
    return np.array([value], dtype=np.float64)


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
