"""Node rules: exact to the stated degree, and no further."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.stats import qmc

from mitsuba_fspt.integral.pupil import node_rules
from mitsuba_fspt.integral.quadrature import Quadrature


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
    "one": node_rules.one(),
    "four": node_rules.four(area=False),
    "four over area": node_rules.four(area=True),
    "twelve": node_rules.twelve(area=False),
    "twelve over area": node_rules.twelve(area=True),
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
def test_four_nodes_over_the_area_are_exact_to_degree_3_for_functions_of_p_minus_r_a(blur):
    """Functions of blur · pupil + pixel: whatever the blur, before or behind the virtual detector plane.

    Seen to fail with steps along the place on the pupil in place of across it.
    """
    rule = node_rules.four(area=True)
    x, y = (blur * rule.pupil + rule.pixel).T
    for a, b in ((1, 0), (0, 1), (1, 1), (3, 0), (2, 1), (1, 2), (0, 3)):
        assert rule.weight @ (x**a * y**b) == pytest.approx(0, abs=1e-14)
    for square in (x**2, y**2):
        assert rule.weight @ square == pytest.approx(blur**2 / 4 + 1 / 12, rel=1e-13)


def test_four_turn_is_the_error_of_four_nodes_where_the_blur_changes():
    """Of f = (x + β a_x)(y + β a_y), β = 0.7 + 0.03 x - 0.02 y: the mean over pupil and pixel is known."""
    rule, (y, x) = node_rules.four(area=True), np.mgrid[-4:5, -4:5].astype(float)

    def f(ax, ay, dx, dy):
        blur = 0.7 + 0.03 * (x + dx) - 0.02 * (y + dy)
        return (x + dx + blur * ax) * (y + dy + blur * ay)

    values = np.array([f(*a, *b) for a, b in zip(rule.pupil, rule.pixel, strict=True)])
    mean, mx, my = (np.tensordot(w, values, 1) for w in (rule.weight, *(rule.weight * rule.pupil.T)))
    turned = node_rules.four_turn(np.gradient(mx, axis=0) - np.gradient(my, axis=1), np.zeros_like(x))
    # The mean of f is xy: pupil offsets are odd, and so are the pixel's.
    assert np.abs(mean - x * y)[1:-1, 1:-1].max() > 3e-3
    np.testing.assert_allclose((mean - turned)[1:-1, 1:-1], (x * y)[1:-1, 1:-1], atol=1e-3)


@pytest.mark.parametrize("name", ["four", "four over area", "twelve", "twelve over area"])
def test_contrast_is_zero_on_planes_and_not_on_curved_functions(name):
    rule = RULES[name]
    linear = np.hstack([np.ones((len(rule), 1)), rule.pupil, rule.pixel])
    np.testing.assert_allclose(rule.contrast @ linear, 0, atol=1e-15)
    quadratic = [rule.contrast @ values for values in (rule.pupil[:, 0] * rule.pupil[:, 1], (rule.pupil**2).sum(1))]
    assert max(np.abs(quadratic)) > 0.1


@pytest.mark.parametrize("n", [1, 2, 5])
def test_gauss_rule_is_exact_to_degree_2n_minus_1(n):
    node, weight = node_rules.gauss(n)
    assert weight.sum() == pytest.approx(1, abs=1e-15)
    for degree in range(2 * n):
        assert weight @ node**degree == pytest.approx(1 / (degree + 1), abs=1e-15)
    assert weight @ node ** (2 * n) != pytest.approx(1 / (2 * n + 1), abs=1e-6)


@pytest.mark.parametrize("area", [True, False])
@pytest.mark.parametrize("level", [1, 2, 3])
def test_product_rule_is_exact_where_the_pupil_matters(level, area):
    """Expected: moments of disc and square to degree 2 level + 1 in each, and none of the square at its centre."""
    rule = node_rules.product(level, area)
    assert rule.weight.sum() == pytest.approx(1, abs=1e-14)
    degree = 2 * level + 1
    for a, b in itertools.product(range(degree + 1), repeat=2):
        if a + b <= degree:
            assert rule.weight @ np.prod(rule.pupil ** [a, b], axis=1) == pytest.approx(disc_moment(a, b), abs=1e-13)
    square = rule.weight @ np.prod(rule.pixel**2, axis=1)
    assert square == pytest.approx(1 / 144 if area else 0, abs=1e-14)


@pytest.mark.parametrize("count", node_rules.TRANSECT_LEVELS)
def test_positions_of_transects_lie_in_the_cube_in_the_requested_number(count):
    places = node_rules.transects(count)
    assert len(places) == count
    assert places.weight.sum() == pytest.approx(1, abs=1e-13)
    for place in (places.sharp, places.blurred):
        assert place.shape == (count, 3)
        assert np.all((place > 0) & (place < 1))


@pytest.mark.parametrize(("count", "degree"), [(2, 1), (8, 2), (24, 3), (72, 5), (256, 7)])
def test_few_positions_are_exact_for_polynomials(count, degree):
    """Expected: means of x^i y^j z^k over the cube, 1/((i+1)(j+1)(k+1)), up to the degree in all and no further."""
    places = node_rules.transects(count)

    def off(i: int, j: int, k: int) -> float:
        return places.weight @ np.prod(places.blurred ** [i, j, k], axis=1) - 1 / ((i + 1) * (j + 1) * (k + 1))

    powers = [p for p in itertools.product(range(degree + 2), repeat=3) if sum(p) <= degree]
    assert max(abs(off(*p)) for p in powers) < 1e-15
    beyond = [p for p in itertools.product(range(degree + 2), repeat=3) if sum(p) == degree + 1]
    assert max(abs(off(*p)) for p in beyond) > 1e-5


@pytest.mark.parametrize("count", node_rules.TRANSECT_LEVELS)
def test_trend_is_orthonormal_on_the_positions(count):
    """So that the sum of squared coefficients is what a trend adds to the variance; on a net but nearly."""
    places = node_rules.transects(count)
    trend = places.trend
    assert len(trend) == (0 if count == 2 else node_rules.TREND + 2)
    near = 1e-13 if count < 1024 else 2e-2
    np.testing.assert_allclose(trend @ places.weight, 0, atol=near)
    np.testing.assert_allclose((trend * places.weight) @ trend.T, np.eye(len(trend)), atol=near)


@pytest.mark.parametrize("count", [256, 1024])
def test_many_positions_are_a_net(count):
    """One place in every box of volume 1/n whose sides are powers of ½: 2^i × 2^j × 2^k boxes in all."""
    place = node_rules.transects(count).sharp
    m = count.bit_length() - 1
    for i in range(m + 1):
        for j in range(m + 1 - i):
            box = np.floor(place * [2**i, 2**j, 2 ** (m - i - j)]).astype(int)
            assert len(np.unique(box, axis=0)) == count


@pytest.mark.parametrize("count", node_rules.TRANSECT_LEVELS)
def test_positions_for_sharp_edges_lie_on_even_lines_across_the_pixel(count):
    sharp = node_rules.transects(count).sharp
    np.testing.assert_allclose(np.sort(sharp[:, 2]), (np.arange(count) + 0.5) / count, atol=1e-12)
    # What is odd about the middle of the pupil cancels.
    np.testing.assert_allclose(sharp.mean(axis=0), 0.5, atol=1e-12)


@pytest.mark.parametrize("count", node_rules.STEPS)
def test_positions_for_sharp_edges_have_the_least_discrepancy(count):
    """Where a silhouette is curved within the pixel, and a little out of focus, nothing else makes them converge."""

    def unevenness(steps):
        return qmc.discrepancy(np.mod(np.outer(np.arange(count) + 0.5, (*steps, 1)) / count, 1.0))

    steps = [k for k in range(1, count) if math.gcd(k, count) == 1]
    least = min(unevenness(pair) for pair in itertools.combinations_with_replacement(steps, 2))
    assert qmc.discrepancy(node_rules.transects(count).sharp) == pytest.approx(least, rel=1e-6)


def test_transects_at_least_double_from_level_to_level():
    """So that the change from the last level says what is left."""
    assert np.all(np.divide(node_rules.TRANSECT_LEVELS[1:], node_rules.TRANSECT_LEVELS[:-1]) >= 2)


@pytest.mark.parametrize("area", [False, True])
def test_levels_take_no_more_lines_of_sight_than_a_pixel_may(area):
    """Expected: as many levels as fit, and all of them in what an integrator allows at that rtol."""
    first = node_rules.along_transect(0, 1e-3)
    assert node_rules.transect_levels(1e-3, area, 2 * first.rays - 1) == []
    assert node_rules.transect_levels(1e-3, area, 2 * first.rays) == [(2, first)]
    counts = tuple(count for count, _ in node_rules.transect_levels(1e-6, area, Quadrature(rtol=1e-6).most_nodes))
    assert counts == node_rules.TRANSECT_LEVELS


def test_accuracy_along_transects_grows_with_level_and_smaller_rtol():
    levels = [dataclasses.astuple(node_rules.along_transect(level, 1e-3)) for level in range(4)]
    assert np.all(np.diff(levels, axis=0) > 0)
    coarse, fine = node_rules.along_transect(0, 1e-2), node_rules.along_transect(0, 1e-5)
    assert fine.bisections > coarse.bisections
    assert fine.nodes > coarse.nodes
    # s goes from -1 to 1, and the jump is said to be in the middle of the last interval.
    assert 1 / fine.scan * 0.5**fine.bisections <= 1e-5


def test_nodes_of_two_transects_together_are_exact_on_a_line():
    """Nodes at (k + φ)/n alone are off by the slope times (φ - ½)/n; seen to fail with golden phases, 0.31 and 0.93."""
    phase, along = node_rules.transects(2).phase, node_rules.along_transect(0, 1e-3)
    places = (np.arange(along.nodes) + phase[:, None]) / along.nodes
    assert places.mean() == pytest.approx(0.5, abs=1e-15)
    assert phase[0] != pytest.approx(phase[1], abs=0.1)  # else both would pass the same by


@pytest.mark.parametrize("rtol", [0.5, 0.03, 1e-3, 1e-5])
def test_bisections_of_the_first_transects_place_a_jump_to_rtol(rtol):
    """Half of what is left of an interval, which has 1/scan of the measure, and 1/64 of an interval in any case."""
    along = node_rules.along_transect(0, rtol)
    left = 0.5**along.bisections / 2
    assert left / along.scan <= rtol
    assert left <= 1 / 64
