"""Files of raw counts [DN]: TIFF with one or several frames, FITS, NPY, and click folders of IVIS cameras."""

from __future__ import annotations

import logging
import math
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..images.exposure import Exposure
from ..images.formats import read_planes
from ..images.frame_file import (
    FIRST,
    FITS,
    LAST,
    SAME_PITCH,
    TIFF,
    TURNED,
    UNTAGGED,
    read_frame,
    shown_sides,
    tell_open_rows,
    tiff_row,
)
from ..images.image import Image
from ..images.tiff_pages import channels_of, read_oriented
from ..runtime.errors import BackendError, DetectorError, ImageError
from ..runtime.numbers import require_unmasked, whole

Frame = ArrayLike | str | os.PathLike[str]
LOG = logging.getLogger("mitsuba_fspt")
# Of the means of frames over their pixels: range over their mean, over the noise of one of them, and in DN, above which
# frames have not the same light. Lamps drift by less; a wrong exposure time is a factor, mostly.
UNEQUAL, UNEQUAL_BY_NOISE, UNEQUAL_BY_DRIFT = 0.2, 10.0, 1.0
BRIGHT = 99.9  # percentile at which the pixels of a frame are cut off for its mean: cosmic rays are no light
DN = ("", "dn", "adu", "count", "counts", "ct")  # names of it in BUNIT
WRAPPED = -(2**14)  # DN of 16 bits with a sign: lower ones are no dark counts, but wrapped ones of 32768 … 49151
EMPTY = -(2**15)  # least number of 16 bits with a sign, by which programs mark pixels without a value
SAME_GAIN = 0.1  # relative difference of a gain by measurement from that of a data sheet
SAME_TIME = 0.01  # relative difference of exposure times that rounding in headers may cause
# Of a file's `top_row`: the keyword or tag, and words on files without it, and on those whose rows were turned by it.
SILENT: dict[str | None, tuple[str, str]] = {
    None: ("ROWORDER", "has no ROWORDER"),
    UNTAGGED: ("Orientation", "has no Orientation"),
}
TURNS: dict[str | None, tuple[str, str]] = {
    LAST: ("ROWORDER", "is BOTTOM-UP"),
    TURNED: ("Orientation", "was turned by its Orientation"),
}
CLICK, BIAS, BACKGROUND, INFO = "luminescent", "readbiasonly", "background", "clickinfo"
# Keys of ClickInfo.txt, the most specific first. A photograph and a bias frame have exposure times of their own.
EXPOSURE = tuple(
    re.compile(text, re.IGNORECASE)
    for text in (
        r"^luminescent exposure.*sec",
        r"^luminescent exposure(?!.*unit)",
        r"^(?!photo|background|bias).*exposure(?!.*unit)",
    )
)
BINNING = (re.compile(r"^binning", re.IGNORECASE),)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class Counts:
    """Raw counts (h, w) [DN], the mean of `frames` frames, with what the file states about them.

    highest : (h, w) the largest count of the frames, None for a single one
    first : (h, w) the first of the frames, None for a single one
    levels : (frames,) mean [DN] over the pixels of each frame, the brightest of them cut off; None for a single one
    raw : True for unsigned integers, as a camera delivers them; False for floats and integers with a sign
    bias, background : frames (h, w) [DN] of a click folder, or None
    exposure_time : [s], None if the file does not state it
    gain : [e-/DN], None if the file does not state it
    binning : side of the square of pixels read out as one, None if the file does not state it
    pixel_pitch : of the pixels read out [mm], None if the file does not state it
    pixel_sides : their width and height [mm], if the file states that they are not square; else None
    top_row : of the file, as of `read_frame`; None if it is a FITS file that does not state it
    unit : of the values by the file, None if it does not state it
    info : `Key: value` lines of a click folder, those of the luminescent image first
    """

    values: NDArray[np.float64]
    frames: int = 1
    bias: NDArray[np.float64] | None = None
    background: NDArray[np.float64] | None = None
    exposure_time: float | None = None
    info: dict[str, str] = field(default_factory=dict)
    highest: NDArray[np.float64] | None = None
    binning: int | None = None
    first: NDArray[np.float64] | None = None
    raw: bool = False
    pixel_pitch: float | None = None
    levels: NDArray[np.float64] | None = None
    top_row: str | None = FIRST
    unit: str | None = None
    pixel_sides: tuple[float, float] | None = None
    gain: float | None = None


def frame_of(given: Frame | Counts, name: str, frames: int | None = None) -> Counts:
    """Counts of a file, of an array, the argument `name`, or as they are; `frames` as of `counts_of`."""
    if isinstance(given, Counts):
        return given
    if isinstance(given, (str, os.PathLike)):
        return read_counts(given, frames)
    return counts_of(given, name, frames)


