"""Stray light: kernels on pixels, glare, exposures, and the images that have it."""

import math
from dataclasses import replace

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.reduction import reduced
from mitsuba_fspt.detector.stray_light import Kernel, StrayLight
from mitsuba_fspt.inverse.stray_matrix import stray_light_of
from mitsuba_fspt.runtime.errors import DetectorError

CCD = replace(fspt.Detector.typical_ccd(), dark_current=0.0, full_well=1e9, pixel_pitch=None)
LIGHT = {"exposure_time": 60, "wavelength_nm": 650}
KERNEL = np.array([[0.0, 1.0, 0.0], [2.0, 10.0, 4.0], [0.0, 3.0, 5.0]])  # no symmetry


@pytest.fixture
def psf(tmp_path):
    fspt.Image(KERNEL, metadata={"pixel_pitch": 0.1}).write(tmp_path / "psf.exr")
    return tmp_path / "psf.exr"


def point(shape=(9, 11), row=4, column=5, **metadata):
    power = np.zeros(shape)
    power[row, column] = 1e-15
    return fspt.Image(power, metadata={"pixel_pitch": 0.1} | metadata)


def spread_of(camera, image):
    """Power that the electrons stand for, without noise."""
    expected = camera.expected(image, **LIGHT).mean
    return expected * image.total_power / CCD.expected(image, **LIGHT).mean.sum()


def test_a_point_becomes_the_kernel(psf):
    """Row 0 of the kernel is above, and its sum is 1. Seen to fail with the kernel turned by 180 degrees."""
    found = spread_of(replace(CCD, psf=psf), point())
    np.testing.assert_allclose(found[3:6, 4:7], 1e-15 * KERNEL / 25, atol=1e-28)
    assert found.sum() == pytest.approx(1e-15)
    corner = spread_of(replace(CCD, psf=psf), point(row=0, column=0))
    np.testing.assert_allclose(corner[:2, :2], 1e-15 * KERNEL[1:, 1:] / 25, atol=1e-28)  # the rest is lost


def test_glare_is_a_share_of_the_light_on_every_pixel(psf):
    """1 % of a point on 99 pixels. Seen to fail with g on the total in place of the mean, and without 1 − g."""
    found = spread_of(replace(CCD, veiling_glare=0.01), point())
    expected = np.full((9, 11), 1e-15 * 0.01 / 99)
    expected[4, 5] += 0.99e-15
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    both = spread_of(replace(CCD, veiling_glare=0.01, psf=psf), point())
    np.testing.assert_allclose(both, 0.99 * spread_of(replace(CCD, psf=psf), point()) + 1e-17 / 99, rtol=1e-9)


def test_an_image_of_a_part_of_the_film_lacks_the_light_from_beyond(psf, caplog):
    """A point one pixel beyond the part has 3 of 25 of its light on it in the whole image, and none in the part's.

    The line is told by `expose`, and by `invert` of a part of an exposure. Seen to fail: no word.
    """
    camera, whole = replace(CCD, psf=psf), point()
    part = whole[:4]
    assert spread_of(camera, whole)[:4].sum() == pytest.approx(3 / 25 * 1e-15)
    assert not caplog.records
    assert camera.expected(part, **LIGHT).mean.sum() == 0
    assert "expose: the image of 11 x 4 pixels is a part of a film of 11 x 9" in caplog.text
    exposed = reduced(camera.expose(whole, **LIGHT))
    caplog.clear()
    assert stray_light_of(None, [exposed], "invert")
    assert not caplog.records
    assert stray_light_of(None, [exposed[:4]], "invert")
    assert "invert: the image of 11 x 4 pixels is a part of a film of 11 x 9" in caplog.text


@pytest.mark.parametrize("count", [2, 3])
def test_a_kernel_on_coarser_pixels_is_that_of_binned_ones(tmp_path, count):
    """Light spread and binned is light binned and spread, if it is even within the bins: both to rounding."""
    rng = np.random.default_rng(1)
    fspt.Image(rng.random((7, 5)), metadata={"pixel_pitch": 0.1}).write(tmp_path / "psf.npz")
    kernel = Kernel.read(tmp_path / "psf.npz")
    even = np.zeros((10, 12))
    even[3:7, 4:8] = rng.random((4, 4))
    fine = StrayLight(kernel, 0.1).on(0.1).forward(np.kron(even, np.ones((count, count))))
    binned = fine.reshape(10, count, 12, count).sum(axis=(1, 3))
    coarse = StrayLight(kernel, 0.1).on(0.1 * count).forward(even * count**2)
    np.testing.assert_allclose(coarse, binned, rtol=1e-9, atol=1e-12)
    assert kernel.on(0.1 * count).sum() == pytest.approx(1)


