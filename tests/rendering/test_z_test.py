"""The z-test of real images: correct ones pass as often as they should, and a wrong one does not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_scenes import SCENES

import mitsuba_fspt as fspt

pytestmark = pytest.mark.usefixtures("mono")

PAIRS = 6  # 20 pairs at 16 to 256 samples: scripts/z_test.py, docs/z_test.csv
FILM = {"f_number": 2.8, "view": 90, "width": 16, "height": 16, "pixel_pitch": 1.728}


@pytest.fixture(scope="module")
def cylinder(mono):
    return fspt.load(SCENES / "nylon_cylinder.xml", **FILM)


@pytest.fixture(scope="module")
def pictures(cylinder):
    """Images by `path`, each of a seed of its own, by samples a pixel."""
    seeds = {16: range(2 * PAIRS), 1024: range(2)}
    return {spp: [fspt.render(cylinder, method="path", spp=spp, seed=k) for k in of] for spp, of in seeds.items()}


def scaled(image, factor):
    return fspt.Image(factor * image.power, factor * image.error, image.coverage, image.metadata)


def test_correct_images_pass_as_often_as_they_should(pictures):
    """Rationale: p of two correct images is uniform in 0 … 1, whatever the samples; at most it is too large.

    Expected, of 6 pairs: mean 1/2 - 0.35 (three standard deviations) … 0.85, none below 1e-3. The silhouettes' few
    events make p too large rather than too small. Seen to fail with half the error.
    """
    images = pictures[16]
    tests = [fspt.compare(*pair).z_test for pair in zip(images[::2], images[1::2], strict=True)]
    p = np.array([test.p_value for test in tests])
    assert 0.15 < p.mean() < 0.85
    assert p.min() > 1e-3
    assert 0.6 < np.mean([test.chi2 for test in tests]) < 1.2


def test_integral_against_path(cylinder, pictures):
    """Where the noise exceeds the integral's bound, chi2 is about 1, and was 0.05 with the bound as a deviation.

    An image that is 1 % too bright is found, on either side.
    """
    integral = fspt.render(cylinder, rtol=1e-4, max_nodes=1 << 16)
    for image in pictures[1024]:
        test = fspt.compare(integral, image).z_test
        assert test.p_value > 1e-3
        assert test.noisy > 20
        assert test.chi2 == pytest.approx(1, abs=4 * math.sqrt(2 / test.noisy))
        assert fspt.compare(scaled(integral, 1.01), image).z_test.p_value < 1e-6
        assert fspt.compare(integral, scaled(image, 1.01)).z_test.p_value < 1e-6
