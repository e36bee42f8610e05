"""Compound lenses: the entrance pupil away from the principal plane, by closed forms that share no code with it."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import HEIGHT, WIDTH, camera_scene, disk

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.pixel_etendue import mean_cos4
from mitsuba_fspt.optics.thin_lens import Lens
from mitsuba_fspt.runtime.errors import OpticsError

F, N, T, PITCH = 55.0, 2.8, 0.3, 0.4
U = F * (1 + 1 / T)
MAGNIFIED = [0.8, 1.25, 2.0]
EXITANCE = 2.0


def share_of_disc(radius, distance, offset):
    """Configuration factor from a point to a parallel disc, written down from the textbook."""
    z = distance**2 + radius**2 + offset**2
    return 0.5 * (1 - (z - 2 * radius**2) / np.sqrt(z**2 - 4 * radius**2 * offset**2))


def pupil(magnified):
    """Depth before the lens plane and radius [mm] of the entrance pupil."""
    return F * (1 - 1 / magnified), F / N / 2


def lens(magnified, **more):
    return Lens.focused(F, N, magnification=T, pupil_magnification=magnified, **more)


def virtual_offsets():
    """Distance from the axis [mm] of the middles of the virtual pixels, (h, w)."""
    x, y = ((np.arange(count) + 0.5 - count / 2) * PITCH / T for count in (WIDTH, HEIGHT))
    return np.hypot(x[None, :], y[:, None])


def scene(*shapes, magnified, **more):
    return camera_scene(*shapes, exitance=EXITANCE, magnification=T, pupil_magnification=magnified, **more)


@pytest.mark.parametrize("magnified", MAGNIFIED)
def test_the_pupil_is_that_of_a_diaphragm_off_the_lens(magnified):
    """A diaphragm F (1 − P) behind the lens, or F (1 − 1/P) before it, has an entrance pupil in the same place."""
    found = lens(magnified).discs
    if magnified < 1:
        apart = {"diaphragm_distance": F * (1 - magnified), "f_number": N / magnified}
    else:
        apart = {"diaphragm_distance": -F * (1 - 1 / magnified), "f_number": N}
    other = Lens.focused(F, apart.pop("f_number"), magnification=T, lens_diameter=500.0, **apart).discs
    assert len(found) == 1
    assert found[0].shift == pytest.approx(other[0].shift, rel=1e-12)
    assert found[0].radius == pytest.approx(other[0].radius, rel=1e-12)


@pytest.mark.parametrize(("magnified", "change"), [(0.8, -0.106), (1.25, 0.099)])
def test_working_f_number_sets_the_power_on_the_axis(magnified, change):
    """E ∝ 1/N_w² for a small stop: −10.6 % at P = 0.8 and +9.9 % at 1.25, t = 0.3, and independent of the two images.

    Seen to fail with t in place of t/P.
    """
    slow = {"pupil_magnification": magnified}
    of = [Lens.focused(F, 64.0, magnification=T, **more) for more in ({}, slow)]
    plain, compound = (one.discs[0].radius ** 2 * mean_cos4(one, np.zeros(1))[0] for one in of)
    assert compound / plain - 1 == pytest.approx(change, abs=6e-4)
    assert compound / plain == pytest.approx((of[0].working_f_number / of[1].working_f_number) ** 2, rel=2e-4)
    assert of[1].working_f_number == pytest.approx(64 * (1 + T / magnified), rel=1e-12)


@pytest.mark.parametrize(
    ("magnified", "domain"), [*((magnified, "pupil") for magnified in MAGNIFIED), (MAGNIFIED[0], "surface")]
)
def test_uniform_plane_in_closed_form(magnified, domain):
    """P = J_n A_vd f of the entrance pupil's disc at u − z_p, on every pixel, off axis and near f/2.8.

    Seen to fail with the pupil in the lens plane, and with its radius not projected onto it.
    """
    depth, radius = pupil(magnified)
    rtol = 1e-5 if domain == "pupil" else 1e-2
    image = fspt.render(
        scene(disk(U, 900.0), magnified=magnified, crop=(0, 0, WIDTH, 4)),
        method="integral", pixel="centre", rtol=rtol, domain=domain,
    )  # fmt: skip
    expected = EXITANCE * (PITCH / T) ** 2 * share_of_disc(radius, U - depth, virtual_offsets()[:4])
    np.testing.assert_allclose(image.power, expected, rtol=2e-5 if domain == "pupil" else 1e-2)
    assert image.metadata["pupil_magnification"] == pytest.approx(magnified)


@pytest.mark.parametrize("method", ["path", "ptracer"])
def test_monte_carlo_has_the_same_total(method):
    """Of a plane that fills the field: mean over all pixels, within four standard errors and 2 %."""
    magnified = 0.8
    depth, radius = pupil(magnified)
    image = fspt.render(scene(disk(U, 60.0), magnified=magnified, f_number=2.8), method=method, spp=256)
    expected = EXITANCE * (PITCH / T) ** 2 * share_of_disc(radius, U - depth, virtual_offsets()).sum()
    error = np.sqrt((image.error**2).sum())
    assert error < 0.01 * expected
    assert abs(image.power.sum() - expected) < 4 * error + 1e-4 * expected


@pytest.mark.parametrize("magnified", MAGNIFIED)
@pytest.mark.parametrize("z", [150.0, 330.0])
def test_blur_disc_of_a_small_disk(magnified, z):
    """Centre and mean square radius on the film: perspective from the pupil's centre, R_p |u − z|/(z − z_p) wide.

    Seen to fail with perspective from the lens centre (the image 2 pixels off).
    """
    depth, radius = pupil(magnified)
    x, y, size = 4.0, -3.0, 0.2
    power = fspt.render(scene(disk(z, size, x=x, y=y), magnified=magnified), method="integral", rtol=1e-2).power
    side, scale = PITCH / T, (U - depth) / (z - depth)
    columns, rows = np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2
    total = power.sum()
    centre = power.sum(axis=0) @ columns / total, power.sum(axis=1) @ rows / total
    assert centre[0] == pytest.approx(-x * scale / side, abs=0.02)
    assert centre[1] == pytest.approx(-y * scale / side, abs=0.02)
    spread = ((columns - centre[0]) ** 2 @ power.sum(axis=0) + (rows - centre[1]) ** 2 @ power.sum(axis=1)) / total
    blur = radius * (U - z) / (z - depth) / side
    # Half of the squared radii of blur and disk, and a twelfth of a pixel's side squared along each axis.
    assert spread == pytest.approx(blur**2 / 2 + (size * scale / side) ** 2 / 2 + 1 / 6, rel=0.02)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"pupil_magnification": 0.0}, "'pupil_magnification' must be > 0"),
        ({"pupil_magnification": -1.0}, "'pupil_magnification' must be > 0"),
        ({"pupil_magnification": float("nan")}, "'pupil_magnification' must be > 0"),
        ({"diaphragm_distance": 5.0}, "'pupil_magnification' = 0.8 and 'diaphragm_distance' = 5 mm exclude each other"),
        ({"lens_diameter": 30.0}, "'pupil_magnification' = 0.8 and 'lens_diameter' = 30 mm exclude each other"),
        ({"model": "hrrt", "lens_diameter": 30.0}, "no meaning with model 'hrrt'"),
        ({"model": "ripoll", "numerical_aperture": 0.1}, "no meaning with model 'ripoll'"),
        ({"model": "pinhole", "lens_diameter": 30.0}, "exclude each other"),
    ],
)
def test_what_contradicts_it_is_refused(more, message):
    with pytest.raises(OpticsError, match=message) as caught:
        Lens.focused(F, N, magnification=T, **{"pupil_magnification": 0.8} | more)
    assert "\n" not in str(caught.value)


def test_a_pinhole_stands_in_the_pupil():
    """One line of sight through the middle of the entrance pupil, with the pupil's étendue: M.40 for any aperture."""
    own = lens(0.8, model="pinhole")
    assert own.discs == lens(0.8).discs
    assert own.pupil_radius == 0


