"""Noise of the pixels: images of a Monte Carlo, and what χ² of a fit says of the stated errors."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sphere_views import noisy, passes_of, sphere_views

from mitsuba_fspt.detector.detector import Detector
from mitsuba_fspt.detector.reduction import measured
from mitsuba_fspt.images.image import Image
from mitsuba_fspt.images.noise_model import NoiseModel, response_of
from mitsuba_fspt.inverse.measurement import Measurement, Noise, _mask, noise_of, tell_misfit
from mitsuba_fspt.runtime.errors import FsptError, ImageError, InversionError

BARE = Detector(0.9, 0.0, 3.0, 1e5, 1.6, 500, 16)


def signal():
    """(1, 32, 32) a spot on a disk, 0 around it."""
    y, x = (np.mgrid[:32, :32] - 15.5) / 12
    return (np.exp(-3 * ((x - 0.2) ** 2 + y**2)) * np.clip((1 - np.hypot(x, y)) * 12 + 0.5, 0, 1))[None]


@pytest.mark.parametrize("events", [20, 200])
def test_a_factor_from_images_of_a_monte_carlo(events):
    """Least squares with the variance of Eq. M.27 find the factor 1 without bias: 40 images, mean z below 0.6, χ² 1.

    Expected also where no sample met a pixel, whose error is 0. Seen to fail with each pixel's own standard error: the
    factor is below 0.8, since pixels that few samples met are dark and have small errors.
    """
    true = signal()
    used, z, chi2, own = true > 0, [], [], []
    for seed in range(40):
        power, error = passes_of(true, events, np.random.default_rng(seed))
        noise, factor = Noise(0 * true, error**2, np.ones(1, bool)), 1.0
        for _ in range(3):
            variance = noise.variance(factor * true, used)[used]
            length = (true[used] ** 2 / variance).sum()
            factor = (true * power)[used] @ (1 / variance) / length
        z.append((factor - 1) * length**0.5)
        chi2.append(((power - factor * true)[used] ** 2 / variance).mean())
        weight = 1 / np.maximum(error[used], error[error > 0].min()) ** 2
        own.append((true * power)[used] @ weight / (true[used] ** 2 @ weight))
    assert abs(np.mean(z)) < 0.6
    assert 0.7 < np.std(z) < 1.35
    assert np.mean(chi2) == pytest.approx(1, abs=0.1)
    assert np.mean(own) < 0.8


def test_pixels_that_no_sample_met_take_the_error_of_the_nearest():
    """A dark half without any sample beside a bright half: variance > 0 everywhere."""
    true = np.ones((1, 16, 16))
    true[..., :8] = 1e-3
    used = np.ones(true.shape, bool)
    used[:, 0] = False
    variance = Noise(0 * true, np.where(true == 1, 0.01, 0.0), np.ones(1, bool)).variance(true, used)
    assert (variance[used] > 0).all()
    assert variance[used].max() < 0.011


def test_masked_pixels_are_no_neighbours():
    """A masked pixel, NaN, does not change the neighbourhood of others. Seen to fail with 0 W there."""
    true = np.ones((1, 16, 16))
    noise = Noise(0 * true, np.full(true.shape, 0.01), np.ones(1, bool))
    noise.other[:, 7:10, 7:10] = 1.0
    used = np.ones(true.shape, bool)
    used[:, 8, 8] = False
    variance = noise.variance(np.where(used, true, np.nan), used)[used]
    assert np.ptp(variance) < 1e-12


def test_metadata_name_a_monte_carlo():
    """Images with `passes` are taken as sampled by themselves, others on `sampled`; electrons are refused there."""
    plane = np.ones((4, 4))
    images = [Image(plane, plane, metadata=m) for m in ({"passes": 32}, {})]
    shape = (2, 4, 4)
    assert noise_of(shape, images).sampled.tolist() == [True, False]
    assert noise_of(shape, images, sampled=True).sampled.all()
    assert not noise_of(shape, [], error=plane).sampled.any()
    assert noise_of(shape, [], error=plane, sampled=True).sampled.all()
    counts = Image(plane, metadata={"electrons_per_watt": 1e9, "read_noise": 3.0})
    with pytest.raises(InversionError, match="image 1 has the noise of electrons"):
        noise_of(shape, [images[0], counts], sampled=True)
    with pytest.raises(InversionError, match="'sampled' must be True or False, got 1"):
        noise_of(shape, images, sampled=1)


def test_the_response_of_a_pixel_is_the_same_in_all_views_of_a_detector():
    """Shot noise of 2 % and a PRNU of 4 %: 4/5 of the variance is common to views of one detector, none to two.

    Four views of one camera with 3 % had an interval of the total that was half as wide as it should be.
    """
    plane, rows = np.full((4, 4), 2500.0), np.array([1, 5, 7, 17, 21, 23])
    for names, share in ((("a", "a"), 0.8), (("a", "b"), 0.0)):
        numbers = {"electrons_per_watt": 1.0, "read_noise": 0.0, "dark_electrons": 0.0, "prnu": 0.04}
        images = [Image(plane, metadata=numbers | {"detector": name}) for name in names]
        noise = noise_of((2, 4, 4), images)
        measurement = Measurement(np.ravel(2 * [plane]), noise, np.zeros(32, bool), 0.0, matrix=None)
        signal = np.full(6, 2500.0)
        deviation = np.sqrt(noise.variance(np.stack([plane, plane]), np.ones((2, 4, 4), bool)).ravel()[rows])
        drawn = measurement.drawn(rows, signal, deviation, 20000, np.random.default_rng(1))
        found = np.corrcoef(drawn)
        assert np.var(drawn) == pytest.approx(2500 + 100**2, rel=0.03)
        assert found[:3, 3:].diagonal() == pytest.approx(3 * [share], abs=0.03)
        assert abs(found[0, [1, 2, 4, 5]]).max() < 0.03


def test_the_noise_of_a_subtracted_frame_is_the_same_in_all_views():
    """No light, one dark frame for two images: half of the variance is common to them; none with a frame for each."""
    pytest.importorskip("ccdproc")
    camera, none = Detector.typical_ccd(), Image(np.zeros((4, 4)))
    counts = [camera.expose(none, 60, 650, seed=k).counts for k in range(4)]
    rows = np.array([1, 5, 7, 17, 21, 23])
    for darks, share in (((2, 2), 0.5), ((2, 3), 0.0)):
        images = [
            camera.reduce(counts[k], exposure_time=60, wavelength_nm=650, dark=counts[d]) for k, d in enumerate(darks)
        ]
        noise = noise_of((2, 4, 4), images)
        measurement = Measurement(np.zeros(32), noise, np.zeros(32, bool), 0.0, matrix=None)
        deviation = np.sqrt(noise.other.ravel()[rows])
        drawn = measurement.drawn(rows, np.zeros(6), deviation, 20000, np.random.default_rng(1))
        assert np.var(drawn, axis=1) == pytest.approx(deviation**2, rel=0.05)
        found = np.corrcoef(drawn)
        assert found[:3, 3:].diagonal() == pytest.approx(3 * [share], abs=0.03)
        assert abs(found[0, [1, 2, 4, 5]]).max() < 0.03
    both = images[0] + images[1]  # with another share of either frame
    assert not {"frame_electrons", "frame_share", "frame_digest"} & set(both.metadata)
    assert noise_of((1, 4, 4), [both]).frame.max() == 0


@pytest.mark.parametrize("frames", [1, 4])
def test_half_of_the_noise_of_a_hot_pixel_is_common_to_views(frames):
    """Of images and dark frames that are means of as many frames. It was 0.003 on pixels of 2000 electrons."""
    pytest.importorskip("ccdproc")
    rng = np.random.default_rng(3)
    charge = np.where(np.arange(64).reshape(8, 8) % 9, 0.06, 2000.0)
    light, dark = np.rint(500 + rng.poisson(np.broadcast_to(charge, (2, frames, 8, 8))) / 1.6)
    image = Detector.typical_ccd().reduce(light, exposure_time=60, wavelength_nm=650, dark=dark)
    noise = noise_of((1, 8, 8), [image])
    np.testing.assert_allclose(noise.frame / noise.other, 0.5, rtol=1e-6)


def test_images_of_two_times_have_the_noise_of_one_bias_frame_in_common(tmp_path):
    """With a map of the dark current, of which another time subtracts another multiple. They had two digests."""
    pytest.importorskip("ccdproc")
    current = np.linspace(0.001, 0.2, 64).reshape(8, 8)
    np.save(tmp_path / "current.npy", current)
    camera = replace(Detector.typical_ccd(), dark_current=str(tmp_path / "current.npy"))
    bias = 500 + np.arange(64.0).reshape(8, 8) % 5
    images = [camera.reduce(bias, exposure_time=time, wavelength_nm=650, bias=bias) for time in (30, 60)]
    assert len(set(noise_of((2, 8, 8), images).subtracted)) == 1
    for image in images:  # the variance of reading a pixel, 3.5² + 1.6²/12
        part = NoiseModel.of(image).frame * image.metadata["electrons_per_watt"] ** 2
        np.testing.assert_allclose(part, 3.5**2 + 1.6**2 / 12)
    other = camera.reduce(bias, exposure_time=60, wavelength_nm=650, bias=bias + 1e-4)
    assert len(set(noise_of((2, 8, 8), [images[0], other]).subtracted)) == 2


def test_parts_of_one_image_share_its_flat_field_and_frame():
    """Parts that overlap by two columns have the noise of these in common. Two images at other places on the film, each
    with the same arrays for a frame and a flat field, have none: no pixel of the film has one element of either.

    Seen to fail: parts had flat fields of two digests, and images at two places shared a frame by its elements.
    """
    pytest.importorskip("ccdproc")
    camera, rng = replace(Detector.typical_ccd(), prnu=0.0), np.random.default_rng(6)
    counts, dark, flat = (np.rint(rng.normal(level, 9, (3, 4, 6))) for level in (4000, 500, 20000))
    settings = {"exposure_time": 60, "wavelength_nm": 650, "dark": dark, "flat": flat, "flat_kind": "sensor"}
    one, other = (camera.reduce(counts, **settings, metadata={"crop_offset_x": left}) for left in (0, 2))
    used = np.ones((2, 4, 4), bool)
    for images, common in (((one[:, :4], one[:, 2:]), 8), ((one[:, :4], other[:, :4]), 0)):
        parts = noise_of(used.shape, images).common(np.stack([image.power for image in images]), used)
        for part in parts:
            shared = part.shared.reshape(used.shape)
            assert part.deviation.min() > 0
            assert len(np.unique(shared)) == 32 - common
            assert np.array_equal(shared[0][:, 2:], shared[1][:, :2]) == (common > 0)


def test_a_flat_field_that_was_replaced_is_not_that_of_the_reduction():
    """The digest at reduction holds for the image and its parts alone. Seen to fail: it was taken for any other."""
    pytest.importorskip("ccdproc")
    rng = np.random.default_rng(6)
    counts, flat = (np.rint(rng.normal(level, 9, (4, 6))) for level in (4000, 20000))
    given = {"exposure_time": 60, "wavelength_nm": 650, "flat": flat, "flat_kind": "sensor"}
    image = Detector.typical_ccd().reduce(counts, **given)
    other = replace(image, flat=image.flat[::-1])
    part = image[:, 1:]
    cases = (image, image, 1), (image, other, 2), (part, other[:, 1:], 2), (part, replace(part, flat=part.flat + 1), 2)
    for one, two, count in cases:
        assert len({response_of(one), response_of(two)}) == count
    assert response_of(part[1:, 1:]) == response_of(image)


def test_an_image_without_a_pixel_that_counts_is_told(caplog):
    """The second of two images is saturated everywhere: it was left out without a word."""
    plane, full = np.ones((4, 4)), np.ones((4, 4), bool)
    images = [Image(plane, plane, mask=mask) for mask in (np.eye(4, dtype=bool), full)]
    found = _mask(SimpleNamespace(image_shape=(2, 4, 4)), images, None)
    assert found.sum(axis=(1, 2)).tolist() == [4, 16]
    assert caplog.text.count("are masked") == 1
    assert "no pixel of image 1 counts" in caplog.text


def test_detectors_without_a_name_are_told_apart_by_their_numbers(caplog):
    """A PRNU known as a number: names that say nothing count as one camera with a line, not where the numbers differ.

    Seen to fail: a typical CCD and a typical sCMOS had one name, and the pixels of both one response, without a line.
    """
    image = Image(np.ones((4, 4)))
    kinds = Detector.typical_ccd(), Detector.typical_scmos(), Detector.typical_scmos(), replace(BARE, name="no. 1")
    images = [
        measured(replace(kind, prnu=0.02).expose(image, 1e-12, 650, seed=k)) for k, kind in enumerate((*kinds, BARE))
    ]
    for pair, count, told in (((0, 1), 2, 0), ((1, 2), 1, 1), ((3, 4), 2, 0), ((3, 3), 1, 0)):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            found = noise_of((2, 4, 4), [images[k] for k in pair])
        assert len(set(found.detector)) == count
        assert caplog.text.count("invert: 2 images name no detector") == told
        with caplog.at_level(logging.WARNING):  # two sensors of a scene are two cameras, two turns of one are not
            noise_of((2, 4, 4), [images[k] for k in pair], sensors=[0, 1])
            noise_of((2, 4, 4), [images[k] for k in pair], sensors=[0, 0])
        assert caplog.text.count("invert: 2 images name no detector") == 2 * told


def test_one_camera_without_a_name_before_a_turntable_is_not_told(caplog):
    """Seen to fail: a scene with one sensor has one camera, yet a line told that its views count as of one."""
    matrix = sphere_views()
    images = noisy(matrix, np.full(matrix.shape[1], 1e-3), 100, seed=0, prnu=0.01)
    with caplog.at_level(logging.WARNING):
        found = Measurement.of(matrix, images, None, None, None)
    assert len(set(found.noise.detector)) == 1
    assert not caplog.text


@pytest.mark.parametrize("wrong", [{"frame_share": 1.5}, {"frame_share": np.nan}, {"frame_electrons": np.inf}])
def test_noise_of_a_frame_that_none_has_is_refused(wrong):
    numbers = {"electrons_per_watt": 1.0, "read_noise": 2.0}
    with pytest.raises(InversionError, match=r"image 0 has .* of a subtracted frame, or its share"):
        noise_of((1, 4, 4), [Image(np.ones((4, 4)), metadata=numbers | wrong)])


@pytest.mark.parametrize("wrong", ["abc", np.nan, np.inf])
def test_a_place_on_the_film_that_is_no_number_is_refused(wrong):
    with pytest.raises(InversionError, match=r"locate: image 0.* 'crop_offset_x'"):
        noise_of((1, 4, 4), [Image(np.ones((4, 4)), np.ones((4, 4)), metadata={"crop_offset_x": wrong})], verb="locate")


@pytest.mark.parametrize("name", ["pixel_pitch", "gain_error", "crop_offset_x", "binning", "veiling_glare"])
@pytest.mark.parametrize("wrong", ["abc", [1.0], np.inf])
def test_metadata_that_are_no_numbers_are_refused_by_name(name, wrong):
    """Seen to fail: a bare ValueError or TypeError."""
    matrix = sphere_views()
    images = noisy(matrix, np.full(matrix.shape[1], 1e-3), 100, seed=0)
    images[2] = replace(images[2], metadata=images[2].metadata | {name: wrong})
    with pytest.raises(FsptError, match=rf"image.* '{name}' of the metadata must be a finite number, got"):
        Measurement.of(matrix, images, None, None, None)


@pytest.mark.parametrize("name", ["electrons_per_watt", "source_power"])
def test_metadata_of_sums_and_scales_are_numbers(name):
    image = Image(np.ones((4, 4)), metadata={name: "abc"})
    with pytest.raises(ImageError, match=f"'{name}' of the metadata must be a finite number"):
        _ = image.scaled(2.0) if name == "electrons_per_watt" else image + image


@pytest.mark.parametrize(("electrons", "read_noise"), [(0.02, 0.0), (0.5, 0.0), (3.0, 1.0), (1000.0, 3.5)])
def test_the_right_noise_gives_no_warning(electrons, read_noise):
    """100 images with the stated noise, of few electrons too: at most one warns, and Σ (noise/σ)² has the stated mean
    and variance, to a fifth. Seen to fail (one of two warns) with the variance 2 a pixel of normal noise, at 0.02.
    """
    rng, per_watt = np.random.default_rng(3), 1e3
    true = electrons / per_watt * np.ones((1, 20, 20))
    used = np.ones(true.shape, bool)
    noise = Noise(
        np.full(true.shape, 1 / per_watt), np.full(true.shape, (read_noise / per_watt) ** 2), np.zeros(1, bool)
    )
    sigma = np.sqrt(noise.variance(true, used))
    expected, sums, lines = noise.chi2(true, sigma, used), [], 0
    for _ in range(100):
        power = (rng.poisson(true * per_watt) + read_noise * rng.standard_normal(true.shape)) / per_watt
        sums.append((((power - true) / sigma) ** 2).sum())
        lines += len(tell_misfit("invert", sums[-1], true.size, 0.0, [expected]))
    assert lines <= 1
    assert expected.mean == pytest.approx(true.size)
    assert np.mean(sums) == pytest.approx(expected.mean, rel=0.1)
    assert np.std(sums) == pytest.approx(expected.variance**0.5, rel=0.2)


def test_noise_stated_too_large_is_reported(caplog):
    """χ² of 0.1, the mean of ten frames stated as one, and of 0.47 give the factor of the intervals' widths.

    Half of a numerical error in σ is no noise: χ² of 0.5 is then not reported, since the error is a bound.
    """
    shape, used = (1, 40, 40), np.ones((1, 40, 40), bool)
    noise = Noise(np.zeros(shape), np.ones(shape), np.zeros(1, bool))
    expected = noise.chi2(np.ones(shape), np.ones(shape), used)
    assert "3.2 times too wide" in tell_misfit("invert", 0.1 * 1600, 1600, 0.0, [expected])[0]
    assert "1.5 times too wide" in tell_misfit("locate", 0.47 * 1600, 1600, 4.0, [expected])[0]
    assert "fspt: locate: chi2 is 0.4" in caplog.text
    half = noise.chi2(np.ones(shape), np.full(shape, 2**0.5), used)
    assert not tell_misfit("invert", 0.5 * 1600, 1600, 0.0, [half])
    assert "by more than their noise" in tell_misfit("invert", 1.3 * 1600, 1600, 0.0, [expected])[0]