def frame_like(given: Frame | Counts, name: str, shape: tuple[int, ...]) -> Counts:
    """Counts as of `frame_of`; DetectorError unless their shape (h, w) is `shape`."""
    found = frame_of(given, name)
    if found.values.shape != shape:
        raise DetectorError(
            f"reduce: '{name}' has the shape {found.values.shape}, the counts {shape}. Give a frame of the same film."
        )
    return found


def tell_stated(
    counts: Counts, time: float, gain: float | None, binning: int | None, pitch: float | None, own: float | None
) -> None:
    """Say in one line each on stderr what the file of the counts states otherwise than the numbers that are used.

    time : exposure time [s];  gain : [e-/DN], None where it does not count;  binning : None for 1, which nothing states
    pitch, own : of the pixels read out and of the detector's own pixels [mm], or None

    Raises ImageError where only the file states the sides of the pixels, and they are not square.
    """
    side = own * (binning or 1) if pitch is None and own is not None else pitch
    for name, used, stated, unit, same in (
        ("exposure_time", time, counts.exposure_time, " s", SAME_TIME),
        ("gain", gain, counts.gain, " e-/DN", SAME_GAIN),
        ("binning", binning, counts.binning, "", 0.0),
        ("pixel_pitch", side, counts.pixel_pitch, " mm", SAME_PITCH),
    ):
        if used is not None and stated is not None and abs(stated - used) > same * used:
            LOG.warning(
                "fspt: reduce: '%s' is %g%s, the file of the counts states %g%s. The former is used.",
                *(name, used, unit, stated, unit),
            )
    if counts.pixel_sides is not None:
        _tell_sides(counts.pixel_sides, side)
    if pitch and own and binning and abs(pitch - own * binning) > SAME_PITCH * own * binning:
        LOG.warning(
            "fspt: reduce: 'pixel_pitch' is %g mm, that of the detector times the binning of %d is %g mm. The dark "
            "current is that of the former, %.3g of the detector's pixels.",
            *(pitch, binning, own * binning, (pitch / own) ** 2),
        )
    _tell_unit(counts)
    tell_open_rows("reduce: the FITS file of the counts", counts.top_row, "in all frames of this camera")


def _tell_sides(sides: tuple[float, float], pitch: float | None) -> None:
    """Say in one line on stderr that the file states pixels of these `sides`; ImageError without a `pitch` [mm]."""
    if pitch is None:
        raise ImageError(
            f"reduce: the file of the counts states pixels of {shown_sides(sides)}. Give a frame of square pixels, or "
            "'pixel_pitch' if the file is wrong."
        )
    LOG.warning(
        "fspt: reduce: 'pixel_pitch' is %g mm, the file of the counts states %s. The former is used.",
        *(pitch, shown_sides(sides)),
    )


def _tell_unit(counts: Counts) -> None:
    """Say in one line on stderr that the values are taken for DN where the file states another unit."""
    if counts.unit is not None and counts.unit.lower() not in DN:
        LOG.warning(
            "fspt: reduce: the file of the counts states the unit '%s' (BUNIT); its values are taken for DN. Give raw "
            "counts, or correct BUNIT.",
            counts.unit,
        )


def require_same_rows(name: str, top_row: str | None, other: str, others: str | None) -> None:
    """Raise DetectorError if of two files one is turned and the other does not state which row is the top one.

    name, other : what they are, such as 'bias' and 'counts';  top_row, others : their `top_row`
    """
    pairs = {name: top_row, other: others}
    silent = next((one for one, row in pairs.items() if row in SILENT), None)
    turned = next((one for one, row in pairs.items() if row in TURNS), None)
    if silent and turned and (pairs[silent], pairs[turned]) != (UNTAGGED, LAST):  # which a line says to turn
        (tag, without), (own, stated) = SILENT[pairs[silent]], TURNS[pairs[turned]]
        fix = f"set {tag} in both files" if tag == own else "state the top row in both files"
        raise DetectorError(f"reduce: '{silent}' {without}, '{turned}' {stated}. Their rows would not match: {fix}.")


def require_same_time(name: str, frame: Counts, other: str, time: float | None) -> None:
    """Raise DetectorError if the file of the dark frame `name` states another exposure time than `time` [s] of `other`.

    Passes where one of them is unknown.
    """
    stated = frame.exposure_time
    if stated is not None and time is not None and abs(stated - time) > SAME_TIME * time:
        raise DetectorError(
            f"reduce: '{name}' was exposed {stated:g} s, the {other} {time:g} s. Give a dark frame of the same time."
        )


