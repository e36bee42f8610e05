"""Counts to power: expose then reduce, frames through ccdproc, files, masks, calibration by a uniform source."""

from __future__ import annotations

import logging
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import camera_scene, disk

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.counts import Counts, counts_of, read_counts
from mitsuba_fspt.detector.detector import Detector
from mitsuba_fspt.detector.reduction import Corrections, Exposed, calibrated, read_measured, reduce_counts, reduced
from mitsuba_fspt.images.comparison import compare
from mitsuba_fspt.images.image import Image, read
from mitsuba_fspt.images.noise_model import NoiseModel
from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.optics.thin_lens import Lens
from mitsuba_fspt.optics.uniform_source import uniform_power
from mitsuba_fspt.runtime.errors import DetectorError, ImageError

CCD = Detector.typical_ccd()
SETTINGS = {"exposure_time": 60.0, "wavelength_nm": 650.0}
SENSOR = {"flat_kind": "sensor", "flat_dark": 0}  # of a flat field free of bias
PER_WATT = 0.85 * 60 * 650e-9 / (6.62607015e-34 * 299792458.0)


def ramp(most=500.0, size=32):
    """Image of 0 … `most` electrons of the CCD."""
    return Image(np.outer(np.linspace(0, most, size), np.ones(size)) / PER_WATT, metadata={"pixel_pitch": 0.0135})


def test_expose_then_reduce_is_within_its_errors():
    """400 seeds: the mean is right to four standard errors, and the scatter over the stated error is 1 on each level.

    Seen to fail without the bias or the gain (mean), and without the read noise (scatter).
    """
    image = ramp()
    found = [CCD.reduce(CCD.expose(image, 60, 650, seed=s).counts, **SETTINGS, pixel_pitch=0.0135) for s in range(400)]
    power = np.array([f.power for f in found], np.float64)
    k = found[0].metadata["electrons_per_watt"]
    assert k == pytest.approx(PER_WATT, rel=1e-12)
    variance = image.power * k + 3.5**2 + found[0].metadata["dark_electrons"]
    z = (power - image.power) * k / np.sqrt(variance)
    assert abs(z.mean()) < 4 / math.sqrt(z.size)
    assert (z**2).mean() == pytest.approx(1, abs=4 * math.sqrt(2 / z.size))
    stated = np.mean([((f.power - image.power)[16:] / f.error[16:]) ** 2 for f in found])
    assert stated == pytest.approx(1, abs=0.01)


def test_stacks_and_frames():
    """Five frames, a dark stack with a pattern and a flat field that falls by a third: χ² of the reduced image is 1.

    Seen to fail without the flat field, without the dark frame, without the noise of the dark frame and without the
    number of frames.
    """
    pytest.importorskip("ccdproc")
    image = ramp(2000.0, 64)
    flat = 1 + 0.2 * np.outer(np.ones(64), np.linspace(-1, 1, 64))
    seen = Image(image.power * flat, metadata=image.metadata)
    pattern = (20 * np.random.default_rng(1).standard_normal((64, 64))).astype(int)  # of the bias [DN]
    stack = pattern + np.array([CCD.expose(seen, 60, 650, seed=s).counts for s in range(5)])
    dark = pattern + np.array([CCD.expose(Image(0 * image.power), 60, 650, seed=90 + s).counts for s in range(5)])
    found = CCD.reduce(stack, **SETTINGS, pixel_pitch=0.0135, dark=dark, flat=1e4 * flat, **SENSOR)
    chi2 = (((found.power - image.power) / found.error) ** 2)[8:].mean()
    assert chi2 == pytest.approx(1, abs=0.08)
    one = CCD.reduce(stack[0], **SETTINGS, pixel_pitch=0.0135)
    assert found.metadata["electrons_per_watt"] == pytest.approx(5 * one.metadata["electrons_per_watt"])


def test_the_noise_of_a_stack_of_flat_fields_counts():
    """Two flat fields of 1000 electrons under counts of 50,000: χ² of the reduced image is 1.

    Seen to fail (27) without the noise of the flat fields, and (0.53) with that of a single one.
    """
    pytest.importorskip("ccdproc")
    image = Image(np.full((64, 64), 5e4 / PER_WATT))
    flat = np.random.default_rng(7).poisson(1000, (2, 64, 64)) / CCD.gain
    found = CCD.reduce(CCD.expose(image, 60, 650, seed=1).counts, **SETTINGS, flat=flat, **SENSOR)
    chi2 = ((found.power - image.power) / found.error) ** 2
    assert chi2.mean() == pytest.approx(1, abs=4 * math.sqrt(2 / chi2.size))
    alone = CCD.reduce(CCD.expose(image, 60, 650, seed=1).counts, **SETTINGS, flat=flat.mean(axis=0), **SENSOR)
    assert alone.error.mean() == pytest.approx(np.sqrt(5e4) / PER_WATT, rel=0.01)


def test_errors_follow_the_flat_field():
    """A flat field of 0.3 … 1.7: χ² of the reduced image is 1 on the dark, the middle and the bright third alike.

    The image contains the flat field. Seen to fail (0.55 and 1.6) with electrons per watt of the mean pixel.
    """
    pytest.importorskip("ccdproc")
    image = Image(np.full((60, 60), 400.0) / PER_WATT, metadata={"pixel_pitch": 0.0135})
    flat = 1 + 0.7 * np.outer(np.ones(60), np.linspace(-1, 1, 60))
    seen = Image(image.power * flat, metadata=image.metadata)
    thirds = []
    for seed in range(20):
        counts = CCD.expose(seen, 60, 650, seed=seed).counts
        found = CCD.reduce(counts, **SETTINGS, pixel_pitch=0.0135, flat=1e4 * flat, **SENSOR)
        squares = ((found.power - image.power) / found.error) ** 2
        thirds.append([part.mean() for part in np.array_split(squares, 3, axis=1)])
    np.testing.assert_allclose(np.mean(thirds, axis=0), 1, atol=0.05)
    np.testing.assert_allclose(found.flat, flat, rtol=1e-5)


