"""A first fit on few unknowns shows in seconds that images are not those of the surface."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from sphere_views import RADIUS, noisy, sphere_views

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.fit_settings import Hopeless, Settings
from mitsuba_fspt.inverse.surface import Surface

FEW = Settings(hopeless=Hopeless(rounds=2))  # after the line of the first fit is written


@pytest.fixture(scope="module")
def case(mono):
    """Matrix of a sphere of 642 vertices, its surface, and J_n of a spot in front [W/mm²]."""
    matrix = sphere_views(subdivisions=3, rtol=3e-3)
    surface = Surface.of(matrix)
    distance = np.linalg.norm(surface.vertices - [RADIUS - 2, 1, 1], axis=1)
    return matrix, surface, 1e-2 * np.exp(-distance / 3) / distance


def told(case, images, caplog, **options):
    matrix, surface, _ = case
    caplog.clear()
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        found = fspt.invert(matrix, images, scene=surface, **options)
    return found, [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("wrong", ["pose", "order"])
def test_images_of_another_pose_are_hopeless(case, caplog, wrong):
    """Images displaced by a third of the sphere, or views in another order: the first line on stderr says so."""
    matrix, _, exitance = case
    images = noisy(matrix, exitance, 3000, 0)
    if wrong == "order":
        images = [images[1], images[0], *images[2:]]
    else:
        images = [fspt.Image(np.roll(np.asarray(i), 4, axis=0), metadata=i.metadata) for i in images]
    found, lines = told(case, images, caplog, settings=FEW)
    assert "a first fit is hopeless, chi2" in lines[0]
    assert "check pose, order of the views" in lines[0]
    assert found.surface.unknowns < matrix.shape[1] or found.chi2 > 5


def test_cosmic_rays_are_named(case, caplog):
    """Four single pixels of twenty times the light of the brightest.

    With other seeds three to five pixels are told: the fit bends towards the four.
    """
    matrix, _, exitance = case
    images, rng = [], np.random.default_rng(0)
    for image in noisy(matrix, exitance, 1000, 0):
        power, lit = np.array(image, float), np.argwhere(matrix.forward(exitance)[0] > 0)
        power[tuple(lit[rng.integers(len(lit))])] += 20 * power.max()
        images.append(fspt.Image(power, metadata=image.metadata))
    _, lines = told(case, images, caplog, settings=FEW)
    assert "4 pixels differ from all around them" in lines[0]
    assert "mask cosmic rays" in lines[0]


@pytest.mark.parametrize("electrons", [30, 1000, 100_000])
def test_images_of_the_surface_are_not(case, caplog, electrons):
    """The right pose: no line, also where the few unknowns of the first fit are coarser than the noise shows."""
    matrix, _, exitance = case
    _, lines = told(case, noisy(matrix, exitance, electrons, 0), caplog)
    assert not any("hopeless" in line for line in lines)
