"""Images: what goes into the file comes out of it, and a file is whole or not there."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import pytest

from mitsuba_fspt.images.formats import read_planes, write_planes
from mitsuba_fspt.images.image import Image, read
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.runtime.errors import FsptError, ImageError

resource = pytest.importorskip("resource")  # not on Windows

RNG = np.random.default_rng(7)
METADATA = {
    "method": "integral",
    "scene": "scenes/zylinder µ.xml",
    "f_number": 2.8,
    "focal_length": 55.000000001,  # not a float32
    "rtol": 1e-4,
    "seed": -3,
    "samples": 2**40,
    "note": "",
    "a_key_longer_than_the_31_characters_of_old_exr_files": 1,
}


def picture(height: int = 5, width: int = 7) -> Image:
    power = RNG.random((height, width)) * 1e-9
    return Image(power, power * 1e-3, RNG.random((height, width)), dict(METADATA))


def test_round_trip(tmp_path):
    """Rows, columns and channels keep their places: no two of the three channels or 35 pixels are equal."""
    image = picture()
    image.write(tmp_path / "a.exr")
    back = read(tmp_path / "a.exr")
    for name in ("power", "error", "coverage"):
        np.testing.assert_array_equal(getattr(back, name), getattr(image, name).astype(np.float32))
    assert back.metadata == METADATA | {"quantity": "power", "unit": "W"}
    kinds = {key: type(value) for key, value in back.metadata.items()}
    assert kinds["f_number"] is float
    assert kinds["seed"] is int
    assert kinds["scene"] is str


def test_file_as_other_tools_see_it(tmp_path):
    """Channel names, 32-bit floats and the `fspt:` attributes are what scripts outside rely on."""
    picture().write(tmp_path / "a.exr")
    file = OpenEXR.File(str(tmp_path / "a.exr"))
    assert {name: c.pixels.dtype for name, c in file.channels().items()} == dict.fromkeys(
        ("Y", "error.Y", "coverage.Y"), np.float32
    )
    header = file.header()
    assert header["fspt:quantity"] == "power"
    assert header["fspt:unit"] == "W"
    assert header["fspt:f_number"] == 2.8  # a double: 2.8 in 32 bits differs
    assert header["fspt:seed"] == -3
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION


def test_without_error_and_coverage(tmp_path):
    Image(np.ones((1, 1))).write(tmp_path / "one.exr")
    image = read(tmp_path / "one.exr")
    assert image.error is None
    assert image.coverage is None
    assert image.shape == (1, 1)
    assert image.power[0, 0] == 1


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint32])
def test_foreign_file(tmp_path, kind):
    """A half-float file and one with further channels can be read; the values are in range of each type."""
    values = np.arange(12, dtype=kind).reshape(3, 4)
    channels = {"Y": values, "A": np.ones_like(values), "R": values + 1, "G": values, "B": values}
    OpenEXR.File({}, {name: OpenEXR.Channel(v) for name, v in channels.items()}).write(str(tmp_path / "f.exr"))
    image = read(tmp_path / "f.exr")
    np.testing.assert_array_equal(image.power, values)
    assert image.power.dtype.itemsize >= 4
    assert image.metadata == {"quantity": "power", "unit": "W"}


def test_scaled_to_a_source():
    """Power and error take the factor, the coverage does not; twice is refused.

    Seen to fail with the error left as it was, and with the coverage multiplied too.
    """
    image = Image([[2.0, 4.0]], [[0.5, 1.0]], [[0.25, 1.0]], {"f_number": 8.0})
    scaled = image.scaled(3e-9)
    np.testing.assert_allclose(scaled.power, [[6e-9, 12e-9]], rtol=1e-12)
    np.testing.assert_allclose(scaled.error, [[1.5e-9, 3e-9]], rtol=1e-12)
    np.testing.assert_array_equal(scaled.coverage, image.coverage)
    assert scaled.metadata == image.metadata | {"source_power": 3e-9}
    assert "source_power" not in image.metadata
    with pytest.raises(ImageError, match=r"'source_power' is 3e-09 W already, got 2 W\. Leave it out"):
        scaled.scaled(2)
    assert Image([[1.0]]).scaled(2).error is None


@pytest.mark.parametrize("watt", [0, -1, np.nan, np.inf, "much", True])
def test_powers_of_no_source(watt):
    with pytest.raises(ImageError, match=rf"'source_power' must be .*, got '?{watt}'?\. Give for example 1e-9"):
        Image([[1.0]]).scaled(watt)


def test_a_small_source_does_not_lose_digits():
    """float32 pixels of 1e-30 W times 1e-12 W are below what float32 holds. Seen to fail without the doubles."""
    scaled = Image(np.full((1, 1), 1e-30, np.float32)).scaled(1e-12)
    assert float(scaled.power[0, 0]) == pytest.approx(1e-42, rel=1e-6, abs=0)


@pytest.mark.parametrize("metadata", [None, ["a"], "text"])
def test_metadata_that_are_no_dict_are_refused(metadata):
    with pytest.raises(ImageError, match=r"'metadata' must be texts and numbers by name, got \w+\. Give a dict"):
        Image(np.ones((2, 3)), metadata=metadata)


def test_images_cannot_be_written_into():
    """Also not by the caller's own array, such as a buffer of frames. Seen to fail: an image of 3 W in place of 1 W."""
    values = np.ones((2, 2))
    image = Image(values)
    assert Image(image.power).power is image.power
    with pytest.raises(ValueError, match="read-only"):
        image.power[0, 0] = 2
    values[0, 0] = 3  # the caller's own array stays the caller's
    assert image.power.tolist() == [[1, 1], [1, 1]]


