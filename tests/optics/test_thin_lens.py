"""The lens in plain numbers: lens law, Eq. 3, and which lines of sight pass the borders."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import j0

from mitsuba_fspt.optics.discs import Disc
from mitsuba_fspt.optics.thin_lens import Lens, configuration_factor, number_names
from mitsuba_fspt.runtime.errors import OpticsError

FOCI = [{"focus_distance": 165.0}, {"magnification": 0.5}, {"image_distance": 82.5}]


@pytest.mark.parametrize("focus", FOCI)
def test_one_of_three_numbers_sets_the_focus(focus):
    """1/55 = 1/165 + 1/82.5, t = v/u = 1/2."""
    lens = Lens.focused(55.0, 2.8, **focus)
    assert lens.focus_distance == pytest.approx(165, rel=1e-12)
    assert lens.image_distance == pytest.approx(82.5, rel=1e-12)
    assert lens.magnification == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("u", [55.001, 60.0, 110.0, 1e4])
def test_lens_law(u):
    lens = Lens(55.0, 8.0, u)
    assert 1 / lens.focus_distance + 1 / lens.image_distance == pytest.approx(1 / 55, rel=1e-12)
    assert lens.magnification == pytest.approx(lens.image_distance / u, rel=1e-12)
    by_image = Lens.focused(55.0, 8.0, image_distance=lens.image_distance)
    by_scale = Lens.focused(55.0, 8.0, magnification=lens.magnification)
    assert by_image.focus_distance == pytest.approx(u, rel=1e-9)
    assert by_scale.focus_distance == pytest.approx(u, rel=1e-9)


def test_diaphragm_is_focal_length_over_f_number():
    assert Lens(55.0, 2.8, 165.0).diaphragm_diameter == pytest.approx(19.642857142857142)


@pytest.mark.parametrize(
    ("borders", "disc"),
    [
        ({}, Disc(0.0, 5.0)),
        ({"lens_diameter": 30.0}, Disc(0.0, 5.0)),
        ({"model": "pinhole"}, Disc(0.0, 5.0)),
        ({"model": "hrrt", "lens_diameter": 30.0}, Disc(0.0, 15.0)),
        ({"model": "ripoll", "numerical_aperture": 0.6}, Disc(1.0, 200 * 0.75)),
    ],
)
def test_every_model_has_one_disc(borders, disc):
    """D = 50/5 = 10 mm; without a diaphragm the lens border; sine 0.6 is tangent 0.75."""
    (found,) = Lens.focused(50.0, 5.0, focus_distance=200.0, **borders).discs
    assert (found.shift, found.radius) == (disc.shift, pytest.approx(disc.radius, rel=1e-12))


def passes(lens, x, a):
    """Trace a ray from the virtual point (x, u) through the lens point a and on to a diaphragm anywhere.

    Behind the lens the ray heads for the image point (−t x, −v): the definition of an image, no discs involved.
    """
    s, radius = lens.diaphragm_distance, lens.diaphragm_diameter / 2
    target, far = (-lens.magnification * x, lens.image_distance) if s > 0 else (x, lens.focus_distance)
    at_diaphragm = a + (target - a) * abs(s) / far
    inside_lens = np.linalg.norm(a, axis=1) <= lens.lens_diameter / 2
    return inside_lens & (np.linalg.norm(at_diaphragm, axis=1) <= radius)


@pytest.mark.parametrize("s", [-60.0, -12.0, 7.0, 40.0, 55.0, 70.0])
def test_discs_of_a_diaphragm_off_the_lens_pass_what_a_traced_ray_passes(s):
    """Before the lens, close behind it, at and beyond the rear focus, where its image jumps to the other side.

    Seen to fail with F/(F − s) dropped from the entrance pupil's radius and with the sign of the shift turned.
    """
    lens = Lens(55.0, 5.5, 165.0, lens_diameter=14.0, diaphragm_distance=s)
    random = np.random.default_rng(3)
    x, a = 40 * random.normal(size=(20000, 2)), 8 * random.uniform(-1, 1, (20000, 2))
    open_to = np.ones(len(x), bool)
    for disc in lens.discs:
        open_to &= np.linalg.norm(a - disc.shift * x, axis=1) <= disc.radius
    truth = passes(lens, x, a)
    assert 500 < truth.sum() < 19000  # neither all nor nothing
    np.testing.assert_array_equal(open_to, truth)


def test_diaphragm_in_the_rear_focal_plane_stops_directions():
    """|slope| ≤ (D/2)/F for every virtual point: Ripoll's cone."""
    telecentric = Lens(55.0, 5.5, 165.0, lens_diameter=40.0, diaphragm_distance=55.0).discs[0]
    sine = math.sin(math.atan(5 / 55))
    cone = Lens.focused(55.0, 5.5, focus_distance=165.0, model="ripoll", numerical_aperture=sine).discs[0]
    assert telecentric.shift == cone.shift == 1
    assert telecentric.radius == pytest.approx(cone.radius, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"focal_length": 0.0}, "focal_length"),
        ({"focal_length": math.nan}, "focal_length"),
        ({"f_number": -2.8}, "f_number"),
        ({"f_number": math.inf}, "f_number"),
        ({"f_number": 9e-4}, "f_number"),
        ({"focus_distance": 55.0}, "focus_distance"),
        ({"focus_distance": 20.0}, "focus_distance"),
        ({"focus_distance": None}, "focus_distance"),
        ({"magnification": 0.5}, "magnification"),
        ({"focus_distance": None, "magnification": 0.0}, "magnification"),
        ({"focus_distance": None, "image_distance": 55.0}, "image_distance"),
        ({"model": "thin"}, "model"),
        ({"model": "hrrt"}, "lens_diameter"),
        ({"model": "ripoll"}, "numerical_aperture"),
        ({"model": "ripoll", "numerical_aperture": 1.0}, "numerical_aperture"),
        ({"numerical_aperture": 0.1}, "numerical_aperture"),
        ({"lens_diameter": 19.0}, "lens_diameter"),
        ({"lens_diameter": -1.0}, "lens_diameter"),
        ({"diaphragm_distance": 5.0}, "lens_diameter"),
        ({"diaphragm_distance": 82.5, "lens_diameter": 20.0}, "diaphragm_distance"),
        ({"diaphragm_distance": -165.0, "lens_diameter": 20.0}, "diaphragm_distance"),
        ({"diaphragm_distance": math.nan, "lens_diameter": 20.0}, "diaphragm_distance"),
    ],
)
def test_lens_that_cannot_be_is_refused_by_name(arguments, name):
    good = {"focal_length": 55.0, "f_number": 2.8, "focus_distance": 165.0}
    with pytest.raises(OpticsError, match=name) as caught:
        Lens.focused(**good | arguments)
    assert "\n" not in str(caught.value)


