"""Work that is stopped: the best image so far, whose errors are those of the level that each pixel has reached."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import ball, lens, load_scene, world_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.integral import progress
from mitsuba_fspt.rendering.render import integrator_of
from mitsuba_fspt.runtime.deadline import Deadline
from mitsuba_fspt.runtime.errors import SceneError

# How often work may be left out before it is: between the levels, or between batches of a thousand lines of sight.
BETWEEN_LEVELS, BETWEEN_BATCHES = (0, 1, 3, 9, 30), (3, 12)


class After(Deadline):
    """A deadline that passes once it was asked for so many times."""

    def __init__(self, times):
        super().__init__(1e9)
        self.times = times

    def passed(self):
        self.times -= 1
        if self.times < 0:
            self.cut = True
        return self.cut


def scene_of(name):
    if name == "ball":
        return world_scene(ball(radius=12.0), sensor=lens(size=16, pitch=1.2, f_number=2.8))
    return load_scene(name, crop=(10, 6, 12, 10))


@pytest.mark.parametrize(("name", "batch"), [("ball", progress.BATCH), ("two_spheres", progress.BATCH >> 8)])
def test_errors_bound_the_error_at_any_deadline(name, batch, monkeypatch):
    """Against the image at a fifth of rtol: at most one pixel in a hundred is off by more than its error.

    The errors fall, but for jumps that are found late. Seen to fail with the error 0 on pixels that a level has not
    reached, and with changes counted there.
    """
    monkeypatch.setattr(progress, "BATCH", batch)
    stops = BETWEEN_LEVELS if batch == progress.TIMED_BATCHES << 18 else BETWEEN_BATCHES
    scene = scene_of(name)
    sensor, integrator = scene.sensors()[0], integrator_of(scene, "integral")
    quadrature = replace(integrator.quadrature, rtol=1e-3)
    truth = integrator.solve(scene, sensor, replace(quadrature, rtol=2e-4))
    sums = []
    for stop in stops:
        found = integrator.solve(scene, sensor, quadrature, deadline=(deadline := After(stop)))
        off = np.abs(found.power - truth.power) > found.error + truth.error
        assert off.sum() <= 0.01 * off.size
        sums.append(found.error.sum())
        assert found.error.max() <= 1.001 * sensor.camera.etendue * 3e-3 / np.pi  # no pixel is brighter than a surface
        assert deadline.cut or found.error.max() <= 1e-3 * found.power.max()
    assert sums[0] > 0
    assert sums[-1] < 0.5 * sums[0]
    assert all(after <= 1.2 * before for before, after in itertools.pairwise(sums))


@pytest.mark.parametrize("stop", [0, 1, 3])
def test_the_surface_form_stops(stop):
    """After its first level its error is some times its value, after the second the usual one."""
    scene = scene_of("ball")
    sensor, integrator = scene.sensors()[0], integrator_of(scene, "integral")
    quadrature = replace(integrator.quadrature, domain="surface", rtol=1e-3)
    truth = integrator.solve(scene, sensor, replace(quadrature, domain="pupil"))
    found = integrator.solve(scene, sensor, quadrature, deadline=After(stop))
    assert np.count_nonzero(np.abs(found.power - truth.power) > found.error + truth.error) <= 2
    assert found.power.sum() == pytest.approx(truth.power.sum(), rel=0.05)


def test_render_reports_that_it_stopped(monkeypatch):
    """Half a millisecond is too little for any refinement; a minute is enough for all of it."""
    scene = scene_of("ball")
    short, long = fspt.render(scene, max_time=5e-4), fspt.render(scene, max_time=60)
    assert short.metadata["warnings"].startswith("stopped by max_time: rtol 0.001 not reached on ")
    assert (short.metadata["max_time"], short.metadata["levels"]) == (5e-4, "4 nodes: 196 pixels")
    assert short.metadata["stopped_after"] == short.metadata["wall_time"]
    assert short.error.sum() > 10 * long.error.sum()
    assert "warnings" not in long.metadata
    assert "stopped_after" not in long.metadata
    assert np.array_equal(long.power, fspt.render(scene).power)


def test_monte_carlo_stops_between_passes():
    """Two passes at least, for a standard error; they are those of an image of as many samples."""
    image = fspt.render(scene_of("ball"), method="path", spp=64, seed=3, max_time=1e-3)
    assert image.metadata["warnings"] == "stopped by max_time after 2 of 32 passes"
    assert (image.metadata["passes"], image.metadata["spp"]) == (2, 4)
    whole = fspt.render(scene_of("ball"), method="path", spp=4096, seed=4)
    assert fspt.compare(image, whole).z_test.p_value > 1e-3


@pytest.mark.parametrize("seconds", [0, -1, float("inf"), "soon"])
def test_a_time_limit_is_a_positive_number(seconds):
    with pytest.raises(SceneError, match="render: 'max_time' must be"):
        fspt.render(scene_of("ball"), max_time=seconds)