def test_what_a_masked_array_hides_is_masked():
    """Seen to fail: numbers under the mask counted in the total, NaN there was refused."""
    power = np.ma.array([[1.0, 2.0], [np.nan, 100.0]], mask=[[False, False], [True, True]])
    image = Image(power, np.ma.array(np.ones((2, 2)), mask=[[True, False], [False, False]]))
    assert image.mask.tolist() == [[True, False], [True, True]]
    assert image.total_power == 2
    assert Image(np.ma.array(np.ones((2, 2)))).mask is None
    assert Image([[1.0, 2.0]], [[-1, 1]], mask=[[True, False]]).error.tolist() == [[-1, 1]]  # -1 where there is none


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda array: array.T, r"the dimensions \(x, y\)\. Give \.transpose\(\.\.\., 'y', 'x'\)"),
        (lambda array: array.sortby("y"), r"has y \[mm\] that must descend.*Give \.sortby\('y', False\), or \.values"),
        (lambda array: array.sortby("x", False), r"has x \[mm\] that must ascend.*Give \.sortby\('x', True\)"),
    ],
)
def test_an_array_of_xarray_must_be_upright(change, message):
    """Seen to fail: the image lay on its side, or stood on its head, without a word."""
    pytest.importorskip("xarray")
    array = Image(np.arange(9.0).reshape(3, 3), metadata={"pixel_pitch": 0.1}).to_xarray().power
    np.testing.assert_array_equal(Image(array).power, array)
    with pytest.raises(ImageError, match=message):
        Image(change(array))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"power": np.ones(3)}, "'power' must be numbers of shape"),
        ({"power": np.ones((0, 3))}, "'power' must be numbers of shape"),
        ({"power": np.ones((2, 2), complex)}, "'power' must be numbers of shape"),
        (
            {"power": [[1, np.nan], [np.nan, 1]]},
            r"'power' must be finite, got nan at row 0, column 1 \(2 such",
        ),
        (
            {"power": np.ones((2, 2)), "error": [[1, 1], [np.inf, 1]]},
            "'error' must be finite, got inf at row 1",
        ),
        ({"power": np.ones((2, 2)), "error": [[1, 1], [-1, 1]]}, "'error' must be >= 0, got -1"),
        ({"power": np.ones((2, 2)), "coverage": np.ones((2, 3))}, r"'coverage' must have the shape \(2, 2\)"),
        ({"power": np.ones((2, 2)), "metadata": {"unit": "e-"}}, "values are power in e-, not power in W"),
    ],
)
def test_what_is_no_image(arguments, message):
    with pytest.raises(ImageError, match=message):
        Image(**arguments)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image([[1e39, 0]]), "'power' is 1e.39 at row 0, column 0.*Scale the exitance down"),
        (Image([[1.0, 0]], [[0, 1e300]]), "'error' is 1e.300 at row 0, column 1"),
        (Image([[1e-39, 0]]), "brightest pixel has 1e-39 W.*Scale the exitance up"),
        (Image([[1.0]], metadata={"seed": 2**60}), "'seed' = 1152921504606846976 is too large"),
        (Image([[1.0]], metadata={"lens": (1, 2)}), "'lens' must be text or a number, got tuple"),
    ],
)
def test_values_that_no_file_can_store(tmp_path, image, message):
    with pytest.raises(ImageError, match=message):
        image.write(tmp_path / "a.exr")
    assert os.listdir(tmp_path) == []


