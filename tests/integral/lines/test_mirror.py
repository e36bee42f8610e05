"""Mirror images of a camera."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from small_scenes import FOCUS, camera_scene, disk, mi

from mitsuba_fspt.camera.of_sensor import camera_of
from mitsuba_fspt.integral.lines.mirror import MOST_IMAGES, Mirror, MirrorImages

pytestmark = pytest.mark.usefixtures("mono")


def facing(x, towards):
    """A long mirror across the x axis at `x` [mm], of 20 mm to both sides of it."""
    return Mirror(np.array([x, 0, 100]), np.array([towards, 0, 0]), (x, -20.0, 80.0, x, 20.0, 2000.0))


def images_in(mirrors, camera, corners, most):
    """Mirror images of a camera, of which none is missing."""
    found = MirrorImages.of(mirrors, camera, corners, most)
    assert found.complete
    return [image for image, _ in found.images]


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
    images = images_in([facing(-8.0, 1.0), facing(8.0, -1.0)], camera, body, most)
    assert len(images) == count
    assert sorted(round(image.centre[0]) for image in images)[-1] == pytest.approx(16 * most)


def test_a_mirror_shows_nothing_beyond_its_plane(camera):
    left = facing(-12.0, 1.0)
    assert images_in([left], camera, np.array([[-40.0, 0.0, 100.0]]), 8) == []
    assert left.separates(camera, np.array([[-40.0, 0.0, 100.0]]))
    assert not left.separates(camera, np.array([[40.0, 0.0, 100.0]]))


def test_of_many_images_the_first_ones_are_listed(camera):
    """Three mirrors around a body: more than 64 images by eight of them one after the other."""
    mirrors = [facing(-8.0, 1.0), facing(8.0, -1.0)]
    mirrors.append(Mirror(np.array([0, 0, 130.0]), np.array([0.1, 0, -np.sqrt(0.99)]), (-300, -20, 125, 300, 20, 135)))
    body = np.array([[0.0, 0.0, 100.0]])
    found = MirrorImages.of(mirrors, camera, body, 8)
    assert not found.complete
    assert MOST_IMAGES / 4 < len(found.images) <= MOST_IMAGES
    single = [tuple(np.round(image.centre, 3)) for image in images_in(mirrors, camera, body, 1)]
    assert [tuple(np.round(image.centre, 3)) for image, _ in found.images[: len(single)]] == single


def test_a_mirror_beyond_the_film_shows_nothing(camera):
    beside = Mirror(np.array([300.0, 0, 100.0]), np.array([-1.0, 0, 0]), (300, -1, 99, 300, 1, 101))
    assert images_in([beside], camera, np.array([[0.0, 0.0, 100.0]]), 8) == []


def test_mirrors_at_a_right_angle_show_three_images(camera):
    half = np.sqrt(0.5)
    turned = [np.array([half, 0, -half]), np.array([-half, 0, -half])]
    mirrors = [Mirror(np.array([0.0, 0.0, 170.0]), n, (-40.0, -20.0, 90.0, 40.0, 20.0, 170.0)) for n in turned]
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


def test_a_fine_mesh_far_from_the_origin_is_one_plane(mono):
    """Of 320,000 faces in float32, whose own normals differ by their rounding; and two such meshes in one."""
    side = np.linspace(-50, 50, 401)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.4]))[:3, :3]
    x, y = (c.ravel() for c in np.meshgrid(side, side))
    points = np.column_stack([x, y, np.full(x.size, 500.0)])
    number = np.arange(x.size).reshape(401, 401)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    for count in (1, 2):
        places = np.concatenate([points + np.array([0, 0, 60 * k]) for k in range(count)]) @ turn.T
        mesh = mi.Mesh("plane", len(places), count * len(faces))
        values = mi.traverse(mesh)
        values["vertex_positions"] = mi.Float(places.astype(np.float32).ravel())
        corners = np.concatenate([faces + k * x.size for k in range(count)])
        values["faces"] = mi.UInt32(corners.astype(np.uint32).ravel())
        values.update()
        planes = Mirror.of(mesh)
        assert len(planes) == count
        assert all(abs(plane.normal @ turn[:, 2]) == pytest.approx(1, abs=1e-9) for plane in planes)