def test_a_number_in_place_of_a_dark_frame():
    """It is subtracted in place of bias and dark current, without noise of its own."""
    pytest.importorskip("ccdproc")
    counts = CCD.expose(Image(np.full((16, 16), 1e-12)), 60, 650, seed=1).counts
    found = CCD.reduce(counts, **SETTINGS, dark=510)
    frame = CCD.reduce(counts, **SETTINGS, dark=np.full((16, 16), 510.0))
    np.testing.assert_allclose(found.power, frame.power)
    assert found.metadata["dark_electrons"] < frame.metadata["dark_electrons"]
    with pytest.raises(DetectorError, match="'dark' must be >= 0 DN"):
        CCD.reduce(counts, **SETTINGS, dark=-1)


def test_dark_charge_and_frames_add_their_noise():
    """No light: 30 electrons of dark charge, its mean subtracted or a dark frame, stacks, rounding: χ² of pixels is 1.

    Seen to fail without the charge's variance, that of the dark frame, that of the rounding, and with the read noise of
    one frame for that of four.
    """
    pytest.importorskip("ccdproc")
    warm = replace(CCD, dark_current=0.5)
    quiet = replace(CCD, dark_current=0.0, read_noise=1.0)
    settings = SETTINGS | {"pixel_pitch": 0.0135}
    image = Image(np.zeros((64, 64)), metadata={"pixel_pitch": 0.0135})
    for camera, frames, given in ((warm, 1, {}), (warm, 1, {"dark": True}), (warm, 4, {}), (quiet, 4, {})):
        counts = np.array([camera.expose(image, 60, 650, seed=s).counts for s in range(frames)])
        if given:
            given = {"dark": camera.expose(image, 60, 650, seed=99).counts}
        found = camera.reduce(counts, **settings, **given)
        per_watt, read, dark = (found.metadata[n] for n in ("electrons_per_watt", "read_noise", "dark_electrons"))
        chi2 = ((found.power.astype(float) * per_watt) ** 2).mean() / (read**2 + dark)
        assert chi2 == pytest.approx(1, abs=4 * (2 / 4096) ** 0.5)


@pytest.mark.parametrize("frames", [1, 16])
def test_the_charge_of_hot_pixels_in_a_dark_frame_has_its_noise(frames, caplog):
    """5 % of the pixels have 2000 electrons in the dark, which the numbers do not know: χ² is 1 on them and the others.

    It was some 170 on them. A bias that has drifted by 4 DN changes nothing and is not reported.
    """
    pytest.importorskip("ccdproc")
    rng = np.random.default_rng(3)
    hot = rng.random((64, 64)) < 0.05
    charge = np.where(hot, 2000.0, 0.06)

    def counts(drift, number):
        electrons = rng.poisson(np.broadcast_to(charge, (number, 64, 64))) + rng.normal(0, 3.5, (number, 64, 64))
        return np.rint(500 + drift + electrons / 1.6)

    for drift in (0, 4):
        found = CCD.reduce(counts(drift, 1)[0], **SETTINGS, dark=counts(drift, frames))
        chi2 = np.square(found.power.astype(float)) / NoiseModel.of(found).dark
        assert chi2[hot].mean() == pytest.approx(1, abs=4 * (2 / hot.sum()) ** 0.5)
        assert chi2[~hot].mean() == pytest.approx(1, abs=4 * (2 / np.sum(~hot)) ** 0.5)
    assert not caplog.messages


def test_the_noise_of_a_bias_frame_makes_no_pixel_hot():
    """Mean of 100 dark frames, one bias frame: 15 % of the pixels were hot by the noise of the latter."""
    pytest.importorskip("ccdproc")
    rng = np.random.default_rng(3)
    quiet = replace(CCD, dark_current=0.0, read_noise=1.0, gain=0.5)
    light, bias, *darks = np.rint(500 + rng.normal(0, 2, (102, 64, 64)))
    found = quiet.reduce(light, **SETTINGS, bias=bias, dark=np.array(darks))
    assert np.ptp(NoiseModel.of(found).dark) == 0


def test_the_charge_of_a_warm_camera_in_a_dark_frame_has_its_noise(caplog):
    """100 electrons a pixel in the dark, which the numbers do not know: χ² is 1, it was 8, and one line says so.

    It says so, too, where a number stands for the frame.
    """
    pytest.importorskip("ccdproc")
    warm, dark = replace(CCD, dark_current=100 / 60), Image(np.zeros((64, 64)))
    frames = np.array([warm.expose(dark, 60, 650, seed=k).counts for k in range(5)], float)
    for given in (frames[1:], float(frames[1:].mean())):
        caplog.clear()
        found = CCD.reduce(frames[0], **SETTINGS, dark=given)
        chi2 = np.square(found.power.astype(float)) / NoiseModel.of(found).dark
        assert chi2.mean() == pytest.approx(1, abs=4 * (2 / 4096) ** 0.5)
        (line,) = caplog.messages
        assert re.search(r"the dark frame has (99|100|101)(\.\d)? electrons more than bias and dark current", line)
    caplog.clear()  # with a bias frame, the number of the bias does not matter
    replace(warm, bias=0).reduce(frames[0], **SETTINGS, dark=frames[1:], bias=np.full((64, 64), 500.0))
    assert not caplog.messages


