"""TIFF files of other programs: pixels that would be wrong are refused, other reports are one line."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from mitsuba_fspt.images.tiff_pages import read_tiff
from mitsuba_fspt.runtime.errors import ImageError

tifffile = pytest.importorskip("tifffile", reason="the extra 'formats' is not installed")
FRAMES = np.arange(3 * 6 * 5, dtype=np.uint16).reshape(3, 6, 5)


def pages(path):
    """Offsets of the field that names the next page, of each page of a file."""
    with tifffile.TiffFile(path) as file:
        return [page.offset + 2 + 12 * len(page.tags) for page in file.pages]


def write_offset(path, place, value):
    with path.open("r+b") as file:
        file.seek(place)
        file.write(struct.pack("<I", value))


@pytest.fixture
def stack(tmp_path):
    path = tmp_path / "counts.tif"
    with tifffile.TiffWriter(path) as writer:
        for frame in FRAMES:
            writer.write(frame, photometric="minisblack", metadata=None, contiguous=False)
    return path


def test_a_stack_is_read(stack):
    np.testing.assert_array_equal(read_tiff(stack, "counts 'counts.tif'"), FRAMES)


def test_pages_in_a_circle_are_refused(stack):
    """Seen to be read as four million pages, for minutes."""
    with tifffile.TiffFile(stack) as file:
        first = file.pages[0].offset
    write_offset(stack, pages(stack)[-1], first)
    with pytest.raises(ImageError, match=r"counts 'counts.tif': the file is damaged, .* in a circle\. Copy or save"):
        read_tiff(stack, "counts 'counts.tif'")


def test_a_page_that_is_lost_is_refused(stack):
    """Seen to be the mean of two frames of three, with a line of tifffile's own."""
    write_offset(stack, pages(stack)[1], 1 << 30)
    with pytest.raises(ImageError, match=r"the file is damaged, or no TIFF file: .*invalid page offset"):
        read_tiff(stack, "counts 'counts.tif'")


def test_a_private_tag_that_is_wrong_is_one_line(tmp_path, caplog):
    path = tmp_path / "counts.tif"
    tifffile.imwrite(path, FRAMES[0], metadata=None, extratags=[(65000, "I", 1, 7, True)])
    with tifffile.TiffFile(path) as file:
        place = file.pages[0].tags[65000].offset
    with path.open("r+b") as file:
        file.seek(place + 2)
        file.write(struct.pack("<H", 999))  # no type of a tag
    np.testing.assert_array_equal(read_tiff(path, "counts 'counts.tif'"), FRAMES[0])
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("fspt: counts 'counts.tif': tifffile reports: ")
    assert line.endswith("Check the image.")
