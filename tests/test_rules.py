"""Node rules: exact where they say so, and no further."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from mitsuba_fspt import rules


def disc_moment(a, b):
    """Mean of x^a y^b over the unit disc."""
    if a % 2 or b % 2:
        return 0.0
    angular = math.gamma((a + 1) / 2) * math.gamma((b + 1) / 2) / math.gamma((a + b + 2) / 2)
    return 2 * angular / (a + b + 2) / math.pi


def square_moment(c, d):
    """Mean of x^c y^d over [-½, ½]²."""
    return 0.0 if c % 2 or d % 2 else 1 / ((c + 1) * (d + 1) * 2 ** (c + d))


def powers(degree):
    return [p for p in itertools.product(range(degree + 1), repeat=4) if sum(p) == degree]


def moment_errors(rule, degree, pupil_only=False):
    """Largest error of the rule on the monomials of a degree, over pupil × pixel or the pupil alone."""
    errors = [0.0]
    for a, b, c, d in powers(degree):
        if pupil_only and c + d:
            continue
        values = np.prod(np.hstack([rule.pupil, rule.pixel]) ** [a, b, c, d], axis=1)
        errors.append(abs(rule.weight @ values - disc_moment(a, b) * square_moment(c, d)))
    return max(errors)


RULES = {
    "one": rules.one(),
    "four": rules.four(area=False),
    "four over area": rules.four(area=True),
    "twelve": rules.twelve(area=False),
    "twelve over area": rules.twelve(area=True),
}


def test_moments_of_the_disc():
    """∫∫ over a fine polar grid, that the formula above is right."""
    r = np.sqrt((np.arange(1000) + 0.5) / 1000)[:, None]
    angle = (np.arange(64) + 0.5) * 2 * np.pi / 64
    for a, b in ((2, 0), (4, 0), (2, 2), (6, 2), (3, 0)):
        grid = (r * np.cos(angle)) ** a * (r * np.sin(angle)) ** b
        assert grid.mean() == pytest.approx(disc_moment(a, b), abs=1e-6)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_rule_is_a_mean_over_pupil_and_pixel(rule):
    assert len(rule) == len(rule.weight) == len(rule.pupil) == len(rule.pixel) == len(rule.contrast)
    assert rule.weight.sum() == pytest.approx(1, abs=1e-14)
    assert np.all(rule.weight > 0)
    assert np.all(np.linalg.norm(rule.pupil, axis=1) < 1)
    assert np.all(np.abs(rule.pixel) <= 0.5)


@pytest.mark.parametrize(
    ("name", "degree", "pupil_only"),
    [
        ("four", 3, True),
        ("four over area", 3, True),
        ("twelve", 7, True),
        ("twelve over area", 7, True),
        ("twelve over area", 3, False),
    ],
)
def test_rule_is_exact_to_its_degree_and_not_beyond(name, degree, pupil_only):
    """Seen to fail with one ring's weight or radius changed by 1e-3, and with the steps in the pixel not turned."""
    for k in range(degree + 1):
        assert moment_errors(RULES[name], k, pupil_only) < 1e-14
    assert moment_errors(RULES[name], degree + 1, pupil_only) > 1e-3


@pytest.mark.parametrize("blur", [0.0, 0.3, 1.0, -4.0])
def test_four_nodes_over_the_area_are_exact_to_degree_3_in_what_blurs_like_a_picture(blur):
    """Functions of blur · pupil + pixel: whatever the blur, before or behind the sharp plane.

    Seen to fail with steps along the place on the pupil in place of across it.
    """
    rule = rules.four(area=True)
    x, y = (blur * rule.pupil + rule.pixel).T
    for a, b in ((1, 0), (0, 1), (1, 1), (3, 0), (2, 1), (1, 2), (0, 3)):
        assert rule.weight @ (x**a * y**b) == pytest.approx(0, abs=1e-14)
    for square in (x**2, y**2):
        assert rule.weight @ square == pytest.approx(blur**2 / 4 + 1 / 12, rel=1e-13)


def test_four_turn_is_what_four_nodes_have_too_much_where_the_blur_changes():
    """Of f = (x + β a_x)(y + β a_y), β = 0.7 + 0.03 x - 0.02 y: the mean over pupil and pixel is known."""
    rule, (y, x) = rules.four(area=True), np.mgrid[-4:5, -4:5].astype(float)

    def f(ax, ay, dx, dy):
        blur = 0.7 + 0.03 * (x + dx) - 0.02 * (y + dy)
        return (x + dx + blur * ax) * (y + dy + blur * ay)

    values = np.array([f(*a, *b) for a, b in zip(rule.pupil, rule.pixel, strict=True)])
    mean, mx, my = (np.tensordot(w, values, 1) for w in (rule.weight, *(rule.weight * rule.pupil.T)))
    turned = rules.four_turn(np.gradient(mx, axis=0) - np.gradient(my, axis=1), np.zeros_like(x))
    # The mean of f is xy: pupil offsets are odd, and so are the pixel's.
    assert np.abs(mean - x * y)[1:-1, 1:-1].max() > 3e-3
    np.testing.assert_allclose((mean - turned)[1:-1, 1:-1], (x * y)[1:-1, 1:-1], atol=1e-3)


@pytest.mark.parametrize("name", ["four", "four over area", "twelve", "twelve over area"])
def test_contrast_is_blind_to_planes_and_sees_curvature(name):
    rule = RULES[name]
    linear = np.hstack([np.ones((len(rule), 1)), rule.pupil, rule.pixel])
    np.testing.assert_allclose(rule.contrast @ linear, 0, atol=1e-15)
    quadratic = [rule.contrast @ values for values in (rule.pupil[:, 0] * rule.pupil[:, 1], (rule.pupil**2).sum(1))]
    assert max(np.abs(quadratic)) > 0.1


@pytest.mark.parametrize("n", [1, 2, 5])
def test_gauss_rule_is_exact_to_degree_2n_minus_1(n):
    node, weight = rules.gauss(n)
    assert weight.sum() == pytest.approx(1, abs=1e-15)
    for degree in range(2 * n):
        assert weight @ node**degree == pytest.approx(1 / (degree + 1), abs=1e-15)
    assert weight @ node ** (2 * n) != pytest.approx(1 / (2 * n + 1), abs=1e-6)


@pytest.mark.parametrize(("m", "q"), rules.CHORD_LEVELS)
def test_chords_lie_in_disc_and_pixel_and_have_sum_one(m, q):
    chords = rules.chords(m, q)
    assert len(chords) == m * q * q
    assert chords.weight.sum() == pytest.approx(1, abs=1e-13)
    assert np.all((chords.across > 0) & (chords.across < 1))
    assert np.all(np.abs(chords.pixel) <= 0.5)
    # Any pixel point, were it alone, would still be served by evenly spaced chords.
    for point in np.unique(chords.pixel, axis=0):
        mine = np.sort(chords.across[(chords.pixel == point).all(axis=1)])
        np.testing.assert_allclose(np.diff(mine), 1 / m, atol=1e-12)


def test_chords_double_from_level_to_level():
    """So that the change from the last level says what is left."""
    count = [m * q * q for m, q in rules.CHORD_LEVELS]
    assert np.all(np.diff(count) > 0)
    assert np.all(np.divide(count[1:], count[:-1]) >= 16 / 9)