def test_a_total_below_zero_is_reported(caplog):
    """Dark frames scatter about 0 and say nothing; counts 40 DN below the bias are reported."""
    dark = np.random.default_rng(5).normal(CCD.bias, CCD.read_noise / CCD.gain, (32, 32))
    CCD.reduce(dark, **SETTINGS)
    assert not caplog.records
    CCD.reduce(dark - 40, **SETTINGS)
    assert [record.getMessage().count("standard deviations below 0") for record in caplog.records] == [1]


@pytest.mark.parametrize("name", ["dark", "bias", "flat_dark"])
def test_a_frame_without_the_bias_is_told(name, caplog):
    """As other programs write darks. Seen to fail: the image is 500 DN a pixel too bright without a word.

    Nothing is told of frames as they are read out, nor of counts that have lost the bias, too.
    """
    raw = CCD.expose(ramp(), 60, 650, seed=1).counts.astype(float)
    frame = 500 + np.random.default_rng(2).normal(0, 2.2, raw.shape)
    flat = {"flat": np.full(raw.shape, 20500, np.uint16), "flat_kind": "sensor", "flat_dark": 500 + 0 * frame}
    CCD.reduce(raw, **SETTINGS, **{"dark": frame} | flat | {name: frame})
    assert not caplog.records
    if name != "flat_dark":
        CCD.reduce(raw - 500, **SETTINGS, **{name: frame - 500})
        assert not [record for record in caplog.records if "is 500 DN below" in record.getMessage()]
    CCD.reduce(raw, **SETTINGS, **{"dark": frame} | flat | {name: frame - 500})
    assert f"'{name}' is 500 DN below the bias of the detector, 500 DN" in caplog.text


@pytest.mark.parametrize(
    ("most", "times", "told"), [(0.0, (60, 60), 0), (3.0, (60,) * 40, 0), (3e4, (60, 60), 0), (300.0, (60, 120), 1)]
)
def test_frames_of_unequal_light_are_told(most, times, told, caplog):
    """One frame of a stack was exposed for twice the time: the power was 1.5 times too large, without a word.

    Frames of equal light are not told: without any, faint, and with the noise of many electrons.
    """
    frames = [CCD.expose(ramp(most), time, 650, seed=k).counts for k, time in enumerate(times)]
    found = CCD.reduce(np.stack(frames), **SETTINGS)
    assert caplog.text.count("frames of the counts have not the same light") == told
    if told:
        assert found.power.sum() == pytest.approx(1.5 * ramp(most).power.sum(), rel=0.02)
        assert "in frame 0, " in caplog.text
        assert "DN in frame 1. The image is that of their mean" in caplog.text


def test_a_cosmic_ray_and_a_drift_of_the_offset_are_no_other_light(caplog):
    """Seen to fail with the mean of all pixels, and with the noise of the frames alone."""
    frames = np.stack([CCD.expose(ramp(0.3, 128), 60, 650, seed=k).counts for k in range(2)]).astype(np.float64)
    frames[1] += 0.9
    frames[1, 3, 4] += 5e4
    CCD.reduce(frames, **SETTINGS)
    assert "not the same light" not in caplog.text


def test_saturated_pixels_are_masked_not_clipped():
    counts = np.full((4, 5), 1000, np.uint16)
    counts[1, 2], counts[3, 4] = 65535, 500 + 62500
    found = CCD.reduce(counts, **SETTINGS)
    assert np.argwhere(found.mask).tolist() == [[1, 2], [3, 4]]
    assert found.metadata["masked_pixels"] == 2
    stack = np.stack([np.full((4, 5), 1000), counts])
    assert CCD.reduce(stack, **SETTINGS).mask.sum() == 2  # in one frame of two


def test_an_image_of_masked_pixels_alone_is_told(caplog):
    """All pixels saturated: the image had 0 W, without a word."""
    with caplog.at_level(logging.WARNING):
        found = fspt.Detector.typical_ccd().reduce(np.full((4, 5), 65535), exposure_time=60, wavelength_nm=650)
    assert found.masked == 20
    assert "20 masked" in repr(found)
    assert "reduce: all pixels are masked" in caplog.text


def test_cosmic_rays_are_masked():
    pytest.importorskip("ccdproc")
    image = Image(np.full((48, 48), 100 / PER_WATT))
    counts = CCD.expose(image, 60, 650, seed=3).counts.copy()
    counts[20, 30] += 2000
    found = CCD.reduce(counts, **SETTINGS, cosmic_rays=True)
    assert found.mask[20, 30]
    assert found.mask.sum() < 10


def test_exposures_reduce_by_their_own_numbers(tmp_path):
    """From memory and from the EXR of `expose` alike; binned pixels have the dark current of their area."""
    exposure = replace(CCD, dark_current=0.5).expose(ramp(), 60, 650, binning=2, seed=1)
    exposure.write(tmp_path / "e.exr")
    one, other = reduced(exposure), read_measured(tmp_path / "e.exr")
    np.testing.assert_array_equal(one.power, other.power)
    k = one.metadata["electrons_per_watt"]
    np.testing.assert_allclose(one.power * k, exposure.electrons - 4 * 0.5 * 60, rtol=1e-6, atol=1e-4)
    assert one.metadata["dark_electrons"] == pytest.approx(120)
    one.write(tmp_path / "p.exr")
    again = read(tmp_path / "p.exr")
    assert again.mask.dtype == bool
    for name in ("electrons_per_watt", "read_noise", "dark_electrons", "gain_error"):
        assert again.metadata[name] == one.metadata[name]


