"""A camera of OpenCV's K, rvec, tvec: small spheres appear where an independent projection puts them."""

from __future__ import annotations

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import OpticsError

WIDTH, HEIGHT = 60, 44
K = np.array([[330.0, 0, 31.5], [0, 330.0, 18.0], [0, 0, 1]])  # the middle of the image is (29.5, 21.5)
RVEC, TVEC = np.array([0.3, -0.5, 1.2]), np.array([4.0, -6.0, 170.0])
POINTS = np.array([[0, 0, 0], [9, 2, 1], [-6, 7, -3], [2, 3, -5.0]])


def projected(points):
    """Pixels (n, 2) by x = K (R X + t), R by Rodrigues' formula written out: column to the right, row downwards."""
    angle = np.linalg.norm(RVEC)
    x, y, z = RVEC / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    camera = points @ rotation.T + TVEC
    image = camera @ K.T
    return image[:, :2] / image[:, 2:]


def scene(sensor, point):
    x, y, z = point
    return f"""<scene version="3.0.0"><integrator type="fspt_integral"/>{sensor}
    <shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/><float name="radius" value="0.3"/>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter></shape></scene>"""


@pytest.mark.parametrize("point", POINTS, ids=str)
def test_points_appear_where_opencv_projects_them(point, mono):
    """Centre of light within 0.05 pixels of the projection: a sphere's image is off its centre's by less than 0.01.

    Pose, upright image, row 0 at the top, pixel pitch and principal point each move it by pixels: seen to fail with
    Rᵀ for R, without the signs of x and y, without the crop, and with whole numbers at the corners of pixels.
    """
    camera = fspt.camera_from_opencv(K, RVEC[:, None], TVEC[:, None], width=WIDTH, height=HEIGHT)
    sensor = camera.sensor_xml(focal_length=55, f_number=22, focus_distance=170)
    power = fspt.render(fspt.load(scene(sensor, point)), method="integral", rtol=3e-3).power.astype(float)
    assert power.shape == (HEIGHT, WIDTH)
    column, row = projected(point[None])[0]
    assert 3 < column < WIDTH - 3
    assert 3 < row < HEIGHT - 3
    total = power.sum()
    assert total > 0
    assert power.sum(axis=0) @ np.arange(WIDTH) / total == pytest.approx(column, abs=0.05)
    assert power.sum(axis=1) @ np.arange(HEIGHT) / total == pytest.approx(row, abs=0.05)


def test_pixel_pitch_is_that_of_the_image_distance():
    camera = fspt.camera_from_opencv(K, RVEC, TVEC, width=WIDTH, height=HEIGHT)
    assert camera.pixel_pitch(82.5) == pytest.approx(82.5 / 330)
    assert 'name="pixel_pitch" value="0.25"' in camera.sensor_xml(focal_length=55, f_number=8, magnification=0.5)
    assert camera.to_world[:3, :3] @ camera.to_world[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(camera.to_world) == pytest.approx(1)


def test_camera_parameters_that_a_lens_lacks_are_reported():
    """f_y 0.5 % larger and a little skew: left out, 0.2 pixels in the corner; more is refused."""
    unequal = K.copy()
    unequal[1, 1] *= 1.005
    unequal[0, 1] = 1.0
    camera = fspt.camera_from_opencv(unequal, RVEC, TVEC, width=WIDTH, height=HEIGHT)
    assert 0.1 < camera.deviation < 0.3
    assert camera.focal_pixels == pytest.approx(330 * 1.0025)
    for place, value, words in (
        ((1, 1), 340.0, "move a corner"),
        ((0, 1), 12.0, "move a corner"),
        ((0, 2), 500.0, "principal point"),
        ((0, 0), -330.0, "must be > 0"),
        ((2, 0), 0.1, "must be \\(\\(f_x"),
        ((0, 0), np.nan, "finite numbers"),
    ):
        bad = K.copy()
        bad[place] = value
        with pytest.raises(OpticsError, match=words):
            fspt.camera_from_opencv(bad, RVEC, TVEC, width=WIDTH, height=HEIGHT)
    degrees = "'rvec' must be a turn of at most 2 pi rad, its length is 90.*in degrees it would be 1.571 rad"
    with pytest.raises(OpticsError, match=degrees):  # seen to fail: 90 rad, another pose, without a word
        fspt.camera_from_opencv(K, [0, 90, 0], TVEC, width=WIDTH, height=HEIGHT)
    with pytest.raises(OpticsError, match="'rvec' must be"):
        fspt.camera_from_opencv(K, [1, 2], TVEC, width=WIDTH, height=HEIGHT)
    with pytest.raises(OpticsError, match="sets no focus"):
        fspt.camera_from_opencv(K, RVEC, TVEC, width=WIDTH, height=HEIGHT).sensor_xml(focal_length=5, f_number=8, u=1)
