"""Neighbourhoods on the pixel grid against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt import pixels

SHAPES = [(7, 9), (1, 6), (5, 1), (1, 1), (2, 2)]


def image(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def around(array, radius):
    """For every pixel the block within `radius`, clipped at the border."""
    h, w = array.shape
    return [
        [array[max(0, i - radius) : i + radius + 1, max(0, j - radius) : j + radius + 1] for j in range(w)]
        for i in range(h)
    ]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("radius", [0, 1, 3, 20])
def test_box_sum_and_dilate(shape, radius):
    values = image(shape)
    blocks = around(values, radius)
    np.testing.assert_allclose(pixels.box_sum(values, radius), [[b.sum() for b in row] for row in blocks], atol=1e-12)
    mask = values > 1.2
    expected = [[b.any() for b in row] for row in around(mask, radius)]
    np.testing.assert_array_equal(pixels.dilate(mask, radius), expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_spread_max_is_the_largest_of_nine(shape):
    values = image(shape)
    expected = [[block.max() for block in row] for row in around(values, 1)]
    np.testing.assert_array_equal(pixels.spread_max(values), expected)


def test_second_differences_of_a_paraboloid():
    """Of 3x² − 5y² + xy + 2x they are 6 and −10 everywhere, the rim included."""
    y, x = np.mgrid[0:6, 0:8].astype(float)
    xx, yy = pixels.second_differences(3 * x**2 - 5 * y**2 + x * y + 2 * x)
    np.testing.assert_allclose(xx, 6, atol=1e-12)
    np.testing.assert_allclose(yy, -10, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_no_film_is_too_small(shape):
    planes = (*pixels.second_differences(image(shape)), pixels.spread_max(image(shape)))
    for plane in (*planes, pixels.spread_over_lattice(image(shape))):
        assert np.isfinite(plane).all()
        assert plane.shape == shape


def test_lattice_takes_one_pixel_of_sixteen_and_is_near_to_all():
    """Expected: in every row and column of 16, at all places modulo 4, and within two pixels' reach of every block."""
    mask = pixels.lattice((32, 48))
    assert mask.sum() == 32 * 48 // 16
    assert mask.sum(axis=0).tolist() == [2] * 48
    assert mask.sum(axis=1).tolist() == [3] * 32
    assert pixels.spread_over_lattice(mask.astype(float)).min() == 1


@pytest.mark.parametrize("angle", [-1.2, -0.4, 0.0, 0.3, 1.0, 1.5])
def test_principal_angle_forgets_the_sign(angle):
    """Half the vectors point the other way, as at the two edges of a bar."""
    sign = np.where(image((6, 6)) > 0, 1.0, -1.0)
    found = pixels.principal_angle(sign * np.cos(angle), sign * np.sin(angle), 2)
    np.testing.assert_allclose(np.mod(found - angle + np.pi / 2, np.pi), np.pi / 2, atol=1e-12)