def test_numbers_of_the_noise_are_attributes():
    """k = η t λ/(h c), read noise of one frame 3.5 e-, gain error of the detector; a render has none of them."""
    found = replace(CCD, gain_error=0.03).reduce(CCD.expose(ramp(), 60, 650).counts, **SETTINGS)
    assert found.electrons_per_watt == pytest.approx(PER_WATT, rel=1e-12)
    assert (found.read_noise, found.gain_error) == (3.5, 0.03)
    assert (ramp().electrons_per_watt, ramp().read_noise, ramp().gain_error) == (None, None, None)


def test_files(tmp_path):
    """TIFF, a stack, FITS with EXPTIME, NPY and a click folder give the image of the array."""
    tifffile, fits = pytest.importorskip("tifffile"), pytest.importorskip("astropy.io.fits")
    counts = CCD.expose(ramp(), 60, 650, seed=1).counts
    expected = CCD.reduce(counts, **SETTINGS).power
    tifffile.imwrite(tmp_path / "a.tif", counts)
    fits.PrimaryHDU(counts).writeto(tmp_path / "a.fits")
    np.save(tmp_path / "a.npy", counts)
    for name in ("a.tif", "a.fits", "a.npy"):
        np.testing.assert_array_equal(CCD.reduce(tmp_path / name, **SETTINGS).power, expected)
    click = tmp_path / "click"
    click.mkdir()
    tifffile.imwrite(click / "luminescent.TIF", counts)
    tifffile.imwrite(click / "readbiasonly.TIF", np.full(counts.shape, 500, np.uint16))
    (click / "ClickInfo.txt").write_text("Camera:\tIVIS\nLuminescent Exposure Seconds:\t60\n")
    pytest.importorskip("ccdproc")
    np.testing.assert_allclose(CCD.reduce(click, **SETTINGS).power, expected, atol=1e-22)
    assert read_counts(click).exposure_time == 60


def test_another_exposure_time_in_the_file_is_reported(tmp_path, caplog):
    """EXPTIME of 60 s says nothing beside 60 s, and one line beside 30 s, which are used. So does EGAIN."""
    fits = pytest.importorskip("astropy.io.fits")
    hdu = fits.PrimaryHDU(CCD.expose(ramp(), 60, 650, seed=1).counts)
    hdu.header.update({"EXPTIME": 60.0, "ROWORDER": "TOP-DOWN", "EGAIN": 1.55})
    hdu.writeto(tmp_path / "a.fits")
    CCD.reduce(tmp_path / "a.fits", **SETTINGS)
    assert not caplog.records
    replace(CCD, gain=0.8).reduce(tmp_path / "a.fits", **SETTINGS)
    assert "'gain' is 0.8 e-/DN, the file of the counts states 1.55 e-/DN. The former is used" in caplog.text
    caplog.clear()
    found = CCD.reduce(tmp_path / "a.fits", exposure_time=30, wavelength_nm=650)
    assert found.electrons_per_watt == pytest.approx(PER_WATT / 2)
    (told,) = [record.getMessage() for record in caplog.records]
    assert "'exposure_time' is 30 s, the file of the counts states 60 s. The former is used" in told


def test_metadata_of_pixels_before_binning():
    """Rationale: of a uniform surface the radiance is the same on pixels of 0.2 mm and, binned, of 0.4 mm.

    The metadata are those of the exposure, whose dark current of four own pixels counts, or of the part of the rendered
    image that was exposed. Seen to fail: 360 electrons too much on each pixel by the former, four times the radiance at
    other places by the latter. Without a pitch of the detector's own or the file nothing says which pixels the metadata
    mean. Seen to fail: that refusal although the file states the pitch, and a crop window 2.5 % smaller.
    """
    lens = {"focal_length": 55.0, "f_number": 2.8, "focus_distance": 165.0, "magnification": 0.5, "pixel_pitch": 0.2}
    camera = replace(CCD, pixel_pitch=0.2, dark_current=2.0, full_well=1e9, prnu=0.0)
    whole = Image(np.full((12, 16), 5000 / PER_WATT), metadata=lens)
    part, expected = whole[2:10, 4:12], whole.roi(None, 650)
    exposure = camera.expose(part, 60, 650, binning=2, seed=1)
    given = {"exposure_time": 60, "wavelength_nm": 650}
    for options in ({"metadata": exposure.metadata}, {"metadata": part.metadata, "binning": 2}):
        found = camera.reduce(exposure.counts, **given, **options)
        assert found.metadata["binning"] == 2
        np.testing.assert_allclose(found.x, (part.x[::2] + part.x[1::2]) / 2, atol=1e-9)
        assert found.roi(None, 650).mean_radiance == pytest.approx(expected.mean_radiance, rel=5e-3)
    other, own = replace(camera, pixel_pitch=None), {"binning": 2, "metadata": part.metadata}
    with pytest.raises(DetectorError, match=r"'binning' is 2, the 'pixel_pitch' = 0.2 mm of the metadata is that of"):
        other.reduce(exposure.counts, **given, **own)
    # The pitch of the file, and one that was measured anew, which moves no pixel.
    for pitch, options in ((0.4, {}), (0.41, {"pixel_pitch": 0.41})):
        stated = Counts(exposure.counts, binning=2, pixel_pitch=0.4)
        found = other.reduce(stated, **given, metadata=part.metadata, **options)
        np.testing.assert_allclose(found.x * 0.4 / pitch, (part.x[::2] + part.x[1::2]) / 2, atol=1e-9)


