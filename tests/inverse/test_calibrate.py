"""Parameters of a scene from a noisy image: values within their sd, χ², and degenerate sets."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import InversionError


@pytest.fixture(scope="module")
def scene(tmp_path_factory, mono):
    return write_scene(tmp_path_factory.mktemp("calibrate") / "ball.xml")


def noisy(scene, seed, share=0.01, **parameters):
    """Picture of the scene with independent normal noise of 1 % of its brightest pixel."""
    power = fspt.render(fspt.load(scene, **parameters), rtol=1e-5).power.astype(float)
    sigma = np.full(power.shape, share * power.max())
    return fspt.Image(power + sigma * np.random.default_rng(seed).standard_normal(power.shape), sigma)


def test_parameters_come_back_within_their_sd(scene):
    """Distance and f-number of a sphere, started 1 % and 3 % off; 4 seeds: no z beyond 4, χ² is 1."""
    scores, chi2 = [], []
    for seed in range(4):
        found = fspt.calibrate(scene, noisy(scene, seed, distance=163.5, f_number=7.8), free=["distance", "f_number"])
        scores += [(found.values["distance"] - 163.5) / found.sd["distance"]]
        scores += [(found.values["f_number"] - 7.8) / found.sd["f_number"]]
        chi2.append(found.chi2)
    assert np.abs(scores).max() < 4
    assert np.mean(chi2) == pytest.approx(1, abs=0.4)
    assert 0 < found.sd["f_number"] < 0.1


def test_monte_carlo_gives_the_parameters_of_its_scene(scene):
    """A picture by `path` with its own standard error; gain beside the distance."""
    image = fspt.render(fspt.load(scene, distance=164), method="path", spp=512, seed=4)
    found = fspt.calibrate(scene, image, free=["distance", "gain"])
    assert found.values["gain"] == pytest.approx(1, abs=4 * found.sd["gain"])
    assert found.values["distance"] == pytest.approx(164, abs=4 * found.sd["distance"])
    assert found.covariance.shape == (2, 2)


def test_degenerate_sets_are_told(scene):
    """Gain and f-number both scale the picture: the message names both, and no small sd is returned."""
    with pytest.raises(InversionError, match="do not determine f_number, gain separately"):
        fspt.calibrate(scene, noisy(scene, 1), free=["f_number", "gain"])


def test_bad_input(scene):
    image = noisy(scene, 1)
    for images, free, words in (
        (image, [], "names nothing"),
        (image, ["colour"], "no parameter 'colour'"),
        ([image, image], ["distance"], "2 images for 1 views"),
        (fspt.Image(image.power), ["distance"], "nor an error"),
        (fspt.Image(image.power[1:], image.error[1:]), ["distance"], "has the shape"),
    ):
        with pytest.raises(InversionError, match=words):
            fspt.calibrate(scene, images, free=free)
