"""Eq. 9 summed over surface points, as the paper does it: right where it is fine enough, lost near z = u."""

from __future__ import annotations

import numpy as np
import pytest
import small_scenes
from small_scenes import FOCUS, HEIGHT, RADIUS, SIDE, WIDTH

pytestmark = pytest.mark.usefixtures("mono")
PATCH = 2.0  # mm a side


def patch(z, x=0.0, y=0.0, turn=180.0):
    """A square of 2 mm that faces the lens, two triangles."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], turn).scale(PATCH / 2)
    return {"type": "rectangle", "to_world": place}


def summed(*shapes, minimum=20000, **lens):
    from mitsuba_fspt.validation import direct_summation

    scene = small_scenes.camera_scene(*shapes, **lens)
    power, pairs = direct_summation.solve(scene, scene.sensors()[0].camera, minimum)
    assert pairs >= (power > 0).sum()
    return power


@pytest.mark.parametrize("depth", [120.0, 230.0])
def test_sum_over_points_is_the_power_that_enters_the_diaphragm(depth):
    """Rationale: fine enough, the sum is Eq. 9, before and behind z = u: Σ P = J_n A sin²θ on the axis.

    Expected: 1 %, by pixel centres in a blur disc of some 40 pixels; cos⁴ over a patch of 2 mm is 1e-4.
    Seen to fail with D for D/2.
    """
    assert summed(patch(depth)).sum() == pytest.approx(PATCH**2 * RADIUS**2 / (RADIUS**2 + depth**2), rel=1e-2)


def test_sum_over_points_comes_to_the_integral_far_from_the_sharp_plane():
    """Expected: a blur disc of 8 pixels' radius gathers its edge by whole pixels: 2 % of the peak on any."""
    body = small_scenes.sphere(400.0, 20.0, x=3.0)
    truth = small_scenes.power(small_scenes.camera_scene(body), rtol=1e-3)
    assert np.abs(summed(body, minimum=1 << 15) - truth).max() < 0.02 * truth.max()


def test_sum_over_points_is_sparse_beside_the_virtual_detector_plane_and_misses_bodies_in_it():
    """Rationale: the blur disc shrinks below a pixel and hits a centre by luck; in the plane itself it never does."""
    near = summed(patch(FOCUS + 1), minimum=288, f_number=22.0, pixel_pitch=0.05)
    inside = near[HEIGHT // 2 - 6 : HEIGHT // 2 + 6, WIDTH // 2 - 6 : WIDTH // 2 + 6]
    assert (inside == 0).mean() > 0.5
    assert near.max() > 0
    assert summed(patch(FOCUS), f_number=22.0).max() == 0


def test_points_that_face_away_or_are_hidden_give_nothing():
    assert summed(patch(230.0, turn=0.0)).max() == 0
    both = summed(patch(230.0), small_scenes.disk(100.0, 30.0), minimum=2000)
    alone = summed(small_scenes.disk(100.0, 30.0), minimum=2000)
    assert alone.max() > 0
    np.testing.assert_allclose(both, alone, rtol=0, atol=1e-6 * alone.max())


def test_image_is_upright():
    """A patch up and to the right (x < 0, y > 0 of the camera frame) shines above and to the right of the middle."""
    power = summed(patch(230.0, x=-4.0, y=3.0))
    row, column = (power.sum(axis=1 - axis) @ np.arange(power.shape[axis]) / power.sum() for axis in (0, 1))
    assert column == pytest.approx(WIDTH / 2 - 0.5 + 4 * FOCUS / 230 / SIDE, abs=0.1)
    assert row == pytest.approx(HEIGHT / 2 - 0.5 - 3 * FOCUS / 230 / SIDE, abs=0.1)