def test_another_binning_or_pitch_than_that_of_the_file_is_told(tmp_path, caplog):
    """The dark current of 5 e-/px/s counts once, four times or as often as the pitch says, each with a line.

    Seen to fail: 4500 electrons too much by binning=1 in place of the file's 2, without a word.
    """
    fits = pytest.importorskip("astropy.io.fits")
    header = fits.Header({"EXPTIME": 300.0, "XBINNING": 2, "XPIXSZ": 27.0, "ROWORDER": "TOP-DOWN"})
    counts = np.full((3, 4), 500 + (5 * 300 * 4 + 16000) / 1.6)
    fits.PrimaryHDU(counts.astype(np.uint16), header).writeto(tmp_path / "a.fits")
    camera = replace(CCD, dark_current=5.0)
    for given, electrons, told in (
        ({}, 16000, []),
        ({"binning": 1}, 20500, ["'binning' is 1, the file of the counts states 2", "'pixel_pitch' is 0.0135 mm"]),
        (
            {"pixel_pitch": 0.0135},
            20500,
            ["the file of the counts states 0.027 mm", "that of the detector times the binning of 2 is 0.027 mm. The"],
        ),
    ):
        caplog.clear()
        found = camera.reduce(tmp_path / "a.fits", exposure_time=300, wavelength_nm=650, **given)
        np.testing.assert_allclose(found.power * found.electrons_per_watt, electrons, rtol=1e-6)
        assert len(caplog.messages) == len(told)
        assert all(part in line for part, line in zip(told, caplog.messages, strict=True))


def test_rows_of_fits_files(tmp_path, caplog):
    """ROWORDER = BOTTOM-UP turns the rows over, a binning that is not square is refused, and colour, too.

    One line says that rows are turned, or that the header leaves it open. Seen to fail: neither was told.
    """
    fits = pytest.importorskip("astropy.io.fits")
    counts = np.arange(12, dtype=np.uint16).reshape(3, 4)
    for order, rows in (("TOP-DOWN", counts), ("BOTTOM-UP", counts[::-1])):
        hdu = fits.PrimaryHDU(counts)
        hdu.header["ROWORDER"] = order
        hdu.writeto(tmp_path / "a.fits", overwrite=True)
        np.testing.assert_array_equal(read_counts(tmp_path / "a.fits").values, rows)
        assert ("it is turned" in caplog.text) == (order == "BOTTOM-UP")
    fits.PrimaryHDU(counts).writeto(tmp_path / "open.fits")
    np.testing.assert_array_equal(read_counts(tmp_path / "open.fits").values, counts)
    CCD.reduce(tmp_path / "open.fits", **SETTINGS)
    assert caplog.text.count("has no ROWORDER of TOP-DOWN or BOTTOM-UP; its first row is taken for the top one") == 1
    hdu.header.update({"XBINNING": 1, "YBINNING": 2})
    hdu.writeto(tmp_path / "a.fits", overwrite=True)
    with pytest.raises(ImageError, match="binned 1 x 2"):
        read_counts(tmp_path / "a.fits")
    with pytest.raises(ImageError, match="got uint16 of shape"):
        CCD.reduce(np.ones((20, 30, 3), np.uint16), **SETTINGS)


@pytest.mark.parametrize("name", ["bias", "dark", "flat", "bad_pixels"])
@pytest.mark.parametrize("turned", ["counts", "frame"])
def test_frames_of_another_order_of_rows_than_the_counts_are_refused(tmp_path, name, turned):
    """One file is turned by its ROWORDER, the other states none. Seen to fail: up to twice the brightest pixel off."""
    fits = pytest.importorskip("astropy.io.fits")
    files = {}
    for kind in ("counts", "frame"):
        hdu = fits.PrimaryHDU(np.arange(100, 112, dtype=np.uint16).reshape(3, 4))
        if kind == turned:
            hdu.header["ROWORDER"] = "BOTTOM-UP"
        files[kind] = tmp_path / f"{kind}.fits"
        hdu.writeto(files[kind])
    kind = {"flat_kind": "sensor"} if name == "flat" else {}
    with pytest.raises(DetectorError, match=r"has no ROWORDER, '.*' is BOTTOM-UP"):
        CCD.reduce(files["counts"], exposure_time=60, wavelength_nm=650, **{name: files["frame"]}, **kind)


@pytest.mark.parametrize("turned", ["counts", "frame"])
def test_tiff_frames_without_the_orientation_of_the_counts_are_refused(tmp_path, turned):
    """Of counts and dark frame one is turned by its Orientation, the other has no such tag; 1 is a tag.

    Seen to fail: the dark frame of other rows was subtracted, 400 DN too much in one row and too little in another.
    """
    tifffile = pytest.importorskip("tifffile")
    dark = np.repeat(np.arange(500, 1000, 100, dtype=np.uint16)[:, None], 4, axis=1)

    def file(name, values, orientation):
        tags = [] if orientation is None else [(274, 3, 1, orientation, True)]
        stored = values[::-1] if orientation == 4 else values
        tifffile.imwrite(path := tmp_path / f"{name}.tif", stored, extratags=tags)
        return path

    def reduced(counts, frame):
        return CCD.reduce(file("counts", dark + 50, counts), **SETTINGS, dark=file("dark", dark, frame))

    pair = (4, None) if turned == "counts" else (None, 4)
    with pytest.raises(DetectorError, match=r"has no Orientation, '.*' was turned by its Orientation.*in both files"):
        reduced(*pair)
    for good in ((4, 4), (None, None), (4, 1), (1, None)):
        np.testing.assert_array_equal(np.ptp(reduced(*good).power), 0)