def test_lens_as_wide_as_the_diaphragm_is_allowed():
    assert Lens(55.0, 2.8, 165.0, lens_diameter=55 / 2.8).discs == (Disc(0.0, 55 / 2.8 / 2),)


@pytest.mark.parametrize(("radius", "distance", "offset"), [(9.8, 165.0, 0.0), (9.8, 165.0, 40.0), (30.0, 20.0, 45.0)])
def test_configuration_factor_is_the_integral_over_the_disc(radius, distance, offset):
    """f = ∫ cos⁴θ dA / (π u²), by Gauss × trapezoid. Seen to fail with 1/π or a cos dropped from the integral."""
    node, weight = np.polynomial.legendre.leggauss(60)
    rho = radius * np.sqrt((node[:, None] + 1) / 2)
    angle = 2 * np.pi * np.arange(240) / 240
    d2 = (rho * np.cos(angle) - offset) ** 2 + (rho * np.sin(angle)) ** 2 + distance**2
    mean = weight / 2 @ (distance**4 / d2**2).mean(axis=1)
    integral = mean * np.pi * radius**2 / (np.pi * distance**2)
    assert configuration_factor(radius, distance, offset) == pytest.approx(integral, rel=1e-10)


def test_configuration_factor_far_and_near():
    """R²/u² without a digit lost for a tiny disc; all the light for an endless one."""
    assert configuration_factor(1e-6, 165.0, 0.0) == pytest.approx((1e-6 / 165) ** 2, rel=1e-12)
    assert configuration_factor(1e6, 1.0, 10.0) == pytest.approx(1, rel=1e-9)


def test_small_numbers_of_numpy_are_plain_numbers():
    """Seen to fail: F u of two 8-bit numbers overflows."""
    numbers = {"focal_length": 100, "f_number": 5, "lens_diameter": 60, "diaphragm_distance": 10}
    plain = Lens.focused(**numbers, magnification=1)
    for kind in (np.uint8, np.array):
        lens = Lens.focused(**{name: kind(value) for name, value in numbers.items()}, magnification=kind(1))
        assert lens == plain
        assert {type(value) for value in (lens.focal_length, lens.image_distance, lens.discs[0].radius)} == {float}
    assert Lens(np.int8(50), 8, np.int8(100)).image_distance == 100


@pytest.mark.parametrize("name", [name for name in number_names() if name not in ("magnification", "image_distance")])
def test_a_value_that_is_no_number_is_refused_with_a_valid_one(name):
    """Seen to fail: 20 for a numerical aperture, which is below 1."""
    good = {"focal_length": 55.0, "f_number": 8.0, "focus_distance": 165.0}
    good |= {"lens_diameter": 30.0} if name != "pupil_magnification" else {}
    good |= {"model": "ripoll"} if name == "numerical_aperture" else {}
    with pytest.raises(OpticsError, match=f"'{name}' must be a number, got '8'") as caught:
        Lens.focused(**good | {name: "8"})
    Lens.focused(**good | {name: float(re.search(r"Give for example (.*)\.$", str(caught.value))[1])})


@pytest.mark.parametrize(
    ("borders", "distance"),
    [
        ({}, 82.5),
        ({"model": "pinhole"}, 82.5),
        ({"diaphragm_distance": 5.0, "lens_diameter": 60.0}, 77.5),  # the diaphragm is as far from the detector
    ],
)
def test_airy_radius_is_the_first_dark_ring(borders, distance):
    """Of ∫ J₀(k ρ r/distance) ρ dρ over the diaphragm, found numerically: 1.22 λ N (1 + t). The limit of 5e-4 is that
    of 1.22 for 1.2197. Seen to fail without 1 + t, and with the lens for the diaphragm.
    """
    lens = Lens.focused(55.0, 8.0, magnification=0.5, **borders)
    k = 2 * math.pi / 660e-6
    rho = (np.arange(2000) + 0.5) / 2000 * 55.0 / 8 / 2

    def amplitude(r):
        return float((j0(k * rho * r / distance) * rho).sum())

    dark = brentq(amplitude, 1e-3, 15e-3)
    assert lens.airy_radius(660.0) == pytest.approx(dark, rel=5e-4)
    if not borders:
        assert lens.airy_radius(600.0) == pytest.approx(1.22 * 600e-6 * 8 * 1.5, rel=1e-12)
