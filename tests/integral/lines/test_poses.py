"""Poses from which a camera looks straight at what mirrors and glass show, against rays by Snell's law."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import FOCUS, camera_scene, disk, mi

from mitsuba_fspt.camera.of_sensor import camera_of
from mitsuba_fspt.integral.lines.glass import Glass
from mitsuba_fspt.integral.lines.mirror import Mirror, Untraced, reflected_share
from mitsuba_fspt.integral.lines.plane import Plane
from mitsuba_fspt.integral.lines.pose import Pose, Unlocated
from mitsuba_fspt.integral.lines.poses import MOST_POSES, Poses

N = 1.5
R = ((N - 1) / (N + 1)) ** 2  # Fresnel's share at normal incidence
AXIS = np.array([0.0, 0.0, 1.0])

pytestmark = pytest.mark.usefixtures("mono")


@pytest.fixture(scope="module")
def camera(mono):
    return camera_of(camera_scene(disk(FOCUS, 6)).sensors()[0])


def ball(z, x=0.0, radius=5.0):
    """Corners of the box of a ball."""
    return np.array([x, 0, z]) + radius * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T


def facing(x, towards):
    """A mirror across the x axis at `x` [mm]."""
    corners = np.array([[x, y, z] for y, z in ((-20, 80), (20, 80), (20, 2000), (-20, 2000))])
    return Mirror((Plane(np.array([x, 0, 100.0]), np.array([towards, 0, 0.0]), corners),))


def poses_of(shapes, camera, glowing, most=8, least=1e-4):
    return Poses.of(shapes, camera, glowing, most, least)


def plate(z, thickness, tilt=0.0, size=80.0, index=N, others=()):
    """A plate of glass about the y axis [°], twice `size` wide."""
    turned = mi.ScalarTransform4f().translate([0, 0, z]).rotate([0, 1, 0], tilt).scale([size, size, thickness / 2])
    bsdf = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
    shape = mi.load_dict({"type": "cube", "to_world": turned, "bsdf": bsdf})
    return Glass.of(shape, shape.bsdf(), Plane.of(shape), others)


def refracted(way, normal, ratio):
    """Direction of a ray behind a border, by Snell's law; `ratio`: index before it over that behind it."""
    normal = -np.sign(way @ normal) * normal
    cosine = -way @ normal
    return ratio * way + (ratio * cosine - np.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal


def traced(slope, borders, far):
    """Where a ray from the origin is `far` [mm] behind the last of some borders.

    Each is a point and normal, and 'in', 'out' or 'off': into glass, out of it, or reflected.
    """
    at, way = np.zeros(3), np.array([slope, 0.01, 1]) / np.linalg.norm([slope, 0.01, 1])
    for point, normal, kind in borders:
        at = at + (point - at) @ normal / (way @ normal) * way
        way = (
            way - 2 * (way @ normal) * normal
            if kind == "off"
            else refracted(way, normal, {"in": 1 / N, "out": N}[kind])
        )
    return at + far * way


def sides(z, thickness, tilt):
    """Middle of the front and of the back of a plate about the y axis [°], and the normal."""
    normal = np.array([np.sin(np.radians(tilt)), 0, np.cos(np.radians(tilt))])
    return z * AXIS - thickness / 2 * normal, z * AXIS + thickness / 2 * normal, normal


def courses(tilt):
    """Borders on courses over a plate at 80 mm, another at 100 mm, and a mirror at 130 mm; the share of the light."""
    (front, back, normal), (front2, back2, normal2) = sides(80, 3.0, tilt), sides(100, 4.0, -5.0)
    through = [(front, normal, "in"), (back, normal, "out")]
    inside = [(back, normal, "off"), (front, normal, "off")]
    second = [(front2, normal2, "in"), (back2, normal2, "out")]
    turned = np.array([1, 0, -1]) / np.sqrt(2)
    return {
        "through": (through, 1),
        "two reflections inside": ([through[0], *inside, through[1]], R**2),
        "off the back": ([through[0], inside[0], (front, normal, "out")], R),
        "two plates": ([*through, *second], 1),
        "between two plates": ([*through, (front2, normal2, "off"), (back, normal, "off"), *second], R**2),
        "mirror behind": ([*through, (130 * AXIS, turned, "off")], 1),
    }


@pytest.mark.parametrize("tilt", [0.0, 20.0])
@pytest.mark.parametrize("course", courses(0.0))
def test_from_one_of_the_places_a_camera_looks_straight_at_the_end_of_a_ray(camera, course, tilt):
    """Seen to fail with a plate's poses at the camera, or all for one passage, and without reflections at glass."""
    borders, share = courses(tilt)[course]
    shapes = [plate(80, 3.0, tilt)]
    if course in ("two plates", "between two plates"):
        shapes.append(plate(100, 4.0, -5.0))
    if course == "mirror behind":
        turned = mi.ScalarTransform4f().translate([0, 0, 130]).rotate([0, 1, 0], -45).scale(60)
        shapes.append(Mirror(Plane.of(mi.load_dict({"type": "rectangle", "to_world": turned}))))
    for slope in (-0.03, 0.02):
        end = traced(slope, borders, 60.0)
        seen = camera.blur_disc(mi.Point3f(slope * FOCUS, 0.01 * FOCUS, FOCUS))[0].numpy().ravel()
        found = poses_of(shapes, camera, end[None], least=1e-5).found
        apart = [abs(pose.camera.blur_disc(mi.Point3f(end.tolist()))[0].numpy().ravel() - seen).max() for pose in found]
        nearest = found[int(np.argmin(apart))]
        pixel = camera.virtual_pitch * nearest.camera.depths(end[None])[0] / camera.lens.focus_distance
        assert min(apart) < min(0.03 + nearest.misplaced / pixel, 0.1)
        assert share <= nearest.share < 3 * share  # of the polarisation that is reflected more


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
def test_two_mirrors_that_face_each_other_show_two_images_for_each_bounce(mono, most, count):
    camera = camera_of(camera_scene(disk(FOCUS, 6), magnification=0.05).sensors()[0])
    poses = poses_of([facing(-12.0, 1.0), facing(12.0, -1.0)], camera, ball(600, radius=0.1), most)
    assert not poses.unlocated
    assert len(poses.found) == count
    assert sorted(round(pose.camera.centre[0]) for pose in poses.found)[-1] == pytest.approx(24 * most)


def test_a_mirror_shows_nothing_beyond_its_plane(camera):
    left = facing(-12.0, 1.0)
    assert poses_of([left], camera, ball(100, x=-40.0)) == Poses((), ())
    assert left.planes[0].separates(camera, ball(100, x=-40.0))
    assert not left.planes[0].separates(camera, ball(100, x=40.0))


def test_a_mirror_beyond_the_film_shows_nothing(camera):
    beside = np.array([[300.0, y, z] for y, z in ((-1, 99), (1, 99), (1, 101), (-1, 101))])
    mirror = Mirror((Plane(beside.mean(axis=0), np.array([-1.0, 0, 0]), beside),))
    assert poses_of([mirror], camera, ball(100)) == Poses((), ())


def test_mirrors_at_a_right_angle_show_three_images_and_one_of_them_twice(camera):
    """Light by both mirrors comes from one pose, on either half of the film by the mirror that it meets last."""
    half = np.sqrt(0.5)
    mirrors = []
    for sign in (1, -1):
        corners = np.array([[0.0, y, 170] for y in (-20, 20)] + [[-40.0 * sign, y, 130] for y in (20, -20)])
        mirrors.append(Mirror((Plane(corners.mean(axis=0), half * np.array([sign, 0, -1]), corners),)))
    found = poses_of(mirrors, camera, ball(120, radius=3.0)).found
    by_both = [pose for pose in found if pose.lobes == 2]
    assert {tuple(np.round(pose.camera.centre)) for pose in by_both} == {(0, 0, 340)}
    left, right = sorted(pose.region[0] for pose in by_both)
    assert left < right


def test_of_many_places_those_of_few_lobes_come_first(camera):
    """Three mirrors around a body: more poses than are listed, by twelve of them one after the other."""
    mirrors = [facing(-8.0, 1.0), facing(8.0, -1.0)]
    corners = np.array([[x, y, 125.0] for x, y in ((-300, -20), (300, -20), (300, 20), (-300, 20))])
    mirrors.append(Mirror((Plane(np.array([0, 0, 130.0]), np.array([0.1, 0, -np.sqrt(0.99)]), corners),)))
    poses = poses_of(mirrors, camera, ball(100, radius=0.1), most=12)
    assert MOST_POSES / 4 < len(poses.found) <= MOST_POSES
    assert max(line.share for line in poses.unlocated) == 1
    lobes = [pose.lobes for pose in poses.found]
    assert lobes == sorted(lobes)


def test_glass_behind_a_body_reflects_the_share_of_fresnels_equations(camera):
    """At the front and at the back: less than a twentieth of the light at each."""
    found = poses_of([plate(200, 3.0)], camera, ball(150), least=0.01).found
    assert [pose.lobes for pose in found] == [1, 3]
    assert all(R <= pose.share < 1.2 * R for pose in found)
    cosine = np.array([1.0, 0.8, 0.1])
    for index, expected in ((N, 1.0), (1 / N, 0.9)):
        sine = np.sqrt(1 - cosine[:1] ** 2 * expected) / index
        assert reflected_share(cosine[:1], index) == pytest.approx(R), sine
    assert reflected_share(cosine[2:], 1 / N) == 1  # beyond the critical angle


def test_a_mirror_behind_a_plate_is_not_seen_without_it(camera):
    """Of both plates, too, all lines of sight to a ball meet the first one; small ones leave other courses."""
    for size, count in ((80.0, 1), (5.0, 3)):
        shapes = [plate(80, 3.0, size=size), plate(100, 4.0, size=size)]
        found = poses_of(shapes, camera, ball(FOCUS), least=0.5).found
        assert len(found) == count


@pytest.mark.parametrize(
    ("case", "share"), [("inside", 1), ("prism", 1), ("lens", 1), ("thick", 1), ("gap", 1), ("rim", 1)]
)
def test_lines_of_sight_that_end_at_places_not_known_are_told(camera, case, share):
    glowing = ball(FOCUS)
    shapes = {
        "inside": lambda: [plate(80, 3.0, others=[ball(80, radius=1.0)]) or Untraced(ball(80, radius=80.0))],
        "prism": lambda: [Glass(tuple(side for side in plate(80, 3.0).planes if side.normal[2] < 0.5), N)],
        "lens": lambda: [plate(0, 60.0)],
        "thick": lambda: [plate(80, 60.0, tilt=30)],  # its rays to the sides of the ball are too far apart
        "gap": lambda: [plate(80, 3.0, tilt=50, index=0.75)],  # of air in water, beyond the critical angle
        "rim": lambda: [plate(80, 3.0, size=20)],
    }[case]()
    poses = poses_of(shapes, camera, glowing)
    assert max(line.share for line in poses.unlocated) == share
    middle = [line for line in poses.unlocated if line.region[0] < 20 < line.region[2]]
    assert bool(middle) == (case != "rim")


def test_a_disk_of_glass_is_no_body(mono):
    disk_of_glass = mi.load_dict({"type": "disk", "bsdf": {"type": "dielectric"}})
    assert Glass.of(disk_of_glass, disk_of_glass.bsdf(), Plane.of(disk_of_glass), []) is None


def test_what_lies_a_micrometre_behind_glass_is_seen_through_it(camera):
    """Seen to fail where heights over the last surface count as 0 up to 30 µm in a metre."""
    (_, back, _) = sides(80, 3.0, 0.0)
    disc = back + np.array([[-1, -1, 1e-3], [1, -1, 1e-3], [1, 1, 1e-3], [-1, 1, 1e-3]])
    assert [pose.lobes for pose in poses_of([plate(80, 3.0)], camera, disc).found] == [2, 4]
    stack = [plate(80, 3.0), plate(83.001, 3.0)]
    assert poses_of(stack, camera, ball(FOCUS), least=0.5).found[0].lobes == 4


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_mirror_in_whose_plane_the_pupil_lies_shows_what_is_on_either_side(camera, side):
    assert poses_of([facing(2.0, 1.0)], camera, ball(FOCUS, x=2 + 5 * side, radius=1.0)).found


def test_mirrors_hide_only_what_no_line_of_sight_passes_by(mono):
    """What is behind a mirror before another one; not where the pupil shifts with the point of the film."""
    mirrors = [
        Mirror(Plane.of(mi.load_dict({"type": "rectangle", "to_world": turned.scale(size)})))
        for turned, size in (
            (mi.ScalarTransform4f().translate([0, 0, 80]), 12.0),
            (mi.ScalarTransform4f().translate([0, 0, 120]).rotate([0, 1, 0], -45), 4.0),
        )
    ]
    for lens, behind in (({}, 0), ({"diaphragm_distance": 20.0, "lens_diameter": 60.0}, 1)):
        camera = camera_of(camera_scene(disk(FOCUS, 6), **lens).sensors()[0])
        for shapes, count in ((mirrors, behind), (mirrors[1:], 1)):
            assert len(poses_of(shapes, camera, ball(120, x=40.0, radius=1.0), least=0.5).found) == count


def test_lines_of_sight_beside_an_inexact_pose_are_in_its_region(camera):
    """Seen to fail where the region is that of the inexact pose alone."""
    points = ball(FOCUS, radius=1.0)
    exact, inexact = (Pose(camera, misplaced=far).towards(points).region for far in (0.0, 2.0))
    aside = 2.0 / (camera.virtual_pitch * (FOCUS - 1) / FOCUS)
    assert np.subtract(inexact, exact) == pytest.approx([-aside, -aside, aside, aside], rel=1e-3)
    assert Pose(camera, misplaced=2.0).showing(points) == Unlocated(inexact, 1.0)


def test_a_wedge_is_no_plate(camera):
    """Its sides at an angle of half a degree send light to another pixel."""
    sides_of = plate(80, 3.0).planes
    turned = np.array([np.sin(np.radians(0.5)), 0, np.cos(np.radians(0.5))])
    tilted = tuple(Plane(side.point, turned, side.corners) if side.normal[2] > 0.9 else side for side in sides_of)
    poses = poses_of([Glass(tilted, N)], camera, ball(FOCUS))
    assert not poses.found
    assert poses.unlocated