@pytest.mark.parametrize("name", ["read_noise", "flat_dark", "second counts"])
def test_maps_and_frames_of_frames_have_the_rows_of_their_counts(tmp_path, caplog, name):
    """A map of the detector, the dark of a flat, and a flat of counts that are no longer the first ones.

    Of each pair one is turned and the other does not state its rows. Seen to fail: none was refused. Turned both, they
    give what untouched ones give.
    """
    fits, _ = pytest.importorskip("astropy.io.fits"), pytest.importorskip("ccdproc")
    counts, frame = np.arange(900, 912, dtype=np.uint16).reshape(3, 4), np.arange(600, 612.0).reshape(3, 4)

    def file(values, *, turned):
        kind = "turned" if turned else "open"
        hdu = fits.PrimaryHDU(values[::-1] if turned else values)
        if turned:
            hdu.header["ROWORDER"] = "BOTTOM-UP"
        hdu.writeto(path := tmp_path / f"{kind}{values[0, 0]:g}.fits", overwrite=True)
        return path

    def reduced_by(turned, other):
        light, frames = (file(values, turned=turned) for values in (counts, frame.astype(np.uint16)))
        if name == "read_noise":
            return replace(CCD, read_noise=file(frame, turned=other)).reduce(light, **SETTINGS).error
        if name == "flat_dark":
            dark = {"flat": frames, "flat_dark": file(frame - 500, turned=other), "flat_kind": "sensor"}
            return CCD.reduce(file(counts, turned=turned), **SETTINGS, **dark).power
        applied = Corrections(flat=frames, flat_kind="sensor", flat_dark=0)
        exposed = Exposed(60, Light(650, None))
        applied = replace(applied, flat=applied.flat_field(CCD, read_counts(light), exposed))
        return reduce_counts(CCD, read_counts(file(counts, turned=other)), exposed, applied).power

    for turned in (True, False):
        with pytest.raises(DetectorError, match=r"has no ROWORDER, '.*' is BOTTOM-UP"):
            reduced_by(turned, not turned)
    np.testing.assert_array_equal(reduced_by(True, True), reduced_by(False, False))


@pytest.mark.parametrize("wrong", ["60.0 s", "", "inf", True, -1.5])
def test_a_keyword_that_is_no_number_is_left_out(tmp_path, caplog, wrong):
    """Of an exposure time and a binning. Seen to fail: the file was refused as damaged, with the fix to copy it; a
    logical T was 1 s, and a binning of -1.5 was -1.
    """
    fits = pytest.importorskip("astropy.io.fits")
    header = fits.Header({"EXPTIME": wrong, "XBINNING": wrong, "XPIXSZ": 13.5})
    fits.PrimaryHDU(np.ones((3, 4), np.uint16), header).writeto(tmp_path / "a.fits")
    found = read_counts(tmp_path / "a.fits")
    assert (found.exposure_time, found.binning, found.pixel_pitch) == (None, None, 0.0135)
    assert f"EXPTIME = {wrong!r} is no number >= 0 of seconds; it is left out" in caplog.text
    assert f"XBINNING = {wrong!r} is no whole number >= 1; it is left out" in caplog.text


def test_sides_of_pixels_in_fits_files(tmp_path, caplog):
    """One of two keywords is enough; sides that differ by more than rounding are refused where no pitch is given.

    Seen to fail: YBINNING = 2 alone was no binning, 13.5 × 27 µm were passed over, and so were 13.5 × 13.50001; later
    they were refused beside a given pitch, too, and in frames of which no pitch is used.
    """
    fits = pytest.importorskip("astropy.io.fits")

    def read(**header):
        fits.PrimaryHDU(np.ones((3, 4), np.uint16), fits.Header(header)).writeto(tmp_path / "a.fits", overwrite=True)
        found = read_counts(tmp_path / "a.fits")
        return found.binning, found.pixel_pitch

    assert read(YBINNING=2, YPIXSZ=27.0) == (2, 0.027)
    assert read(XBINNING=1.0, XPIXSZ=13.5, YPIXSZ=13.50001) == (1, 0.0135)
    assert read(XPIXSZ=0.0) == (None, None)
    assert read(XPIXSZ=13.5, YPIXSZ=27.0) == (None, None)
    path, camera = tmp_path / "a.fits", replace(CCD, pixel_pitch=None)
    with pytest.raises(ImageError, match=r"states pixels of 0.0135 x 0.027 mm"):
        camera.reduce(path, **SETTINGS)
    caplog.clear()
    found = camera.reduce(path, **SETTINGS, pixel_pitch=0.02, bias=path)
    assert found.metadata["pixel_pitch"] == 0.02
    assert "'pixel_pitch' is 0.02 mm, the file of the counts states 0.0135 x 0.027 mm. The former" in caplog.messages[0]


def test_counts_in_another_unit_or_with_a_sign_too_many(tmp_path, caplog):
    """BUNIT = electron is told: the power was too large by the gain of 1.6 without a word. 40000 DN that were stored in
    16 bits with a sign are -25536, which is refused; seen to fail: a pixel of negative power, not saturated.
    """
    fits = pytest.importorskip("astropy.io.fits")
    for unit, told in (("adu", 0), ("electron", 1)):
        header = fits.Header({"BUNIT": unit, "ROWORDER": "TOP-DOWN"})
        fits.PrimaryHDU(np.ones((3, 4), np.uint16), header).writeto(tmp_path / f"{unit}.fits")
        CCD.reduce(tmp_path / f"{unit}.fits", **SETTINGS)
        assert caplog.text.count("states the unit 'electron' (BUNIT); its values are taken for DN") == told
    counts = np.full((3, 4), 1000, np.uint16)
    counts[1, 2] = 40000
    np.save(tmp_path / "wrapped.npy", counts.view(np.int16))
    with pytest.raises(ImageError, match="go down to -25536: those above 32767 have lost 65536"):
        CCD.reduce(tmp_path / "wrapped.npy", **SETTINGS)
    counts = counts.view(np.int16)
    counts[:2, 2] = -32768  # seen to fail: told as wrapped, too
    with pytest.raises(ImageError, match=r"hold 2 values of -32768, which marks pixels without a value. Replace them"):
        CCD.reduce(counts, **SETTINGS)


