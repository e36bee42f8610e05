"""Places from which a camera looks straight through a plate of glass."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import FOCUS, camera_scene, disk, mi

from mitsuba_fspt.camera.of_sensor import camera_of
from mitsuba_fspt.integral.lines.mirror import Mirror, corners_of
from mitsuba_fspt.integral.lines.plate import Plate

N, THICK, DEPTH = 1.5, 3.0, 80.0
BOX = (-6.0, -5.0, FOCUS - 5, 6.0, 5.0, FOCUS + 5)

pytestmark = pytest.mark.usefixtures("mono")


@pytest.fixture(scope="module")
def camera(mono):
    return camera_of(camera_scene(disk(FOCUS, 6)).sensors()[0])


def glass(tilt=0.0, thickness=THICK, bsdf="dielectric", index=N):
    """A plate of glass about the y axis [°], 160 mm wide."""
    turned = mi.ScalarTransform4f().translate([0, 0, DEPTH]).rotate([0, 1, 0], tilt).scale([80, 80, thickness / 2])
    bsdf = {"type": bsdf} if bsdf == "diffuse" else {"type": bsdf, "int_ior": index, "ext_ior": 1.0}
    return mi.load_dict({"type": "cube", "to_world": turned, "bsdf": bsdf})


def plate_of(camera, shape, box=BOX):
    return Plate.of(shape, shape.bsdf(), Mirror.of(shape), camera, corners_of([box]))


def behind(slope, passes, far, tilt):
    """Where a line of sight from the origin is so far [mm] behind a plate that it has crossed `passes` times.

    Snell's law in the plane of the axis and the plate's normal; x and z.
    """
    turn = np.radians(tilt)
    normal, along = np.array([np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), -np.sin(turn)])
    way = np.array([slope, 1]) / np.hypot(slope, 1)
    start = (DEPTH * np.cos(turn) - THICK / 2) / (way @ normal) * way  # where it meets the plate
    sine = way @ along / N
    aside = passes * THICK * sine / np.sqrt(1 - sine**2)  # refracted, and reflected by parallel sides
    return start + THICK * normal + aside * along + far * way


@pytest.mark.parametrize("tilt", [0.0, 30.0])
@pytest.mark.parametrize("passes", [1, 3])
def test_the_camera_at_its_image_sees_a_point_where_light_through_the_plate_comes_from(camera, tilt, passes):
    """Seen to fail where an image lies at the camera, and the second one where it lies at the first."""
    plate = plate_of(camera, glass(tilt))
    assert (plate.thickness, plate.index) == pytest.approx((THICK, N), rel=1e-5)
    image = plate.images(camera, [BOX])[passes // 2]
    for slope in (-0.03, 0.0, 0.04):
        x, z = behind(slope, passes, FOCUS - DEPTH, tilt).tolist()
        seen, direct = image.blur_disc(mi.Point3f(x, 0, z))[0], camera.blur_disc(mi.Point3f(slope * z, 0, z))[0]
        assert abs(seen - direct).numpy().max() < 0.5


def test_more_reflections_inside_take_the_fourth_power_of_fresnels_share(camera):
    """R = ((n - 1)/(n + 1))² at normal incidence; a little more to the sides, for light that is polarised."""
    share = ((N - 1) / (N + 1)) ** 8
    assert share <= plate_of(camera, glass()).reflected_more(camera, [BOX]) < 1.2 * share


def test_only_a_plate_between_the_lens_and_all_that_glows_has_images(camera):
    before = (-6.0, -5.0, DEPTH - 9, 6.0, 5.0, DEPTH - 5)
    assert plate_of(camera, glass(), before) is None
    assert plate_of(camera, glass(bsdf="diffuse")) is None
    ball = mi.load_dict({"type": "sphere", "center": [0, 0, DEPTH], "radius": 3, "bsdf": {"type": "dielectric"}})
    assert plate_of(camera, ball) is None
    thick = plate_of(camera, glass(tilt=30, thickness=60))  # its rays to the sides of the box are too far apart
    assert thick.images(camera, [BOX]) is None
    gap = plate_of(camera, glass(tilt=50, index=0.75))  # of air in water, beyond the critical angle
    assert gap.images(camera, [BOX]) is None
    assert gap.reflected_more(camera, [BOX]) == 1
