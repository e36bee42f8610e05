"""Arrays in TIFF, FITS and NPY files of other programs: frames of counts, maps of pixels."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import LONGEST_TEXT, BackendError, ImageError, one_line
from .formats.fits import BOTTOM_UP, ROW_ORDER, TOP_DOWN
from .tiff_pages import read_oriented, tell_left_out

LOG = logging.getLogger("mitsuba_fspt")
TIFF, FITS = (".tif", ".tiff"), (".fits", ".fit", ".fts")
UM_PER_MM = 1e3
UNIT = "BUNIT"
# Of FITS headers: numbers, each with its rule for messages and whether a value keeps it; and texts.
NUMBERS: dict[str, tuple[str, Callable[[float], bool]]] = {
    **dict.fromkeys(("EXPTIME", "EXPOSURE"), ("number >= 0 of seconds", lambda v: v >= 0)),
    **dict.fromkeys(("XBINNING", "YBINNING"), ("whole number >= 1", lambda v: v >= 1 and v == int(v))),
    **dict.fromkeys(("XPIXSZ", "YPIXSZ"), ("number > 0 of um", lambda v: v > 0)),
    "EGAIN": ("number > 0 of electrons per DN", lambda v: v > 0),
}
KEYWORDS = (*NUMBERS, ROW_ORDER, UNIT)
SAME_PITCH = 1e-3  # relative difference of pixel pitches that rounding in files may cause
FIRST, LAST, TURNED, UNTAGGED = "first", "last", "turned", "untagged"  # which row of a file is the top one


def read_frame(path: Path, thing: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Array of a .tif, .fits or .npy file as it is stored, row 0 at the top, and what a FITS header states.

    The header's entries are `exposure_time` [s], `gain` [e-/DN], `binning`, `pixel_pitch` [mm], or of pixels that are
    not square `pixel_sides`, width and height [mm], and `unit` of the values, as far as it has them, and `top_row`, the
    row of the file that is the top one: 'first' or 'last', None if the header does not say it. Of a TIFF it is as of
    `tiff_row`.

    thing : what the file is, for messages, such as "counts 'a.tif'"

    Raises
    ------
    ImageError : the file cannot be read, or its suffix is none of these.
    BackendError : tifffile or astropy, which read TIFF and FITS, is not installed.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF:
        images, orientation = read_oriented(path, thing)
        return images, {"top_row": tiff_row(orientation)}
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


def tell_open_rows(thing: str, top_row: str | None, where: str = "in its header") -> None:
    """Say in one line on stderr that a FITS file, the `thing`, does not state which of its rows is the top one.

    where : headers in which the user states it
    """
    if top_row is None:
        LOG.warning(
            "fspt: %s has no ROWORDER of TOP-DOWN or BOTTOM-UP; its first row is taken for the top one. If the image "
            "is upside down, set ROWORDER = %s %s.",
            thing,
            BOTTOM_UP,
            where,
        )


def _fits(path: Path, thing: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Data of the first image of a FITS file, of two axes or more, row 0 at the top, and what its header states; others
    are told.

    EXPTIME or EXPOSURE in s, EGAIN, XBINNING, and XPIXSZ, the side of a binned pixel in µm, as imaging programs write
    them.
    `top_row` is None where no ROWORDER says which row is the top one; the first is taken then. Pixels of integers that
    are BLANK become NaN.
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
            header = {key: unit.header.get(key, file[0].header.get(key)) for key in KEYWORDS}
            blank = unit.header.get("BLANK")
            if type(blank) is int:  # of other types astropy says that it ignores them
                blank = blank * unit.header.get("BSCALE", 1) + unit.header.get("BZERO", 0)
            else:
                blank = None
            data = np.asarray(unit.data)
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
    if blank is not None and data.dtype.kind in "iu" and (empty := data == blank).any():
        data = np.where(empty, np.nan, data)
    found = _stated(header, thing)
    if found["top_row"] == LAST:
        LOG.warning(
            "fspt: %s: its first row is the lowest one (ROWORDER = %s); it is turned. Turn frames without a header, "
            "such as arrays and .npy, likewise.",
            thing,
            BOTTOM_UP,
        )
        data = np.flip(data, axis=-2)
    return data, found


def _stated(header: dict[str, Any], thing: str) -> dict[str, Any]:
    """What the `KEYWORDS` of a FITS header state; one line on stderr says of each that should be a number and is not.

    Raises ImageError for a binning that is not square.
    """
    numbers = {key: _number(header[key], key, thing) for key in NUMBERS}
    columns, rows, wide, high = (numbers[key] for key in ("XBINNING", "YBINNING", "XPIXSZ", "YPIXSZ"))
    if columns and rows and columns != rows:
        raise ImageError(f"{thing}: binned {columns:g} x {rows:g}. Give a frame of square binning.")
    sides, pitch = columns or rows, wide or high
    order = str(header[ROW_ORDER]).strip().upper()
    found: dict[str, Any] = {"top_row": {TOP_DOWN: FIRST, BOTTOM_UP: LAST}.get(order)}
    time = numbers["EXPOSURE"] if numbers["EXPTIME"] is None else numbers["EXPTIME"]
    found |= {} if time is None else {"exposure_time": time}
    found |= {} if numbers["EGAIN"] is None else {"gain": numbers["EGAIN"]}
    found |= {} if sides is None else {"binning": int(sides)}
    found |= {} if header[UNIT] is None else {"unit": str(header[UNIT]).strip()}
    if wide and high and abs(wide - high) > SAME_PITCH * high:
        return found | {"pixel_sides": (wide / UM_PER_MM, high / UM_PER_MM)}
    return found | ({} if pitch is None else {"pixel_pitch": pitch / UM_PER_MM})


def tiff_row(orientation: int | None) -> str:
    """`top_row` of a TIFF: 'first' of Orientation 1, 'turned' of others, 'untagged', taken for the first, of none."""
    if orientation is None:
        return UNTAGGED
    return FIRST if orientation == 1 else TURNED


def shown_sides(sides: tuple[float, float]) -> str:
    """Width and height [mm] of pixels that are not square, for messages."""
    return f"{sides[0]:g} x {sides[1]:g} mm"


def _number(value: object, key: str, thing: str) -> float | None:
    """The value of a keyword of `NUMBERS`; None for one that is missing or, which is told, none of its rule."""
    if value is None:
        return None
    rule, holds = NUMBERS[key]
    try:
        found = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]  # a text may be a number
    except (TypeError, ValueError):
        found = math.nan
    if math.isfinite(found) and holds(found):
        return found
    text = one_line(repr(value), LONGEST_TEXT)
    LOG.warning("fspt: %s: %s = %s is no %s; it is left out. Correct it, or give the number.", thing, key, text, rule)
    return None