def test_blank_pixels_of_unsigned_counts_are_refused(tmp_path):
    """Counts of 16 bits without a sign, of which one is BLANK. Seen to fail: 32775 DN of light on that pixel."""
    fits = pytest.importorskip("astropy.io.fits")
    hdu = fits.PrimaryHDU(np.arange(12, dtype=np.uint16).reshape(3, 4) + 32768)
    hdu.writeto(tmp_path / "a.fits")
    for blank, held in ((99, False), (7, True)):
        with fits.open(tmp_path / "a.fits", do_not_scale_image_data=True) as file:
            file[0].header["BLANK"] = blank
            file.writeto(tmp_path / "b.fits", overwrite=True)
        if held:
            with pytest.raises(ImageError, match="hold 1 NaN"):
                read_counts(tmp_path / "b.fits")
        else:
            assert read_counts(tmp_path / "b.fits").raw


@pytest.mark.parametrize("given", [lambda e: e, lambda e: [e, e], lambda e: ramp()])
def test_an_image_in_memory_is_no_counts(given):
    """As its file is none. Seen to fail: electrons were taken for DN, without their bias and gain."""
    exposure = CCD.expose(ramp(), 60, 650, seed=1)
    assert CCD.reduce(exposure.counts, exposure_time=60, wavelength_nm=650).power.max() > 0
    with pytest.raises(ImageError, match=r"'counts' must be counts \[DN\], got an (Exposure|Image), which holds"):
        CCD.reduce(given(exposure), exposure_time=60, wavelength_nm=650)


def test_masked_counts_are_refused():
    """Seen to fail: what the mask hides counted."""
    counts = np.ma.masked_greater(np.arange(30.0).reshape(5, 6), 27)
    with pytest.raises(ImageError, match=r"masked array that hides 2 values\. Give its data, and its mask as 'bad_pix"):
        counts_of(counts, "counts")
    with pytest.raises(ImageError, match="masked array that hides 2 values"):
        counts_of([counts, counts], "counts")  # seen to fail: two frames


@pytest.mark.parametrize("suffix", [".tif", ".fits"])
def test_images_of_this_package_are_no_counts(tmp_path, suffix):
    """Electrons and power are refused, counts of the same exposure taken. Seen to fail (38 % too much) without."""
    pytest.importorskip("tifffile"), pytest.importorskip("astropy")
    exposure = CCD.expose(ramp(), 60, 650, seed=1)
    exposure.write(tmp_path / f"electrons{suffix}")
    ramp().write(tmp_path / f"power{suffix}")
    for name in ("electrons", "power"):
        with pytest.raises(ImageError, match=f"are an image of fspt with {name}"):
            CCD.reduce(tmp_path / f"{name}{suffix}", **SETTINGS)
    exposure.write_counts(tmp_path / "counts.tif")
    np.testing.assert_array_equal(
        CCD.reduce(tmp_path / "counts.tif", **SETTINGS).power, CCD.reduce(exposure.counts, **SETTINGS).power
    )


def test_click_info_of_the_luminescent_image(tmp_path):
    """Exposure and binning are those of its own section; photograph and bias frame, with others, come first."""
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "luminescent.TIF", np.full((4, 4), 1000, np.uint16))
    photo = "*** photographic image:\tphotograph.TIF\nBinning Factor:\t2\nExposure Time Sec:\t0.2\n"
    bias = "*** readbiasonly image:\treadbiasonly.TIF\nBinning Factor:\t16\nBackground Exposure (Seconds):\t0\n"
    light = "*** luminescent image:\tluminescent.TIF\nLuminescent Exposure Units:\tsec\nBinning Factor:\t8\n"
    time = "Luminescent Exposure (Seconds):\t60\n"
    (tmp_path / "ClickInfo.txt").write_text(photo + bias + light + time)
    found = read_counts(tmp_path)
    assert (found.exposure_time, found.binning) == (60, 8)
    assert CCD.reduce(tmp_path, **SETTINGS).metadata["binning"] == 8
    assert CCD.reduce(tmp_path, **SETTINGS, binning=4).metadata["binning"] == 4
    (tmp_path / "ClickInfo.txt").write_text(photo + bias + light)
    assert read_counts(tmp_path).exposure_time is None


@pytest.mark.parametrize("wrong", ["0", "2.5"])
def test_a_binning_of_click_info_that_is_none_is_left_out(tmp_path, caplog, wrong):
    """As in FITS files, with a line. Seen to fail: refused beside a given one, too."""
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "luminescent.TIF", np.full((4, 4), 1000, np.uint16))
    (tmp_path / "ClickInfo.txt").write_text(f"Binning Factor:\t{wrong}\n")
    assert CCD.reduce(tmp_path, **SETTINGS, binning=4).metadata["binning"] == 4
    assert f"ClickInfo.txt' states a binning of {wrong}, no whole number >= 1; it is left out" in caplog.messages[0]


