"""Arrays in TIFF, FITS and NPY files of other programs: frames of counts, maps of pixels."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import LONGEST_TEXT, BackendError, ImageError, one_line
from .tiff_pages import read_tiff, tell_left_out

LOG = logging.getLogger("mitsuba_fspt")
TIFF, FITS = (".tif", ".tiff"), (".fits", ".fit", ".fts")
UM_PER_MM = 1e3


def read_frame(path: Path, thing: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Array of a .tif, .fits or .npy file as it is stored, row 0 at the top, and what a FITS header states.

    The header's entries are `exposure_time` [s], `binning` and `pixel_pitch` [mm], as far as it has them.

    thing : what the file is, for messages, such as "counts 'a.tif'"

    Raises
    ------
    ImageError : the file cannot be read, or its suffix is none of these.
    BackendError : tifffile or astropy, which read TIFF and FITS, is not installed.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF:
        return read_tiff(path, thing), {}
    if suffix in FITS:
        return _fits(path, thing)
    if suffix != ".npy":
        raise ImageError(f"{thing}: '{suffix}' is not read. Give .tif, .fits or .npy.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's of an odd header, which it reads or refuses
            return np.load(path, allow_pickle=False), {}
    except Exception as cause:  # whatever a damaged file makes NumPy raise
        raise ImageError(f"{thing}: no NPY file of numbers: {one_line(cause, LONGEST_TEXT)}. Save it again.") from cause


def _fits(path: Path, thing: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Data of the first image of a FITS file, of two axes or more, row 0 at the top, and what its header states; others
    are told.

    EXPTIME or EXPOSURE in s, XBINNING, and XPIXSZ, the side of a binned pixel in µm, as imaging programs write them.
    """
    try:
        from astropy.io import fits
    except ImportError as cause:
        raise BackendError(f"{thing}: astropy is missing. pip install 'mitsuba-fspt[reduce]'.") from cause
    try:
        with warnings.catch_warnings(record=True) as reports, fits.open(path, memmap=False) as file:
            warnings.simplefilter("always")
            units = [unit for unit in file if unit.is_image and unit.header.get("NAXIS", 0) >= 2]
            if not units:
                raise ValueError("it holds no image")
            unit = units[0]
            keys = ("EXPTIME", "EXPOSURE", "XBINNING", "YBINNING", "ROWORDER", "XPIXSZ", "YPIXSZ")
            time, other, sides, rows, order, wide, high = (
                unit.header.get(key, file[0].header.get(key)) for key in keys
            )
            time = other if time is None else time
            data = np.asarray(unit.data)
            found: dict[str, Any] = {} if time is None else {"exposure_time": float(time)}
            found |= {} if sides is None else {"binning": int(sides)}
            found |= {} if wide is None or high not in (None, wide) else {"pixel_pitch": float(wide) / UM_PER_MM}
    except Exception as cause:
        raise ImageError(
            f"{thing}: no readable FITS file: {one_line(cause, LONGEST_TEXT)}. Copy the file again."
        ) from cause
    texts = [one_line(report.message, LONGEST_TEXT) for report in reports]
    for text in texts:
        if "truncated" in text:  # astropy returns what there is
            raise ImageError(f"{thing}: an incomplete FITS file: {text}. Copy the file again.")
    if texts:
        LOG.warning("fspt: %s: astropy reports: %s. Check the image.", thing, texts[0])
    if len(units) > 1:
        names = ", ".join(unit.name or "without a name" for unit in units)
        tell_left_out(thing, f"{len(units)} images ({names})")
    if None not in (sides, rows) and sides != rows:
        raise ImageError(f"{thing}: binned {sides} x {rows}. Give a frame of square binning.")
    if str(order).strip().upper() == "BOTTOM-UP" and data.ndim > 1:
        data = np.flip(data, axis=-2)
    return data, found
