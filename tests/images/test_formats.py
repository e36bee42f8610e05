"""Files of images by suffix: every format holds the same planes to the bit and the same metadata.

Each is opened by the ecosystem's own reader, as another program would.
"""

from __future__ import annotations

import builtins
import json
import os
import xml.etree.ElementTree as ElementTree

import astropy.io.fits
import h5py
import numpy as np
import OpenEXR
import pytest
import tifffile

import mitsuba_fspt as fspt
from mitsuba_fspt.images import formats
from mitsuba_fspt.runtime.errors import BackendError, ImageError

SUFFIXES = (".exr", ".fits", ".h5", ".npz", ".tif")
METADATA = {
    "method": "integral",
    "scene": "scenes/zylinder µ.xml",
    "f_number": 2.8,
    "rtol": 1.2345678901234567e-123,  # more digits than a FITS keyword holds
    "seed": -3,
    "samples": 2**40,
    "note": "",
    "levels": "; ".join(f"level {k}" for k in range(400)),  # longer than a FITS keyword holds
    "spaces": "  both sides  ",
    "pixel_pitch": 0.108,
    "magnification": 0.5,
    "a_key_longer_than_the_8_characters_of_a_FITS_keyword": 1,
}
SIDE = 0.216  # mm, of a pixel on the virtual detector plane


def image(height=5, width=7, **metadata):
    """No two pixels are equal; the largest float32, the smallest one, and one that is no float32."""
    power = np.random.default_rng(7).random((height, width)) * 1e-9
    power[0, 0], power[0, 1], power[1, 0] = 3.4028234e38, 1.1754944e-38, 1 / 3
    return fspt.Image(
        power, power * 1e-3, np.linspace(0, 1, height * width).reshape(height, width), METADATA | metadata
    )


@pytest.fixture
def written(tmp_path, request):
    """An image and the file that it was written to."""
    original, path = image(), tmp_path / f"a{request.param}"
    original.write(path)
    return original, path


def test_the_list_of_formats():
    assert formats.suffixes() == SUFFIXES