def test_a_map_that_a_flat_field_replaces_may_have_other_rows(tmp_path):
    """`prnu` is BOTTOM-UP, counts and flat state no order: the flat replaces the map. Seen to fail: refused."""
    fits, _ = pytest.importorskip("astropy.io.fits"), pytest.importorskip("ccdproc")
    response = np.linspace(0.9, 1.1, 12).reshape(3, 4)
    header = fits.Header({"ROWORDER": "BOTTOM-UP"})
    fits.PrimaryHDU(response, header).writeto(tmp_path / "prnu.fits")
    for name, values in (("counts", 900 + 50 * response), ("flat", 1e4 * response)):
        fits.PrimaryHDU(values.astype(np.uint16)).writeto(tmp_path / f"{name}.fits")
    camera, counts = replace(CCD, prnu=tmp_path / "prnu.fits"), tmp_path / "counts.fits"
    given = SETTINGS | SENSOR | {"flat": tmp_path / "flat.fits"}
    np.testing.assert_array_equal(camera.reduce(counts, **given).power, CCD.reduce(counts, **given).power)
    with pytest.raises(DetectorError, match="has no ROWORDER, 'prnu' is BOTTOM-UP"):
        camera.reduce(counts, **SETTINGS)


def test_uniform_source_calibrates():
    """A sphere of radiance L through f/2.8: power π L A_vd f, so that J = π L; the quantum efficiency comes back.

    With 4π for π the efficiency comes out at a quarter.
    """
    lens = Lens.focused(55, 2.8, magnification=0.5)
    radiance, shape = 1e-13, (24, 32)
    power = uniform_power(lens, radiance, 0.0135, shape)
    centre = math.pi * radiance * 0.027**2 * (55 / 5.6) ** 2 / (165**2 + (55 / 5.6) ** 2)
    assert power.max() == pytest.approx(centre, rel=1e-5, abs=0)
    true = replace(CCD, quantum_efficiency=0.62)
    stack = np.array([true.expose(Image(power), 60, 650, seed=s).counts for s in range(10)])
    found = calibrated(CCD, CCD.reduce(stack, **SETTINGS), power, 0.02)
    assert found.quantum_efficiency == pytest.approx(0.62, rel=4 * found.gain_error)
    assert found.quantum_efficiency == pytest.approx(0.62, rel=3e-3)
    assert found.gain_error == pytest.approx(0.02, rel=0.05)
    alone = calibrated(CCD, CCD.reduce(stack, **SETTINGS), power, 0.0).gain_error  # shot noise of all pixels and frames
    assert 0.5 < alone * np.sqrt(10 * (power * PER_WATT).sum()) < 3


@pytest.mark.parametrize("how", [{"method": "integral", "rtol": 1e-2}, {"method": "path", "spp": 4}], ids=str)
def test_a_reduced_image_is_no_rendered_one(mono, how):
    """Of a rendered image's metadata it keeps scene and lens alone; its errors are noise, whatever rendered the image.

    Seen to fail with `method` and all other numbers of the computation, which made noise a bound: no z-test.
    """
    image = fspt.render(camera_scene(disk(165, 9.0)), **how)
    image = image.scaled(2e4 / PER_WATT / image.power.max())
    exposure = CCD.expose(image, 60, 650, seed=1)
    kept = {
        "quantity",
        "unit",
        "scene",
        "sensor",
        "source_power",
        "model",
        "focal_length",
        "f_number",
        "focus_distance",
        "airy_radius",
    }
    kept |= {"magnification", "image_distance", "t_stop", "diaphragm_distance", "diaphragm_diameter", "transmittance"}
    kept |= {"pupil_magnification"}
    by_hand = CCD.reduce(exposure.counts, **SETTINGS, pixel_pitch=0.4, metadata=image.metadata)
    for found in (reduced(exposure), by_hand):
        assert set(found.metadata) & set(image.metadata) == kept | {"pixel_pitch"}
        assert compare(found, Image(image.power)).z_test.chi2 == pytest.approx(1, abs=0.2)


def test_toml_both_ways(tmp_path):
    camera = replace(CCD, gain_error=0.03, name='a "camera"')
    camera.to_toml(tmp_path / "camera.toml")
    assert Detector.from_toml(tmp_path / "camera.toml") == camera
    text = (tmp_path / "camera.toml").read_text()
    text = text.replace("read_noise", "temporal_dark_noise").replace("full_well", "saturation_capacity")
    text = text.replace("gain = 1.6", "overall_system_gain = 0.625")
    (tmp_path / "emva.toml").write_text(text)
    assert Detector.from_toml(tmp_path / "emva.toml") == camera
    (tmp_path / "twice.toml").write_text(text + "gain = 1.6\n")
    with pytest.raises(DetectorError, match="are the same"):
        Detector.from_toml(tmp_path / "twice.toml")


def test_bad_input(tmp_path):
    counts = np.full((4, 4), 1000, np.uint16)
    for settings, words in (
        ({"exposure_time": 0}, "'exposure_time' must be > 0"),
        ({"wavelength_nm": math.nan}, "'wavelength_nm'"),
        ({"binning": 0}, "'binning'"),
        ({"dark": np.ones((3, 3))}, "'dark' has the shape"),
    ):
        with pytest.raises(DetectorError, match=words):
            CCD.reduce(counts, **SETTINGS | settings)
    (tmp_path / "bad.npy").write_bytes(b"nonsense")
    for given, words in (
        (np.full((4, 4), np.nan), "NaN"),
        (np.ones((4, 4, 3, 2)), "must be real numbers"),
        (tmp_path / "none.tif", "do not exist"),
        (tmp_path / "bad.npy", "no NPY file"),
        (tmp_path, "no luminescent.TIF"),
    ):
        with pytest.raises(ImageError, match=words):
            CCD.reduce(given, **SETTINGS)
    with pytest.raises(ImageError, match="'mask' must be"):
        Image(np.ones((2, 2)), mask=np.ones((2, 2)))