def read_counts(path: str | os.PathLike[str], frames: int | None = None) -> Counts:
    """Counts of a TIFF, FITS or NPY file, or of a click folder; `frames` as of `counts_of`.

    Raises
    ------
    ImageError : the file cannot be read, holds no real numbers, or holds NaN.
    BackendError : tifffile or astropy, which read TIFF and FITS, is not installed.
    """
    path = Path(path)
    if path.is_dir():
        return _click(path)
    require_suffix(path)
    if path.suffix.lower() in (*TIFF, *FITS):
        _require_counts(path)
    thing = f"counts '{path}'"
    array, header = read_frame(path, thing)
    if path.suffix.lower() in TIFF and (channels := channels_of(path, thing)) > 1:
        raise ImageError(
            f"{thing} have {channels} channels or colours, which are no frames of one exposure. Save one of "
            "them, or frames as slices or times."
        )
    array = array.astype(np.uint8) if array.dtype == bool else array  # a frame of bad pixels
    return replace(counts_of(array, str(path), frames), **header)


def require_suffix(path: Path) -> None:
    """Raise ImageError for counts that are not there, or in a format of images alone; folders are not checked."""
    if not path.exists():
        raise ImageError(f"counts '{path}' do not exist. Check the name.")
    if path.is_file() and path.suffix.lower() not in (*TIFF, *FITS, ".npy"):
        _require_counts(path)
        raise ImageError(f"counts '{path}': '{path.suffix}' is not read. Give .tif, .fits or .npy.")


def _require_counts(path: Path) -> None:
    """Raise ImageError for an image of this package: its planes are power or electrons, no frames of counts."""
    try:
        planes, _ = read_planes(path)
    except (ImageError, BackendError):
        return
    raise ImageError(
        f"counts '{path}' are an image of fspt with {', '.join(planes)}. Reduce counts, as of 'fspt expose --counts'; "
        "'fspt invert' and 'fspt locate' take such an image as it is."
    )


def counts_of(array: Any, name: str, frames: int | None = None) -> Counts:
    """Counts of an array (h, w) or (frames, h, w), a file or argument `name`.

    frames : number of frames that an array (h, w) is the mean of, 1 if left out; of an array (frames, h, w), for which
        it may be left out, the length of the first axis

    Raises
    ------
    ImageError : the array is none of these, or an image of this package, holds NaN, has another number of frames, or
        its last axis seems to be that of the frames: the two others are more alike. `frames` says that it is not.
    """
    if frames is not None:
        frames = whole("reduce: 'frames'", frames, ImageError, "10")
        if frames < 1:
            raise ImageError(f"reduce: 'frames' must be >= 1, got {frames}. Give for example 10.")
    for one in array if isinstance(array, (list, tuple)) else (array,):
        if isinstance(one, (Image, Exposure)):
            raise ImageError(
                f"reduce: '{name}' must be counts [DN], got an {type(one).__name__}, which holds watts or electrons. "
                "Give the counts, such as exposure.counts; 'invert' and 'locate' take an Image or an Exposure."
            )
        require_unmasked(f"counts '{name}'", one, ImageError, "Give its data, and its mask as 'bad_pixels'.")
    array = np.asarray(array)
    colour = array.ndim == 3 and array.shape[2] in (3, 4)  # the last axis of RGB and RGBA files
    if array.dtype.kind not in "uif" or array.ndim not in (2, 3) or array.size == 0 or colour:
        raise ImageError(
            f"counts '{name}' must be real numbers of shape (h, w) or (frames, h, w), got {array.dtype} of shape "
            f"{array.shape}. Save one channel of grey values."
        )
    if array.dtype.kind == "i" and array.dtype.itemsize == 2:
        _require_not_wrapped(array[array < WRAPPED], name)
    stack = array.astype(np.float64)
    if not np.isfinite(stack).all():
        raise ImageError(f"counts '{name}' hold {int(np.sum(~np.isfinite(stack)))} NaN or inf. Mask or replace them.")
    raw = array.dtype.kind == "u"
    if stack.ndim == 2:
        return Counts(stack, frames or 1, raw=raw)
    _require_frames_first(stack.shape, name, frames)
    return Counts(
        stack.mean(axis=0),
        len(stack),
        highest=stack.max(axis=0),
        first=stack[0].copy(),
        raw=raw,
        levels=np.array([np.minimum(frame, np.percentile(frame, BRIGHT)).mean() for frame in stack]),
    )


def _require_not_wrapped(low: NDArray[np.int16], name: str) -> None:
    """Raise ImageError for counts below `WRAPPED` of 16 bits with a sign; all at the least number are marks."""
    if low.size and (low == EMPTY).all():
        raise ImageError(
            f"counts '{name}' hold {low.size} values of {EMPTY}, which marks pixels without a value. Replace them, "
            "by 0 for example, and mask these pixels by 'bad_pixels'; if counts above 32767 have lost 65536, save "
            "them without a sign."
        )
    if low.size:
        raise ImageError(
            f"counts '{name}' of 16 bits with a sign go down to {low.min()}: those above 32767 have lost 65536. Save "
            "them without a sign, in FITS with BZERO = 32768."
        )