def test_dark_pixels_may_vanish_and_dark_images_be_written(tmp_path):
    Image([[1e-3, 1e-60]]).write(tmp_path / "a.exr")
    np.testing.assert_array_equal(read(tmp_path / "a.exr").power, np.float32([[1e-3, 0]]))
    Image(np.zeros((2, 2))).write(tmp_path / "a.exr")
    assert not read(tmp_path / "a.exr").power.any()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.png", r"must end in \.exr, \.fits, \.h5, \.npz or \.tif\. Give a name"),
        ("none/a.exr", "folder '.*none' does not exist. Create it first"),
        ("folder.exr", "is a folder"),
        ("x" * 300 + ".exr", "cannot be written: File name too long"),
        ("/proc/a.exr", "'/proc/a.exr' cannot be written"),
    ],
)
def test_paths_that_cannot_be_written(tmp_path, name, message):
    (tmp_path / "folder.exr").mkdir()
    with pytest.raises(ImageError, match=message) as caught:
        picture().write(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert os.listdir(tmp_path) == ["folder.exr"]


def test_write_protected_file_stays(tmp_path, monkeypatch):
    """The superuser may write anywhere, so the answer of the system is given here."""
    (tmp_path / "a.exr").write_text("old")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ImageError, match="write-protected"):
        picture().write(tmp_path / "a.exr")
    assert (tmp_path / "a.exr").read_text() == "old"


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_full_disk_leaves_the_old_file(tmp_path, share):
    """A limit on the file size stops OpenEXR as a full disk does: at the start, half-way and at the end."""
    image = picture(64, 64)
    image.write(tmp_path / "a.exr")
    size = (tmp_path / "a.exr").stat().st_size
    before = (tmp_path / "a.exr").read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(size * share), limits[1]))
    try:
        with pytest.raises(ImageError, match=r"Failed to write pixel data to image file .*a\.exr") as caught:
            image.write(tmp_path / "a.exr")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(caught.value)
    assert os.listdir(tmp_path) == ["a.exr"]
    assert (tmp_path / "a.exr").read_bytes() == before


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, OSError("no space"), MemoryError])
def test_interrupted_writing_leaves_nothing(tmp_path, interruption):
    def write(name):
        with atomic_path(tmp_path / name) as temporary:
            temporary.write_text("half")
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".ply"
            raise interruption

    (tmp_path / "old.ply").write_text("old")
    for name in ("old.ply", "new.ply"):
        with pytest.raises(FsptError if isinstance(interruption, OSError) else interruption):
            write(name)
    assert os.listdir(tmp_path) == ["old.ply"]
    assert (tmp_path / "old.ply").read_text() == "old"


