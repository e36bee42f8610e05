"""Distortion by OpenCV's model: power conserved on every pixel, by formulas written out here once more."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import fsolve
from small_scenes import HEIGHT, WIDTH, camera_scene, disk, sphere

import mitsuba_fspt as fspt
from mitsuba_fspt.camera.camera import Camera
from mitsuba_fspt.camera.film import Film
from mitsuba_fspt.optics.distortion import Distortion, distorted, preimage, shrink_in_double, slopes
from mitsuba_fspt.optics.thin_lens import Lens
from mitsuba_fspt.runtime.errors import OpticsError

pytestmark = pytest.mark.usefixtures("mono")
F, N, T, PITCH, MAGNIFIED = 55.0, 2.8, 0.3, 0.8, 0.9
LENGTH = F * (1 + T / MAGNIFIED) / T  # from the entrance pupil to the virtual detector plane
STRONG = (-1.5, 4.0, 0.02, -0.03, 6.0)  # barrel, by 8 % in the corners, and not centred
TEXT = ", ".join(map(str, STRONG))


def opencv(slope, k=STRONG):
    """Distorted slope, as OpenCV's documentation has it."""
    (x, y), (k1, k2, p1, p2, k3) = slope, k
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.array(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )


def seen(column, row):
    """Slope of the line of sight whose image is at a film position, by SciPy's root finder."""
    at = np.array([column - WIDTH / 2, row - HEIGHT / 2]) * PITCH / (T * LENGTH)
    return fsolve(lambda slope: opencv(slope) - at, at, xtol=1e-13)


def area_share(column, row, step=1e-3):
    """Area of the preimage of a small square of the film over that without distortion, by differences."""
    a = (seen(column + step, row) - seen(column - step, row)) / (2 * step)
    b = (seen(column, row + step) - seen(column, row - step)) / (2 * step)
    return abs(a[0] * b[1] - a[1] * b[0]) / (PITCH / (T * LENGTH)) ** 2


def scene(*shapes, **more):
    settings = {"magnification": T, "pixel_pitch": PITCH, "pupil_magnification": MAGNIFIED, "distortion": TEXT}
    return camera_scene(*shapes, exitance=2.0, **settings | more)


def test_model_inverse_and_derivatives():
    """The model is OpenCV's; its inverse brings slopes back, and the share of area is that of differences."""
    random = np.random.default_rng(1).uniform(-0.25, 0.25, (2, 50))
    found = np.array(distorted(*random, STRONG))
    np.testing.assert_allclose(found, opencv(random), rtol=1e-13, atol=1e-15)
    x, y, share = preimage(*found, STRONG, lambda x, y: shrink_in_double(x, y, 1.0))
    np.testing.assert_allclose((x, y), random, atol=1e-12)
    step = 1e-6
    a, b, d = slopes(*random, STRONG)
    for row, expected in ((0, (a, b)), (1, (b, d))):
        for k, shift in enumerate(np.eye(2)[:, :, None] * step):
            difference = (opencv(random + shift) - opencv(random - shift))[row] / (2 * step)
            np.testing.assert_allclose(difference, expected[k], atol=1e-8)
    np.testing.assert_allclose(share, 1 / (a * d - b * b), rtol=1e-10)


