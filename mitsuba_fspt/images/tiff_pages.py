"""TIFF files of other programs: their images, and what is wrong with them."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import LONGEST_TEXT, BackendError, ImageError, one_line
from ..runtime.extras import require

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPageSeries

LOG = logging.getLogger("mitsuba_fspt")
TAG = re.compile(r"TiffTag (\d+)")
SMALLEST_PAGE = 18  # bytes of a page with one tag
PRIVATE = 32768  # least number of a private tag, which says nothing about the pixels
ORIENTATION = 274  # number of the tag; 1 where the first row is the top one and the first column that on the left
CODECS = "imagecodecs"  # package of which tifffile takes LZW and further compressions
CHANNELS = "CS"  # axes of tifffile: colours, and samples of a pixel


def read_tiff(path: Path, thing: str) -> NDArray[Any]:
    """Images of a TIFF file, (h, w) or (pages, h, w, …), row 0 at the top, as of `read_oriented`."""
    return read_oriented(path, thing)[0]


def read_oriented(path: Path, thing: str) -> tuple[NDArray[Any], int | None]:
    """Images of a TIFF file, (h, w) or (pages, h, w, …), row 0 at the top, and its Orientation; None without one.

    Values are as they are stored. Where the file's Orientation says that another row is the top one, the images are
    turned, which one line on stderr says. Of several series of pages the first is read, and of what tifffile reports
    about tags that do not matter the first; one line on stderr says either.

    thing : what the file is, for messages, such as "counts 'a.tif'"

    Raises
    ------
    ImageError : the file is no TIFF, or is damaged or incomplete, so that pixels or pages would be wrong.
    BackendError : tifffile is not installed, or imagecodecs, which the compression of the file needs.
    """
    require("tifffile", thing)
    import tifffile

    try:
        with _reports() as reports, tifffile.TiffFile(path) as file:
            if _has_page(file, path.stat().st_size // SMALLEST_PAGE + 1):
                raise ValueError("its pages follow each other in a circle")
            series, count = file.series[0], len(file.series)
            images, turned = _upright(series)
            tagged = ORIENTATION in series.keyframe.tags
            inverted = series.keyframe.photometric == tifffile.PHOTOMETRIC.MINISWHITE
            missing = sum(page is None for page in series.pages)
    except Exception as cause:  # whatever a damaged file makes tifffile raise
        if CODECS in str(cause):
            raise BackendError(
                f"{thing}: its compression needs {CODECS}, which is not installed. pip install {CODECS}, or save the "
                "file without compression."
            ) from cause
        raise _damaged(thing, cause) from cause
    if missing:
        raise _damaged(thing, f"{missing} of its {len(series.pages)} pages are missing")
    texts = [" ".join(report.getMessage().split()) for report in reports]
    for report, text in zip(reports, texts, strict=True):
        if report.levelno >= logging.ERROR and not _is_of_private_tag(text):
            raise _damaged(thing, text)
    if texts:
        more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        LOG.warning("fspt: %s: tifffile reports: %s%s. Check the image.", thing, one_line(texts[0], LONGEST_TEXT), more)
    if turned != 1:
        LOG.warning(
            "fspt: %s: its rows do not begin at the top left (Orientation %d); it is turned. Turn frames without such "
            "a tag, such as arrays and .npy, likewise.",
            thing,
            turned,
        )
    if count > 1:
        tell_left_out(thing, f"{count} series of pages")
    if inverted:
        LOG.warning(
            "fspt: %s: it says that 0 is white (PhotometricInterpretation 0); more is taken as more light.", thing
        )
    return images, turned if tagged else None


def tell_left_out(thing: str, images: str) -> None:
    """Say in one line on stderr that a file has several `images`, such as "2 series of pages", and one is read."""
    LOG.warning(
        "fspt: %s: only the first of its %s is read. Save frames of one exposure as one stack, others as own files.",
        thing,
        images,
    )


def channels_of(path: Path, thing: str) -> int:
    """Number of colours or samples of each pixel of a TIFF file that `read_tiff` has read.

    It is 1 where each sample of more than 8 bits is stored as an image by itself: so tifffile writes a stack of three
    or four frames unless it is told otherwise, which one line on stderr says of `thing`.
    """
    import tifffile

    with _reports(), tifffile.TiffFile(path) as file:
        series = file.series[0]
        sizes = {axis: size for axis, size in zip(series.axes, series.shape, strict=True) if axis in CHANNELS}
        apart = series.keyframe.planarconfig == tifffile.PLANARCONFIG.SEPARATE
        wide = np.dtype(series.dtype).itemsize > 1
    if apart and wide and (samples := sizes.pop("S", 1)) > 1:
        LOG.warning("fspt: %s: its %d samples of each pixel are taken for frames of one exposure.", thing, samples)
    return math.prod(sizes.values())


def _upright(series: TiffPageSeries) -> tuple[NDArray[Any], int]:
    """Images of a series with the top row first and the left column first, and its Orientation."""
    images = series.asarray()
    tag = series.keyframe.tags.get(ORIENTATION)
    orientation = 1 if tag is None else int(tag.value)
    if not 1 <= orientation <= 8 or not {"Y", "X"} <= set(series.axes) or images.ndim != len(series.axes):
        return images, 1
    y, x = series.axes.index("Y"), series.axes.index("X")
    if orientation > 4:  # rows are columns
        images = np.swapaxes(images, y, x)
    flipped = tuple(axis for axis, kinds in ((y, (3, 4, 7, 8)), (x, (2, 3, 6, 7))) if orientation in kinds)
    return np.flip(images, flipped), orientation


def _has_page(file: TiffFile, number: int) -> bool:
    """True if the chain of pages is longer than `number`."""
    try:
        file.pages.get(number)
    except IndexError:
        return False
    return True


def _is_of_private_tag(text: str) -> bool:
    tag = TAG.search(text)
    return tag is not None and int(tag[1]) >= PRIVATE


def _damaged(thing: str, reason: object) -> ImageError:
    line = one_line(reason, LONGEST_TEXT)
    return ImageError(f"{thing}: the file is damaged, or no TIFF file: {line}. Copy or save it again.")


class _Collector(logging.Handler):
    """Handler that appends what is logged to a list."""

    def __init__(self, found: list[logging.LogRecord]) -> None:
        super().__init__()
        self._found = found

    def emit(self, record: logging.LogRecord) -> None:
        self._found.append(record)


@contextmanager
def _reports() -> Iterator[list[logging.LogRecord]]:
    """Context manager that yields a list of what tifffile logs in the block, in place of printing it."""
    found: list[logging.LogRecord] = []
    logger, handler = logging.getLogger("tifffile"), _Collector(found)
    propagate, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate
