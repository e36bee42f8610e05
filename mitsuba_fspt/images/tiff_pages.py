"""TIFF files of other programs: their images, and what is wrong with them."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from ..runtime.errors import LONGEST_TEXT, ImageError, one_line
from ..runtime.extras import require

if TYPE_CHECKING:
    from tifffile import TiffFile

LOG = logging.getLogger("mitsuba_fspt")
TAG = re.compile(r"TiffTag (\d+)")
SMALLEST_PAGE = 18  # bytes of a page with one tag
PRIVATE = 32768  # least number of a private tag, which says nothing about the pixels


def read_tiff(path: Path, thing: str) -> NDArray[Any]:
    """Images of a TIFF file, (h, w) or (pages, h, w, …) as they are stored.

    What tifffile reports about tags that do not matter is one line on stderr.

    thing : what the file is, for messages, such as "counts 'a.tif'"

    Raises
    ------
    ImageError : the file is no TIFF, or is damaged or incomplete, so that pixels or pages would be wrong.
    BackendError : tifffile is not installed.
    """
    require("tifffile", thing)
    import tifffile

    try:
        with _reports() as reports, tifffile.TiffFile(path) as file:
            if _has_page(file, path.stat().st_size // SMALLEST_PAGE + 1):
                raise ValueError("its pages follow each other in a circle")
            series = file.series[0]
            images = series.asarray()
            missing = sum(page is None for page in series.pages)
    except Exception as cause:  # whatever a damaged file makes tifffile raise
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
    return images


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