def test_film_map_is_its_own_inverse_with_the_jacobian_of_both():
    import mitsuba as mi

    lens = Lens.focused(F, N, magnification=T, pupil_magnification=MAGNIFIED, distortion=STRONG)
    film_map = Camera(lens, PITCH, Film.whole(WIDTH, HEIGHT)).film_map
    positions = np.random.default_rng(2).uniform([0, 0], [WIDTH, HEIGHT], (40, 2))
    at = mi.Point2f(*positions.T.astype(np.float32))
    x = film_map.to_plane(at)
    truth = np.array([seen(*position) for position in positions])
    np.testing.assert_allclose(x.numpy().T, -LENGTH * truth, atol=2e-5 * LENGTH)
    np.testing.assert_allclose(film_map.to_film(x).numpy().T, positions, atol=1e-4)
    np.testing.assert_allclose(film_map.from_ideal_in_double(film_map.to_ideal(at).numpy().T), positions, atol=1e-4)
    shares = [area_share(*position) for position in positions]
    np.testing.assert_allclose(film_map.area_share(at).numpy(), shares, rtol=2e-5)
    assert max(shares) > 1.25


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_uniform_plane_in_closed_form(domain):
    """P = J_n A_vd f(r) times the share of area, r that of the preimage: on pixels from corner to corner.

    Seen to fail without the share (25 % in the corners) and with y upwards.
    """
    image = fspt.render(
        scene(disk(F * (1 + 1 / T), 900.0), crop=None if domain == "pupil" else (0, 0, WIDTH, 6)),
        method="integral", pixel="centre", rtol=1e-4 if domain == "pupil" else 1e-2, domain=domain,
    )  # fmt: skip
    radius = F / N / 2
    places = ((0, 0), (0, WIDTH - 1), (HEIGHT - 1, 3), (HEIGHT // 2, 7), (5, WIDTH // 2))
    for row, column in (place for place in places if place[0] < len(image.power)):
        offset = LENGTH * np.hypot(*seen(column + 0.5, row + 0.5))
        z = LENGTH**2 + radius**2 + offset**2
        share = 0.5 * (1 - (z - 2 * radius**2) / np.sqrt(z**2 - 4 * radius**2 * offset**2))
        expected = 2.0 * (PITCH / T) ** 2 * share * area_share(column + 0.5, row + 0.5)
        assert image.power[row, column] == pytest.approx(expected, rel=5e-5 if domain == "pupil" else 1e-2)
    if domain == "pupil":
        radiance = fspt.render(scene(disk(F * (1 + 1 / T), 900.0)), method="integral", rtol=1e-4).to_radiance(660)
        expected = float(radiance.values.mean())
        np.testing.assert_allclose(radiance.values, expected, rtol=2e-4)  # the étendue map has the share, too


def test_total_of_an_isolated_body_does_not_change():
    """With and without, to 5e-4: light moves between pixels and is neither made nor lost."""
    body = sphere(230.0, 4.0, x=30.0, y=20.0)
    with_it, without = (
        fspt.render(scene(body, **more), method="integral", rtol=2e-3) for more in ({}, {"distortion": "0, 0"})
    )
    assert with_it.power.sum() == pytest.approx(without.power.sum(), rel=5e-4)
    assert np.abs(with_it.power - without.power).max() > 0.1 * without.power.max()
    assert with_it.metadata["distortion"] == "-1.5, 4, 0.02, -0.03, 6"
    assert "distortion" not in without.metadata


def test_path_and_the_matrix_agree_pixel_by_pixel():
    body = sphere(230.0, 9.0, x=25.0, y=15.0)
    image = fspt.render(scene(body), method="integral", rtol=1e-3)
    found = fspt.compare(image, fspt.render(scene(body), method="path", spp=256, seed=1))
    assert found.ratio == pytest.approx(1, abs=5e-3)
    assert found.z_test.p_value > 1e-3
    tracer = fspt.render(scene(body), method="ptracer", spp=256, seed=1)
    assert tracer.power.sum() == pytest.approx(image.power.sum(), abs=4 * np.sqrt((tracer.error**2).sum()))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("0.1", "has 1 numbers"),
        ("0.1, 0.2, 0.3", "has 3 numbers"),
        ((0.1,) * 8, "has 8 numbers"),
        ("0.1, wide", "must be finite numbers"),
        ((0.1, np.nan), "must be finite numbers"),
    ],
)
def test_another_length_or_no_numbers_are_refused(bad, message):
    with pytest.raises(OpticsError, match=message) as caught:
        Distortion.of(bad)
    assert "\n" not in str(caught.value)


def test_a_map_that_folds_inside_the_film_is_refused_with_the_radius():
    """x (1 + k x²) turns at x = 1/√(-3k), where the image height is F (1 + t/P) · ⅔ x."""
    fold = 1 / np.sqrt(3 * 20)
    radius = F * (1 + T) * 2 / 3 * fold
    lens = Lens.focused(F, N, magnification=T, distortion="-20, 0")
    with pytest.raises(OpticsError, match=r"fspt_lens: 'distortion' = .* folds the image at a radius of") as caught:
        Camera(lens, PITCH, Film.whole(60, 60))
    told = float(str(caught.value).split("radius of ")[1].split(" mm")[0])
    assert told == pytest.approx(radius, rel=0.02)
    with pytest.raises(OpticsError, match="exclude each other"):
        Lens.focused(F, N, magnification=T, distortion="-0.1, 0", lens_diameter=40.0, diaphragm_distance=5.0)


def test_opencvs_camera_takes_it():
    import mitsuba as mi

    K = np.array([[330.0, 0, 29.5], [0, 330.0, 21.5], [0, 0, 1]])
    found = fspt.camera_from_opencv(
        K, np.zeros(3), [0, 0, 170.0], width=60, height=44, distortion=(-0.3, 0.1, 1e-3, 0, 0)
    )
    sensor = fspt.load(
        f'<scene version="3.0.0">{found.sensor_xml(focal_length=F, f_number=N, magnification=T)}</scene>'
    ).sensors()[0]
    assert sensor.camera.lens.distortion == Distortion(-0.3, 0.1, 1e-3)
    point = np.array([18.0, -11.0, 0.0])
    position, *_ = sensor.camera.arrival(mi.Point3f(*point.tolist()), mi.Point2f(0))
    slope = opencv(point[:2] / 170.0, (-0.3, 0.1, 1e-3, 0, 0))
    np.testing.assert_allclose(position.numpy().ravel() - 0.5, 330 * slope + [29.5, 21.5], atol=1e-3)
