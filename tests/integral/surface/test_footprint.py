"""Footprints: polygons of light distributed exactly over the pixels of a canvas."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")

SHAPE = (5, 7)
LIGHTS = (3.0, 0.5)


def test_rectangles_reach_the_pixels_that_they_overlap():
    """200 rectangles inside the canvas and across each of its borders. Expected: the products of the overlaps in x and
    in y, but for the grid of corners.

    Seen to fail where light left of the canvas begins in its second column.
    """
    low = np.random.default_rng(1).uniform(-2, SHAPE[::-1], (200, 2))
    high = low + np.random.default_rng(2).uniform(0.1, 4, (200, 2))
    ring = [np.stack([x[:, 0], y[:, 1]]) for x, y in ((low, low), (high, low), (high, high), (low, high))]
    along = [
        np.clip(np.minimum(high[:, n, None], np.arange(size) + 1) - np.maximum(low[:, n, None], np.arange(size)), 0, 1)
        for n, size in enumerate(SHAPE[::-1])
    ]
    share = np.einsum("ny, nx, n -> yx", along[1], along[0], 1 / np.prod(high - low, axis=1))
    for light, image in zip(LIGHTS, laid(ring), strict=True):
        np.testing.assert_allclose(image, light * share, atol=1e-3)


def test_light_of_a_slanted_polygon_lies_around_its_middle():
    """Expected: all of the light, and its centroid but for where it lies within the pixels.

    Seen to fail where an edge is taken to cross each pixel in its middle.
    """
    ring = np.array([[[1.2], [0.5]], [[5.7], [0.5]], [[5.3], [4.0]], [[0.8], [4.0]]])
    image = laid(ring)[0]
    assert image.sum() == pytest.approx(LIGHTS[0], rel=1e-9)
    y, x = np.indices(SHAPE) + 0.5
    centroid = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    np.testing.assert_allclose(centroid, [3.25, 2.25], atol=0.05)


def laid(ring):
    """Images of the `LIGHTS`, each from polygons with the corners `ring`, four of shape (2, n)."""
    import mitsuba as mi

    from mitsuba_fspt.integral.surface.footprint import Canvas

    canvas = Canvas(SHAPE, (1e-12, 1e-12), centres=False)
    canvas.lay([mi.Float64(light) for light in LIGHTS], [mi.Point2f(*corner) for corner in ring], mi.Bool(True))
    return canvas.images()