def test_a_coarse_kernel_on_fine_pixels_keeps_sum_and_width(psf):
    """Cells of 0.1 mm on pixels of 0.03 mm: sum 1, centroid and variance of uniform cells within the pixel's own."""
    kernel = Kernel.read(psf)
    fine = kernel.on(0.03)
    assert fine.sum() == pytest.approx(1)
    assert min(fine.shape) % 2 == 1
    for axis in (0, 1):
        coarse_line, fine_line = KERNEL.sum(axis=1 - axis) / 25, fine.sum(axis=1 - axis)
        x, z = (np.arange(len(line)) - len(line) // 2 for line in (coarse_line, fine_line))
        mean, own = 0.1 * x @ coarse_line, 0.03 * z @ fine_line
        assert own == pytest.approx(mean, abs=1e-6)
        variance = (0.1 * x - mean) ** 2 @ coarse_line + 0.07**2 / 12
        assert (0.03 * z - own) ** 2 @ fine_line == pytest.approx(variance, rel=0.05)


def test_the_transpose_is_exact(psf):
    rng = np.random.default_rng(2)
    for glare in (0.0, 0.3):
        spread = StrayLight(Kernel.read(psf), glare).on(0.1)
        one, other = rng.random((2, 13, 8)), rng.random((2, 13, 8))
        left, right = (spread.forward(one) * other).sum(), (one * spread.backward(other)).sum()
        assert left == pytest.approx(right, rel=1e-14)


def test_it_is_recorded_and_applied_once(psf, tmp_path, caplog):
    """Of an exposed image the metadata name kernel and glare, and another exposure does not spread it again."""
    camera = replace(CCD, psf=psf, veiling_glare=0.02)
    exposure = camera.expose(point(), **LIGHT, seed=1)
    expected = {"veiling_glare": 0.02, "veiling_glare_film": "11 x 9", "psf": str(psf)}
    assert expected.items() <= exposure.metadata.items()
    exposure.write(tmp_path / "e.exr")
    found = reduced(exposure)
    assert expected.items() <= found.metadata.items()
    assert expected.items() <= camera.reduce(exposure.counts, **LIGHT).metadata.items()
    image = fspt.Image(np.maximum(found.power, 0), metadata=found.metadata)
    caplog.clear()
    again = camera.expose(image, **LIGHT, seed=2)
    assert [r.getMessage().count("it is not applied again") for r in caplog.records] == [1]
    assert again.electrons[4, 5] == pytest.approx(exposure.electrons[4, 5], rel=0.05)
    with pytest.raises(DetectorError, match="has the stray light of another detector already"):
        replace(camera, veiling_glare=0.01).expose(image, **LIGHT)
    binned = camera.expose(point((8, 12)), **LIGHT, binning=2)
    assert binned.metadata["veiling_glare_film"] == "6 x 4"
    with pytest.raises(DetectorError, match=r"of 4 x 9 pixels is a part of the film, 11 x 9"):
        StrayLight.of(image[:, 3:7].metadata, (9, 4))


def test_kernels_that_cannot_be_used(tmp_path, psf):
    for name, values, words in (
        ("negative", KERNEL - 1, "must be finite and >= 0"),
        ("none", 0 * KERNEL, "not 0 everywhere"),
    ):
        fspt.Image(values, metadata={"pixel_pitch": 0.1}).write(tmp_path / f"{name}.exr")
        with pytest.raises(DetectorError, match=words) as caught:
            replace(CCD, psf=tmp_path / f"{name}.exr")
        assert "\n" not in str(caught.value)
    np.savez(tmp_path / "nan.npz", power=np.full((3, 3), np.nan), metadata='{"pixel_pitch": 0.1}')
    fspt.Image(KERNEL).write(tmp_path / "pitch.exr")
    for name, words in (
        ("nan.npz", "must be finite and >= 0"),
        ("pitch.exr", "does not state its pitch"),
        ("missing.exr", "does not exist"),
    ):
        with pytest.raises(DetectorError, match=words):
            replace(CCD, psf=tmp_path / name)
    with pytest.raises(DetectorError, match="'psf' must be the name of an image file, got 3"):
        replace(CCD, psf=3)
    with pytest.raises(DetectorError, match="'psf' needs the image's 'pixel_pitch'"):
        replace(CCD, psf=psf).expose(fspt.Image(np.ones((4, 4))), **LIGHT)
    for value in (1.0, -0.1, math.nan):
        with pytest.raises(DetectorError, match=r"'veiling_glare' must be finite and in \[0, 1\)"):
            replace(CCD, veiling_glare=value)


def test_kernels_of_fits_files_of_other_programs(tmp_path, caplog):
    fits = pytest.importorskip("astropy.io.fits")
    hdu = fits.PrimaryHDU(KERNEL)
    hdu.header["XPIXSZ"] = 100.0
    hdu.writeto(tmp_path / "psf.fits")
    kernel = Kernel.read(tmp_path / "psf.fits")
    assert "psf.fits' has no ROWORDER" in caplog.text  # seen to fail: its first row was the top one without a word
    assert kernel.pitch == pytest.approx(0.1)
    np.testing.assert_allclose(kernel.on(0.1), KERNEL / 25)
    hdu.header["YPIXSZ"] = 200.0
    hdu.writeto(tmp_path / "psf.fits", overwrite=True)
    with pytest.raises(DetectorError, match=r"psf.fits': has pixels of 0.1 x 0.2 mm. Give square"):
        Kernel.read(tmp_path / "psf.fits")


def test_toml_both_ways(psf, tmp_path):
    camera = replace(CCD, psf=psf, veiling_glare=0.02)
    camera.to_toml(tmp_path / "camera.toml")
    text = (tmp_path / "camera.toml").read_text()
    assert fspt.Detector.from_toml(tmp_path / "camera.toml") == camera
    (tmp_path / "camera.toml").write_text(text.replace(str(psf), "psf.exr"))
    assert fspt.Detector.from_toml(tmp_path / "camera.toml") == camera
