"""One read-out of a detector: electrons and counts of every pixel, and their files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..runtime.atomic_files import atomic_path, file_path
from ..runtime.errors import BackendError, DetectorError, ImageError
from .electrons import Electrons
from .formats import Metadata, write_planes
from .pixel_map import recorded
from .recorded_number import recorded_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Exposure(Electrons):
    """One read-out of a detector.

    Attributes
    ----------
    electrons : float32 array, shape (h, w) [e-], before the conversion to counts, after the multiplying register of an
        EMCCD; at low light, read noise can make them negative
    counts : uint16 array, shape (h, w) [DN]
    metadata : those of the image and the detector's parameters; `quantity` is electrons, `unit` e-. A parameter that
        a map gives has the mean there, and path and digest of the map in NAME_map and NAME_map_digest
    """

    def plot(self, axes: Axes | None = None, *, log: bool = False, limits: tuple[float, float] | None = None) -> Axes:
        """Draw the electrons with colour bar and axes in mm; returns matplotlib's axes. See `Image.plot`."""
        from .picture import plot_image

        return plot_image(self, axes, log=log, limits=limits)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the electrons and the metadata; the suffix chooses the format, in an EXR the channel is `Y`.

        Raises ImageError and BackendError as `Image.write`.
        """
        write_planes(path, {"electrons": self.electrons}, self.metadata)

    def write_counts(self, path: str | os.PathLike[str]) -> None:
        """Write the counts, unscaled, to a 16-bit greyscale PNG or TIFF; metadata as JSON in its description.

        Raises
        ------
        ImageError : the suffix is neither .png nor .tif(f), or the file cannot be written.
        BackendError : Pillow is not installed.
        """
        with self.counts_file(path):
            pass

    @contextmanager
    def counts_file(self, path: str | os.PathLike[str]) -> Iterator[None]:
        """Context manager that writes the file of `write_counts` before its block and renames it to `path` after it.

        An exception in the block leaves `path` unchanged. Raises as `write_counts`.
        """
        path = file_path("counts file", path, ImageError, "counts.tif")
        if path.suffix.lower() not in (".png", ".tif", ".tiff"):
            raise ImageError(f"counts file '{path}': counts are written as PNG or TIFF. Give a .png or .tif.")
        try:
            from PIL import Image as Picture
            from PIL.PngImagePlugin import PngInfo
        except ImportError as cause:
            raise BackendError(
                "detector: Pillow, which writes counts, is not installed. pip install 'mitsuba-fspt[plot]'."
            ) from cause
        description = json.dumps(self.metadata | {"quantity": "counts", "unit": "DN"})
        picture = Picture.fromarray(self.counts)
        with atomic_path(path, ImageError) as temporary:
            if path.suffix.lower() == ".png":
                text = PngInfo()
                text.add_text("Description", description)
                picture.save(temporary, pnginfo=text)
            else:
                picture.save(temporary, description=description)
            yield


def exposure_of(path: str | os.PathLike[str], planes: Mapping[str, NDArray], metadata: Metadata) -> Exposure:
    """Exposure of the electrons and metadata in a file, whose counts follow from the detector.

    Raises
    ------
    ImageError : values that are not finite.
    DetectorError : the metadata lack a number of the detector, or its map has changed.
    """
    electrons = planes["electrons"].astype(np.float32)
    if not np.isfinite(electrons).all():
        raise ImageError(f"image file '{path}' has electrons that are NaN or inf. Expose it again.")
    if missing := [name for name in ("gain", "bias", "bits") if name not in metadata]:
        raise DetectorError(
            f"'{path}': the electrons come without '{missing[0]}'. Reduce the counts with 'fspt reduce'."
        )
    gain, bias = (recorded(metadata, name, electrons.shape) for name in ("gain", "bias"))
    if not np.all(gain > 0):
        raise DetectorError(f"'{path}': its gain must be > 0 e-/DN, it is {np.min(gain):g}. Expose the image again.")
    with np.errstate(over="ignore"):  # beyond the converter's range
        counts = np.rint(bias + electrons / np.float64(gain))
    bits = recorded_number(metadata, "bits", 16, f"'{path}'", DetectorError)
    top = 2 ** int(np.clip(bits, 1, 16)) - 1
    return Exposure(electrons, np.clip(counts, 0, top).astype(np.uint16), metadata)