@pytest.mark.parametrize("written", [*SUFFIXES, ".tiff", ".TIF"], indirect=True)
def test_round_trip_to_the_bit(written):
    """Rows, columns, planes and the kinds of the metadata keep their places."""
    original, path = written
    back = fspt.read(path)
    for name in ("power", "error", "coverage"):
        plane = getattr(back, name)
        assert plane.dtype == np.float32
        assert plane.dtype.isnative
        np.testing.assert_array_equal(plane, getattr(original, name).astype(np.float32))
    kinds = {key: float if key == "samples" and path.suffix == ".exr" else type(v) for key, v in METADATA.items()}
    assert back.metadata == METADATA | {"quantity": "power", "unit": "W"}
    assert {key: type(back.metadata[key]) for key in METADATA} == kinds


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (3, 1)])
def test_small_images_without_error_and_coverage(tmp_path, suffix, shape):
    power = np.arange(1.0, 1 + shape[0] * shape[1]).reshape(shape)
    fspt.Image(power).write(tmp_path / f"a{suffix}")
    back = fspt.read(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(back.power, power)
    assert (back.error, back.coverage) == (None, None)
    assert back.metadata == {"quantity": "power", "unit": "W"}


@pytest.mark.parametrize("written", [".exr"], indirect=True)
def test_exr_as_openexr_reads_it(written):
    original, path = written
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
        assert file.header()["fspt:f_number"] == 2.8
    assert set(channels) == {"Y", "error.Y", "coverage.Y"}
    np.testing.assert_array_equal(channels["Y"], original.power.astype(np.float32))


@pytest.mark.parametrize("written", [".tif"], indirect=True)
def test_tif_as_tifffile_reads_it(written):
    """A stack of float32 with names and pixel size in OME-XML, and the size as TIFF resolution for ImageJ."""
    original, path = written
    with tifffile.TiffFile(path) as file:
        (series,) = file.series
        assert (series.axes, series.shape, series.dtype) == ("CYX", (3, 5, 7), np.float32)
        stack, root = series.asarray(), ElementTree.fromstring(file.ome_metadata)
        tags = file.pages[0].tags
        top, bottom = tags["XResolution"].value
        assert (tags["ResolutionUnit"].value, top / bottom) == (3, pytest.approx(10 / SIDE, rel=1e-6))  # per cm
        assert tags["Compression"].value == 1
    np.testing.assert_array_equal(stack, np.float32([original.power, original.error, original.coverage]))
    (pixels,) = (node for node in root.iter() if node.tag.endswith("}Pixels"))
    assert (float(pixels.get("PhysicalSizeX")), pixels.get("PhysicalSizeXUnit")) == (pytest.approx(SIDE), "mm")
    assert (float(pixels.get("PhysicalSizeY")), pixels.get("PhysicalSizeYUnit")) == (pytest.approx(SIDE), "mm")
    channels = [node.get("Name") for node in root.iter() if node.tag.endswith("}Channel")]
    assert channels == ["power", "error", "coverage"]


@pytest.mark.parametrize("written", [".h5"], indirect=True)
def test_h5_as_h5py_reads_it(written):
    """NXdata: the default plot is found from the root, with signal, errors, axes and units."""
    original, path = written
    with h5py.File(path) as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert [entry.attrs["NX_class"], data.attrs["NX_class"]] == ["NXentry", "NXdata"]
        signal = data[data.attrs["signal"]]
        assert (signal.name, signal.attrs["units"], signal.dtype) == ("/entry/data/power", "W", np.float32)
        np.testing.assert_array_equal(signal, original.power.astype(np.float32))
        errors = data[data.attrs["signal"] + "_errors"]
        np.testing.assert_array_equal(errors, original.error.astype(np.float32))
        assert errors.attrs["units"] == "W"
        assert list(data.attrs["axes"]) == ["y", "x"]
        assert list(data.attrs["auxiliary_signals"]) == ["coverage"]
        np.testing.assert_allclose(data["x"], SIDE * (np.arange(7) - 3), rtol=1e-12)
        np.testing.assert_allclose(data["y"], SIDE * (2 - np.arange(5)), rtol=1e-12, atol=1e-15)  # the top row first
        assert {data[name].attrs["units"] for name in ("x", "y")} == {"mm"}
        assert file["entry/metadata"].attrs["f_number"] == 2.8
        assert file["entry/metadata"].attrs["levels"] == METADATA["levels"]


@pytest.mark.parametrize("written", [".npz"], indirect=True)
def test_npz_as_numpy_reads_it(written):
    original, path = written
    with np.load(path, allow_pickle=False) as file:
        assert set(file.files) == {"power", "error", "coverage", "x", "y", "metadata"}
        np.testing.assert_array_equal(file["power"], original.power.astype(np.float32))
        assert file["x"][-1] == pytest.approx(3 * SIDE)
        assert file["y"][0] == pytest.approx(2 * SIDE)
        assert json.loads(str(file["metadata"]))["f_number"] == 2.8


@pytest.mark.parametrize("written", [".fits"], indirect=True)
def test_fits_as_astropy_reads_it(written):
    """An HDU each with its unit; coordinates from the header alone, y up, the first row the top."""
    original, path = written
    with astropy.io.fits.open(path) as file:
        file.verify("exception")
        assert [hdu.name for hdu in file] == ["POWER", "ERROR", "COVERAGE", "METADATA"]
        assert [hdu.header["BUNIT"] for hdu in file[:3]] == ["W", "W", ""]
        header = file["POWER"].header
        np.testing.assert_array_equal(file["POWER"].data, original.power.astype(np.float32))
        np.testing.assert_array_equal(file["COVERAGE"].data, original.coverage.astype(np.float32))
        assert dict(file["METADATA"].data)["f_number"] == "2.8"
    assert (header["CUNIT1"], header["ROWORDER"]) == ("mm", "TOP-DOWN")
    last = [header[f"CRVAL{k}"] + header[f"CDELT{k}"] * (size - header[f"CRPIX{k}"]) for k, size in ((1, 7), (2, 5))]
    assert last == pytest.approx([3 * SIDE, -2 * SIDE])
    with astropy.io.fits.open(path, mode="update") as file:
        for hdu in file[:3]:
            hdu.data, hdu.header["ROWORDER"] = hdu.data[::-1].copy(), "BOTTOM-UP"
    read = fspt.read(path)  # turned, as another program may write it; seen to fail: upside down
    np.testing.assert_array_equal(read.power, original.power.astype(np.float32))
    np.testing.assert_array_equal(read.coverage, original.coverage.astype(np.float32))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_electrons_of_an_exposure(tmp_path, suffix):
    """Planes of another quantity go into every format, and `read` does not take them for power."""
    dim = fspt.Image(np.full((4, 4), 1e-15), metadata={"pixel_pitch": 0.0135})
    exposure = fspt.Detector.typical_ccd().expose(dim, exposure_time=60, wavelength_nm=660, seed=1)
    exposure.write(tmp_path / f"e{suffix}")
    planes, metadata = formats.read_planes(tmp_path / f"e{suffix}")
    np.testing.assert_array_equal(planes["electrons"], exposure.electrons)
    assert metadata == exposure.metadata
    with pytest.raises(ImageError, match="the values are electrons in e-, not power in W"):
        fspt.read(tmp_path / f"e{suffix}")


def foreign(path):
    """A file that another program could have written under this suffix."""
    values = np.ones((4, 4), np.float32)
    if path.suffix == ".tif":
        tifffile.imwrite(path, values)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["values"] = values
    elif path.suffix == ".npz":
        np.savez(path, values=values)
    elif path.suffix == ".fits":
        astropy.io.fits.writeto(path, values)


@pytest.mark.parametrize("suffix", [".fits", ".h5", ".npz", ".tif"])
def test_files_of_other_programs_and_damaged_ones(tmp_path, suffix, capfd, caplog):
    """One line each, without a word of the libraries'."""
    path, found = tmp_path / f"a{suffix}", []
    foreign(path)
    contents = [path.read_bytes()]
    image(64, 64).write(path)
    whole = path.read_bytes()
    for content in (*contents, b"", b"some text", whole[:60], whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(ImageError, match=r"is damaged, or no .* of an image that fspt wrote") as caught:
            fspt.read(path)
        found.append(str(caught.value))
    assert not any("\n" in message for message in found)
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_plane_that_is_missing(tmp_path, suffix):
    formats.write_planes(tmp_path / f"a{suffix}", {"coverage": np.ones((2, 2))}, {"quantity": "power", "unit": "W"})
    with pytest.raises(ImageError, match=r"has no plane of power in W \('Y' in an EXR\), it has coverage\."):
        fspt.read(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.exr.gz", ".exr"])
def test_a_wrong_suffix_names_the_list(tmp_path, name):
    (tmp_path / name).write_bytes(b"old")
    for use in (image().write, fspt.read):
        with pytest.raises(ImageError, match=r"must end in \.exr, \.fits, \.h5, \.npz or \.tif\. Give a name such as"):
            use(tmp_path / name)
    assert (tmp_path / name).read_bytes() == b"old"


@pytest.mark.parametrize(("suffix", "package"), [(".tif", "tifffile"), (".h5", "h5py"), (".fits", "astropy")])
def test_a_missing_package_names_its_extra(tmp_path, suffix, package, monkeypatch):
    """Before anything is written; the other formats do without it."""
    original, real = image(), builtins.__import__

    def without(name, *arguments, **named):
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *arguments, **named)

    monkeypatch.setattr("mitsuba_fspt.runtime.extras.import_module", lambda name: without(name))
    with pytest.raises(BackendError, match=rf"needs {package}, .* pip install 'mitsuba-fspt\[formats\]'"):
        original.write(tmp_path / f"a{suffix}")
    original.write(tmp_path / "a.npz")
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failure_half_way_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    kind = formats.format_of(path)

    def broken(path, planes, metadata):
        path.write_bytes(b"half")
        raise RuntimeError("no\nspace")

    monkeypatch.setattr(kind, "write", broken)
    with pytest.raises(ImageError, match=r"no space\. Make room"):
        image().write(path)
    assert os.listdir(tmp_path) == [path.name]
    assert path.read_bytes() == b"old"