K = np.array([[330.0, 0, 31.5], [0, 330.0, 18.0], [0, 0, 1]])
RVEC, TVEC = np.array([0.3, -0.5, 1.2]), np.array([4.0, -6.0, 170.0])


@pytest.mark.parametrize("magnified", [0.8, 1.25])
def test_opencvs_centre_is_that_of_the_entrance_pupil(magnified):
    """The perspective centre of the sensor is OpenCV's, and f · pitch = F (1 + t/P).

    Seen to fail with v/f as pitch (5.5 % off at P = 0.8, t = 0.3) and with the lens plane in OpenCV's centre.
    """
    found = fspt.camera_from_opencv(K, RVEC, TVEC, width=60, height=44, pupil_magnification=magnified)
    pitch = found.pixel_pitch(F * (1 + T), focal_length=F)
    assert pitch == pytest.approx(F * (1 + T / magnified) / 330)
    xml = found.sensor_xml(focal_length=F, f_number=N, magnification=T)
    sensor = fspt.load(f'<scene version="3.0.0">{xml}</scene>').sensors()[0]
    depth = sensor.camera.lens.pupil_depth
    axis, centre = np.array(sensor.camera.placement).reshape(4, 4)[:3, 2:].T
    np.testing.assert_allclose(centre + depth * axis, found.to_world[:3, 3], atol=1e-4)
    assert sensor.camera.pixel_pitch == pytest.approx(pitch)
    with pytest.raises(OpticsError, match="needs 'focal_length'"):
        found.pixel_pitch(F * (1 + T))


def test_pupil_magnification_from_a_known_pitch():
    """Its relative error is 1 + P/t times that of F: by a difference of the closed form."""
    found = fspt.camera_from_opencv(K, RVEC, TVEC, width=60, height=44)
    pitch = F * (1 + T / 0.8) / 330
    value, sd = found.pupil_magnification_of(pitch, focal_length=F, magnification=T, focal_length_sd=0.01)
    assert value == pytest.approx(0.8, rel=1e-9)
    other, _ = found.pupil_magnification_of(pitch, focal_length=F * (1 + 1e-6), magnification=T)
    assert sd == pytest.approx(abs(other - value) * 1e4, rel=1e-3)
    with pytest.raises(OpticsError, match="must exceed focal_length"):
        found.pupil_magnification_of(pitch, focal_length=2 * F, magnification=T)


@pytest.mark.parametrize("bad", [0, -0.5, np.inf, "wide"])
def test_a_pupil_magnification_that_cannot_be_is_refused(bad):
    with pytest.raises(OpticsError, match="pupil_magnification"):
        fspt.camera_from_opencv(K, RVEC, TVEC, width=60, height=44, pupil_magnification=bad)