def tell_unequal_frames(counts: Counts, dark: float, noise: float) -> None:
    """Say in one line on stderr that the frames of a stack have not the same light.

    dark : mean level without light [DN];  noise : standard deviation of a pixel of one frame [DN]
    """
    if counts.levels is None:
        return
    light = counts.levels - dark
    by_noise = max(UNEQUAL_BY_NOISE * noise / counts.values.size**0.5, UNEQUAL_BY_DRIFT)
    if np.ptp(light) > max(UNEQUAL * abs(light.mean()), by_noise):
        LOG.warning(
            "fspt: reduce: the %d frames of the counts have not the same light: %.4g DN a pixel in frame %d, %.4g DN "
            "in frame %d. The image is that of their mean. Give frames of one exposure time and gain; check the light "
            "source and the offset.",
            counts.frames,
            *(light.min(), int(light.argmin()), light.max(), int(light.argmax())),
        )


def _require_frames_first(shape: tuple[int, ...], name: str, frames: int | None) -> None:
    """Raise ImageError for a stack of another number of frames, or of a shape (h, w, frames)."""
    count, height, width = shape
    if frames is not None and frames != count:
        raise ImageError(
            f"counts '{name}' of shape {shape} have {count} frames, 'frames' is {frames}. Give stacks as "
            "(frames, h, w), and 'frames' of a single (h, w) that is their mean."
        )
    if frames is None and width < count and _elongation(count, height) < _elongation(height, width):
        raise ImageError(
            f"counts '{name}' of shape {shape} would be {count} frames of {width} × {height} pixels, and look like "
            f"{width} frames of {height} × {count}. Give frames first, np.moveaxis(counts, -1, 0), or frames={count} "
            "if they are."
        )


def _elongation(one: int, other: int) -> float:
    """Ratio of the longer to the shorter side."""
    return max(one, other) / min(one, other)


def _click(folder: Path) -> Counts:
    """Counts of a click folder: luminescent.TIF, and readbiasonly, background and ClickInfo.txt if it contains them."""
    files = {file.stem.lower(): file for file in sorted(folder.iterdir()) if file.is_file()}
    if CLICK not in files:
        raise ImageError(f"folder '{folder}' holds no luminescent.TIF. Give a click folder of an IVIS camera.")
    frames = {name: _click_counts(files[name]) for name in (BIAS, BACKGROUND) if name in files}
    light = _click_counts(files[CLICK])
    for name, frame in frames.items():
        require_same_rows(name, frame.top_row, CLICK, light.top_row)
    found = {name: frame.values for name, frame in frames.items()}
    info = _click_info(files[INFO].read_text("utf-8", "replace")) if INFO in files else {}
    time, binning = _number(info, EXPOSURE), _number(info, BINNING)
    if binning is not None and not (binning >= 1 and binning == int(binning)):
        LOG.warning(
            "fspt: '%s' states a binning of %g, no whole number >= 1; it is left out. Correct it, or give the number.",
            *(files[INFO], binning),
        )
        binning = None
    sides = None if binning is None else int(binning)
    bias, background = found.get(BIAS), found.get(BACKGROUND)
    return replace(light, bias=bias, background=background, exposure_time=time, info=info, binning=sides)


def _click_counts(file: Path) -> Counts:
    """Counts of a TIFF of a click folder."""
    images, orientation = read_oriented(file, f"counts '{file}'")
    return replace(counts_of(images, str(file)), top_row=tiff_row(orientation))


def _click_info(text: str) -> dict[str, str]:
    """`Key: value` lines of ClickInfo.txt by key; of keys that occur twice, those of the luminescent image.

    Each image of a click has its own exposure and binning, in a section `*** luminescent image: FILE` or likewise. The
    file begins with the photograph's.
    """
    own: dict[str, str] = {}
    rest: dict[str, str] = {}
    lit = False
    for line in text.splitlines():
        key, colon, value = (part.strip() for part in line.partition(":"))
        if line.startswith("***"):
            lit = key.strip("* ").lower().startswith(CLICK)
        if colon:
            (own if lit else rest).setdefault(key, value)
    return own | {key: value for key, value in rest.items() if key not in own and not (own and _of_image(key))}


def _of_image(key: str) -> bool:
    """True for keys that occur once for each image of a click."""
    return any(pattern.search(key) for pattern in (*EXPOSURE, *BINNING))


def _number(info: dict[str, str], patterns: tuple[re.Pattern[str], ...]) -> float | None:
    """Number of the first key that the first of the patterns matches, None where none does."""
    for pattern in patterns:
        for key, value in info.items():
            if pattern.search(key) and (text := NUMBER.search(value)) and math.isfinite(number := float(text[0])):
                return number
    return None