def test_new_files_have_the_usual_permissions(tmp_path):
    picture().write(tmp_path / "a.exr")
    (tmp_path / "usual").touch()
    assert (tmp_path / "a.exr").stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: b"", "no readable OpenEXR"),
        (lambda content: b"some text", "no readable OpenEXR"),
        (lambda content: content[:6], "damaged or incomplete"),
        (lambda content: content[:60], "damaged or incomplete"),
        (lambda content: content[:500], "damaged or incomplete"),
        (lambda content: content[: len(content) // 2], "damaged or incomplete"),
        (lambda content: content[:-1], "damaged or incomplete"),
        (lambda content: content[:-90] + bytes(90), "damaged or incomplete"),
    ],
)
def test_damaged_files(tmp_path, capfd, change, message):
    """One line each, and nothing printed by the library, which would add lines of its own."""
    # A ramp, since noise is stored uncompressed and then any bytes are pixels.
    Image(np.add.outer(np.arange(64), np.arange(64))).write(tmp_path / "a.exr")
    (tmp_path / "a.exr").write_bytes(change((tmp_path / "a.exr").read_bytes()))
    with pytest.raises(ImageError, match=message) as caught:
        read(tmp_path / "a.exr")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_reading_in_several_threads_leaves_the_streams_as_they_were(tmp_path, capfd):
    """Seen to fail without the lock: standard output was a buffer and standard error /dev/null for good."""
    Image(np.ones((8, 8))).write(tmp_path / "a.exr")
    streams = sys.stdout, os.fstat(2).st_ino
    with ThreadPoolExecutor(8) as threads:
        images = list(threads.map(read, [tmp_path / "a.exr"] * 400))
    assert (sys.stdout, os.fstat(2).st_ino) == streams
    assert all((image.power == 1).all() for image in images)
    os.write(2, b"heard")
    assert capfd.readouterr() == ("", "heard")


def test_files_without_power(tmp_path):
    with pytest.raises(ImageError, match=r"none\.exr' does not exist"):
        read(tmp_path / "none.exr")
    OpenEXR.File({}, {"RGB": np.zeros((2, 2, 3), np.float32)}).write(str(tmp_path / "rgb.exr"))
    with pytest.raises(ImageError, match=r"no plane of power in W \('Y' in an EXR\), it has B, G, R\."):
        read(tmp_path / "rgb.exr")
    write_planes(tmp_path / "e.exr", {"electrons": np.ones((2, 2))}, {"quantity": "electrons", "unit": "e-"})
    with pytest.raises(ImageError, match=r"e\.exr': image: the values are electrons in e-, not power"):
        read(tmp_path / "e.exr")


def test_values_of_a_foreign_file_must_be_finite(tmp_path):
    OpenEXR.File({}, {"Y": np.full((2, 2), np.nan, np.float32)}).write(str(tmp_path / "nan.exr"))
    with pytest.raises(ImageError, match=r"image file '.*nan\.exr': image: 'power' must be finite"):
        read(tmp_path / "nan.exr")


def test_channels_of_any_quantity(tmp_path):
    write_planes(tmp_path / "e.exr", {"electrons": np.eye(3)}, {"quantity": "electrons", "unit": "e-"})
    planes, metadata = read_planes(tmp_path / "e.exr")
    np.testing.assert_array_equal(planes["electrons"], np.eye(3))
    assert metadata == {"quantity": "electrons", "unit": "e-"}


def test_an_image_as_an_array_is_its_power():
    """np.asarray shares the memory and cannot be written; a copy can."""
    image = Image(np.arange(6.0, dtype=np.float32).reshape(2, 3))
    shared = np.asarray(image)
    assert np.shares_memory(shared, image.power)
    assert not shared.flags.writeable
    assert (shared.dtype, shared.shape) == (np.float32, (2, 3))
    assert np.asarray(image, dtype=np.float64).dtype == np.float64
    copy = np.array(image)
    copy[0, 0] = 7
    assert (image.power[0, 0], copy[0, 0], np.sum(image)) == (0, 7, 15)


def test_the_text_of_an_image_names_size_total_and_error():
    power = np.array([[1e-9, 2e-9, 3e-9]])
    assert repr(Image(power, 0.1 * power)) == "Image(3 x 1 pixels, 6e-09 W in all, error at most 3e-10 W a pixel)"
    assert repr(Image(power)) == "Image(3 x 1 pixels, 6e-09 W in all, error unknown)"
