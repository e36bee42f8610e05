"""Mirror images of a camera."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import FOCUS, camera_scene, disk, mi

from mitsuba_fspt.camera.of_sensor import camera_of
from mitsuba_fspt.integral.lines.mirror import MOST_IMAGES, Mirror, images_in

pytestmark = pytest.mark.usefixtures("mono")


def facing(x, towards):
    """A mirror across the x axis at `x` [mm], of 20 mm to both sides of it."""
    y, z = (side.ravel() for side in np.meshgrid([-20.0, 20.0], [80.0, 120.0]))
    return Mirror(np.array([x, 0, 100]), np.array([towards, 0, 0]), np.tile(np.column_stack([0 * y + x, y, z]), (2, 1)))


@pytest.fixture(scope="module")
def camera(mono):
    return camera_of(camera_scene(disk(FOCUS, 6)).sensors()[0])


def test_a_camera_sees_a_mirror_image_as_its_mirror_image_sees_the_object(camera):
    normal, centre = np.array([0.6, 0.0, -0.8]), np.array([3.0, 1.0, 80.0])
    point = np.array([30.0, 2.0, 70.0])
    there = point - 2 * (point - centre) @ normal * normal
    seen, direct = camera.reflected(centre, normal), camera.blur_disc(mi.Point3f(there.tolist()))
    for one, other in zip(seen.blur_disc(mi.Point3f(point.tolist())), direct, strict=True):
        np.testing.assert_allclose(one.numpy(), other.numpy(), rtol=1e-5)
    pupil = mi.Point2f(0.3, -0.8)
    on_lens, straight = (
        c.arrival(mi.Point3f(p.tolist()), pupil)[1].numpy().ravel() for c, p in ((seen, point), (camera, there))
    )
    np.testing.assert_allclose(on_lens, straight - 2 * (straight - centre) @ normal * normal, rtol=1e-5)


@pytest.mark.parametrize(("most", "count"), [(1, 2), (2, 4), (3, 6)])
def test_two_mirrors_that_face_each_other_show_two_images_for_each_bounce(camera, most, count):
    body = np.array([[0.0, 0.0, 100.0]])
    images = images_in([facing(-30.0, 1.0), facing(30.0, -1.0)], camera, body, most)
    assert len(images) == count
    assert sorted(round(image.centre[0]) for image in images)[-1] == pytest.approx(60 * most)


def test_a_mirror_shows_nothing_beyond_its_plane_and_many_images_are_not_listed(camera):
    left, right = facing(-30.0, 1.0), facing(30.0, -1.0)
    assert images_in([left], camera, np.array([[-40.0, 0.0, 100.0]]), 8) == []
    assert left.separates(camera, np.array([[-40.0, 0.0, 100.0]]))
    assert not left.separates(camera, np.array([[40.0, 0.0, 100.0]]))
    assert images_in([left, right], camera, np.array([[0.0, 0.0, 100.0]]), MOST_IMAGES) is None


def test_mirrors_at_a_right_angle_show_three_images(camera):
    half = np.sqrt(0.5)
    turned = [np.array([half, 0, -half]), np.array([-half, 0, -half])]
    corners = np.array([[x, y, z] for x in (-40.0, 40.0) for y in (-20.0, 20.0) for z in (90.0, 170.0)])
    mirrors = [Mirror(np.array([0.0, 0.0, 170.0]), normal, corners) for normal in turned]
    images = images_in(mirrors, camera, np.array([[0.0, 0.0, 120.0]]), 8)
    assert sorted(tuple(np.round(image.centre)) for image in images) == [(-170, 0, 170), (0, 0, 340), (170, 0, 170)]


def test_planes_of_a_mesh_are_told_apart(mono):
    """As of mirrors that Mitsuba merges into one mesh when it loads a dictionary."""
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale([1, 2, 3])})
    planes = Mirror.of(cube)
    expected = {tuple(sign * axis) for axis in np.eye(3) for sign in (1, -1)}
    assert {tuple(np.round(plane.normal) + 0.0) for plane in planes} == {
        tuple(n + 0.0) for n in map(np.array, expected)
    }
    for plane in planes:
        assert np.ptp(plane.corners @ plane.normal) == pytest.approx(0, abs=1e-6)
    assert Mirror.of(mi.load_dict({"type": "sphere"})) == ()
