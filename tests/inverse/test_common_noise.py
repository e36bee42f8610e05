"""Noise that images have in common, by a frame subtracted from all or the response of one detector's pixels.

The expected numbers are those of dense covariance matrices, or scatter over random draws; nothing is rendered.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mitsuba_fspt.images.image import Image
from mitsuba_fspt.inverse.calibration_fit import CalibrationFit, CalibrationSettings, Measured
from mitsuba_fspt.inverse.common_noise import CommonNoise, beyond_independent, squared_correlations
from mitsuba_fspt.inverse.measurement import Measurement, Noise, noise_of, tell_misfit
from mitsuba_fspt.inverse.source_fit import PointSources, SourceFit
from mitsuba_fspt.inverse.view_factors import PixelNoise

SHARE = 0.6  # of the variance, in common


def measured(variance, frames, **others):
    """Views (v, h, w) of this variance [W²], `SHARE` of it by frames of these numbers."""
    noise = Noise(0 * variance, variance, np.zeros(len(variance), bool), 0.0, 1.0, 0, SHARE * variance, **others)
    noise = replace(noise, subtracted=np.array(frames))
    return Measurement(np.zeros(variance.size), noise, np.zeros(variance.size, bool), 0.0, matrix=None)


def covariance_of(variance, frames, rows=slice(None)):
    """Covariance of the pixels of such views, one after the other, by the frames alone; 0 on the diagonal."""
    deviation, pixels = np.sqrt(SHARE * variance).ravel(), variance[0].size
    pixel, frame = np.tile(np.arange(pixels), len(variance)), np.repeat(frames, pixels)
    same = (pixel[:, None] == pixel) & (frame[:, None] == frame)
    np.fill_diagonal(same, False)
    return (np.outer(deviation, deviation) * same)[rows][:, rows]


def bands_of(variance, frames, count):
    """A fit of one band of all views, or of as many bands as there are views."""
    size, views = variance[0].size, len(variance)
    each = np.split(np.arange(views), count)
    bands = [
        SimpleNamespace(measurement=measured(variance[own], [frames[k] for k in own]), rows=np.arange(size * len(own)))
        for own in each
    ]
    fit = SourceFit.__new__(SourceFit)
    fit.bands = bands
    fit.parts = [slice(own[0] * size, (own[-1] + 1) * size) for own in each]
    return fit


def sources(sigma, view, rng, common=0.0):
    """One source that all pixels see, its numbers determined about equally well; `PointSources` without a tissue."""
    columns = rng.uniform(0.5, 1.5, (len(sigma), 1))
    gradients = rng.uniform(-1, 1, (len(sigma), 1, 3))
    noise = PixelNoise(sigma, common * columns[:, 0] / sigma, view)
    return PointSources(np.zeros((1, 3)), np.ones(1), np.zeros(1), (), columns, gradients, noise, 0.0)


def test_parameters_of_a_scene_from_views_with_one_frame():
    """Three views, two with one dark frame, each with other pixels masked: the covariance of least squares is exact.

    It was that of independent noise, whose sd is 1.13 times too small. Seen to fail with pixels counted on from one
    view to the next where some are masked.
    """
    rng, frames = np.random.default_rng(1), [7, 7, 8]
    variance = rng.uniform(1, 4, (3, 3, 4))
    base, slopes = rng.uniform(50, 60, (3, 3, 4)), rng.uniform(1, 2, (3, 3, 4, 2))
    slopes[1] = slopes[0] * rng.uniform(0.9, 1.1, (3, 4, 1))
    noise = measured(variance, frames).noise
    used = np.ones(base.shape, bool)
    used[0, 0, 2] = used[0, 1, 1] = used[1, 2, 0] = used[2, 2, 3] = False
    rows = np.flatnonzero(used)
    data = Measured(base + slopes @ [1.0, 2.0], noise, used, 0.0)
    found = CalibrationFit(
        ("a", "b"), np.array([1.0, 2.0]), data, lambda x: (base + slopes @ x, 0 * base), CalibrationSettings()
    ).solved()
    jacobian, weight, common = slopes[used], 1 / variance[used], covariance_of(variance, frames, rows)
    inverse = np.linalg.inv(jacobian.T @ (weight[:, None] * jacobian))
    estimate = inverse @ (jacobian * weight[:, None]).T
    expected = inverse + estimate @ common @ estimate.T
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-5)
    assert np.diag(expected / inverse).min() > 1.25
    assert found.noise.variance == pytest.approx(2 * 32 + 2 * (common**2 * np.outer(weight, weight)).sum())


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("factors", [0.0, 0.3])
def test_intervals_of_sources_from_views_or_bands_with_one_frame(count, factors):
    """Two views of one band, or two bands: the covariance of the values, and of coefficients and factors fitted along.

    Seen to fail with the bands taken one by one, and `joint_sd` without noise in common.
    """
    rng = np.random.default_rng(2)
    variance, frames, view = rng.uniform(1, 2, (2, 3, 4)), [7, 7], np.repeat([0, 1], 12)
    fit, sigma = bands_of(variance, frames, count), np.sqrt(variance).ravel()
    fit.settings = SimpleNamespace(model_error=0.0)
    fit.power = np.zeros(24)
    found = sources(sigma, view, rng, factors)
    common = covariance_of(variance, frames)
    inverse = np.linalg.inv(found.slopes.T @ found.slopes)
    estimate = inverse @ found.slopes.T @ found.noise.over(np.eye(24))  # of the values from pixels [W]
    np.testing.assert_allclose(
        fit.by_common(found, inverse), estimate @ common @ estimate.T, rtol=1e-9, atol=1e-9 * inverse.max()
    )
    joint = np.column_stack([found.changes / sigma[:, None], found.noise.all_columns])
    inverse = fit.joint_covariance(found)
    estimate = inverse @ joint.T / sigma
    np.testing.assert_allclose(
        fit.joint_sd(found) ** 2, np.diag(inverse) + np.diag(estimate @ common @ estimate.T), rtol=1e-9
    )
    assert (fit.joint_sd(found) ** 2 / np.diag(inverse)).max() > 1.05


@pytest.mark.parametrize("count", [1, 4])
def test_chi2_of_views_or_bands_with_one_frame(count):
    """Four views with 0.6 of the variance in common: the sum scatters 1.44 times as much as without, as stated.

    300 draws; one in 12 was 2.5 stated standard deviations away or more, one in 80 is expected.
    """
    variance, frames = np.full((4, 12, 12), 2.0), [7, 7, 7, 7]
    fit, sigma = bands_of(variance, frames, count), np.full(576, 2.0**0.5)
    found = SimpleNamespace(signal=np.zeros(576), sigma=sigma)
    noise = fit.noise(found)
    drawn = measured(variance, frames).drawn(np.arange(576), np.zeros(576), sigma, 300, np.random.default_rng(5))
    sums = np.sum((drawn / sigma[:, None]) ** 2, axis=0)
    sd = sum(one.variance for one in noise) ** 0.5
    assert sum(one.mean for one in noise) == pytest.approx(576)
    assert sd == pytest.approx((2 * 576 * (1 + 3 * SHARE**2)) ** 0.5)
    assert np.std(sums) == pytest.approx(sd, rel=0.12)
    assert np.mean(np.abs(sums - 576) > 2.5 * sd) < 0.03
    assert not [line for total in sums for line in tell_misfit("locate", total, 576, 0.0, noise)]


def test_a_source_that_is_not_there_is_not_found_in_noise_in_common():
    """Eight views of the same pixels: p < 0.05 in a twentieth of 1000 images without a source. It was in 0.29."""
    rng = np.random.default_rng(3)
    variance, frames, view = np.ones((8, 4, 4)), 8 * [7], np.repeat(np.arange(8), 16)
    fit, sigma = bands_of(variance, frames, 1), np.ones(128)
    found = sources(sigma, view, rng)
    found.columns[:] = np.tile(found.columns[:16], (8, 1))
    fit.uncertain, fit.gain_per_view, fit.view, fit.offset = np.empty((128, 0)), 0.0, view, np.zeros(128)
    drawn = measured(variance, frames).drawn(np.arange(128), np.zeros(128), sigma, 1000, rng)
    values = []
    for fit.power in drawn.T:
        values.append(fit.p_values(found, 1)[0])
    assert np.mean(np.array(values) < 0.05) == pytest.approx(0.05, abs=0.02)


def test_parts_of_one_detector_have_the_noise_of_the_same_pixels_in_common():
    """Two crop windows of a film that overlap by two columns, and one of another binning."""
    known = {"electrons_per_watt": 1.0, "prnu": 0.04, "detector": "a"}
    plane = np.full((3, 4), 2500.0)
    images = [
        Image(plane, metadata=known | {"crop_offset_x": left, "crop_offset_y": 5, "binning": side})
        for left, side in ((10, 1), (12, 1), (10, 2))
    ]
    used = np.ones((3, 3, 4), bool)
    response, _ = noise_of(used.shape, images).common(np.stack(3 * [plane]), used)
    shared = response.shared.reshape(used.shape)
    np.testing.assert_array_equal(shared[0][:, 2:], shared[1][:, :2])
    assert len(np.unique(shared)) == 12 + 6 + 12


def test_two_parts_of_noise_in_common_are_correlated():
    """Of response and frame together: (a a' + b b')², not its parts alone."""
    rng = np.random.default_rng(6)
    parts = [
        CommonNoise(rng.uniform(0.2, 0.6, 12), np.repeat(origin, 4), np.tile(np.arange(4), 3))
        for origin in ([1, 1, 2], [5, 5, 5])
    ]
    dense = sum(np.outer(p.deviation, p.deviation) * (p.shared[:, None] == p.shared) for p in parts)
    np.fill_diagonal(dense, 0)
    assert squared_correlations(parts, np.full(12, 2.0)) == pytest.approx((dense**2).sum() / 16)
    weights = rng.normal(size=(12, 2))
    np.testing.assert_allclose(beyond_independent(parts, weights), weights.T @ dense @ weights, rtol=1e-9)
