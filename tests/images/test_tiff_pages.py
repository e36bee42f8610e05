"""TIFF files of other programs: pixels that would be wrong are refused, other reports are one line."""

from __future__ import annotations

import struct
from importlib.util import find_spec

import numpy as np
import pytest

from mitsuba_fspt.detector.counts import read_counts
from mitsuba_fspt.images.tiff_pages import read_tiff
from mitsuba_fspt.runtime.errors import BackendError, ImageError

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


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_turned_upright(tmp_path, caplog, orientation):
    """The tag says where the first row and the first column are, e.g. 6: on the right and at the top (TIFF 6.0)."""
    upright = FRAMES[0]
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.T,
        6: upright.T[::-1],  # its first row is the last column, from the top
        7: upright.T[::-1, ::-1],
        8: upright.T[:, ::-1],
    }[orientation]
    path = tmp_path / "counts.tif"
    tifffile.imwrite(path, np.stack(2 * [stored]), photometric="minisblack", extratags=[(274, 3, 1, orientation, True)])
    np.testing.assert_array_equal(read_tiff(path, "counts 'counts.tif'"), np.stack(2 * [upright]))
    assert len(caplog.messages) == (orientation != 1)


def test_a_picture_of_which_0_is_white_is_reported(tmp_path, caplog):
    """Its values are taken as they are, as by ImageJ, which shows them inverted."""
    for kind, lines in (("minisblack", 0), ("miniswhite", 1)):
        tifffile.imwrite(tmp_path / "counts.tif", FRAMES[0], photometric=kind)
        np.testing.assert_array_equal(read_tiff(tmp_path / "counts.tif", "counts"), FRAMES[0])
        assert [text for text in caplog.messages if "says that 0 is white" in text] == caplog.messages
        assert len(caplog.messages) == lines


@pytest.mark.parametrize(
    "how",
    [
        {"photometric": "rgb", "planarconfig": "contig"},
        {"photometric": "rgb", "planarconfig": "separate"},
        {"ome": True, "metadata": {"axes": "CYX"}},
        {"imagej": True, "metadata": {"axes": "CYX"}},
    ],
)
def test_channels_are_no_frames_of_counts(tmp_path, how):
    """Of the images through two filters, or of three colours, the mean was taken, as of frames."""
    path = tmp_path / "counts.tif"
    kind = how.get("planarconfig")
    images = {"contig": np.moveaxis(FRAMES, 0, -1), "separate": FRAMES.astype(np.uint8)}.get(kind, FRAMES[:2])
    tifffile.imwrite(path, images, **how)
    with pytest.raises(ImageError, match=r"counts\.tif' have [23] channels or colours, which are no frames"):
        read_counts(path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a tifffile that will no longer guess colours
@pytest.mark.parametrize("number", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_a_stack_of_any_number_of_frames_is_read(tmp_path, caplog, number, kind):
    """tifffile writes three or four frames as the colours of a picture."""
    frames = np.arange(number * 6 * 5).reshape(number, 6, 5).astype(kind)
    path = tmp_path / "counts.tif"
    tifffile.imwrite(path, frames)
    found = read_counts(path)
    assert found.frames == number
    np.testing.assert_array_equal(found.values, frames.mean(axis=0))
    with tifffile.TiffFile(path) as file:
        guessed = "S" in file.series[0].axes
    assert ["taken for frames" in text for text in caplog.messages] == [True] * guessed


def test_frames_over_time_or_depth_are_a_stack(tmp_path):
    for axes in ("TYX", "ZYX"):
        tifffile.imwrite(tmp_path / "counts.tif", FRAMES, ome=True, metadata={"axes": axes})
        assert read_counts(tmp_path / "counts.tif").frames == 3


@pytest.mark.skipif(find_spec("imagecodecs") is not None, reason="imagecodecs is installed")
def test_a_compression_without_its_package_is_named(tmp_path):
    """LZW, which tifffile reads with imagecodecs alone. Seen to fail: the file was called damaged."""
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "lzw.tif", np.ones((4, 5), np.uint16))
    with tifffile.TiffFile(tmp_path / "lzw.tif", mode="r+") as file:
        file.pages[0].tags["Compression"].overwrite(5)
    with pytest.raises(BackendError, match=r"needs imagecodecs, which is not installed\. pip install imagecodecs, or"):
        read_counts(tmp_path / "lzw.tif")


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


def test_of_several_series_the_first_is_read_with_a_line(tmp_path, caplog):
    """As tifffile writes pages one after the other. The second was left out without a word."""
    tifffile = pytest.importorskip("tifffile")
    file, frame = tmp_path / "two.tif", np.arange(12, dtype=np.uint16).reshape(3, 4)
    with tifffile.TiffWriter(file) as out:
        out.write(frame)
        out.write(frame + 5)
    np.testing.assert_array_equal(read_counts(file).values, frame)
    assert f"counts '{file}': only the first of its 2 series of pages is read" in caplog.text


def test_of_several_images_of_a_fits_file_the_first_is_read_with_a_line(tmp_path, caplog):
    """After a table or numbers in a row, too, which were taken for the image.

    The second image was left out without a word.
    """
    fits = pytest.importorskip("astropy.io.fits")
    file, frame = tmp_path / "two.fits", np.arange(12, dtype=np.uint16).reshape(3, 4)
    table = fits.BinTableHDU(np.zeros(3, [("time", "f4")]))
    images = [fits.CompImageHDU(frame, name="LIGHT"), fits.ImageHDU(frame + 5, name="MASK")]
    spectrum = fits.ImageHDU(np.zeros(5))
    fits.HDUList([fits.PrimaryHDU(), table, spectrum, *images]).writeto(file)
    np.testing.assert_array_equal(read_counts(file).values, frame)
    assert f"counts '{file}': only the first of its 2 images (LIGHT, MASK) is read" in caplog.text
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(file, overwrite=True)
    with pytest.raises(ImageError, match="it holds no image"):
        read_counts(file)
