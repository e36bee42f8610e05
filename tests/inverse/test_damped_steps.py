"""Steps of Levenberg and Marquardt: they lead to a minimum in a curved valley, and end where none is left."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt.inverse.damped_steps import DampedSteps, LinearFit


def residual(at):
    """Of Rosenbrock's valley, whose minimum is 0 at (1, 1)."""
    return np.array([10 * (at[0] ** 2 - at[1]), at[0] - 1])


def slopes(at):
    """Minus the derivatives of the residuals: the changes of what is fitted."""
    return -np.array([[20 * at[0], -10.0], [1.0, 0.0]])


def test_steps_lead_along_a_curved_valley():
    """From (-1.2, 1) to (1, 1), with columns whose lengths differ by 24; each step lowers the sum.

    Seen to fail with a λ that never falls (100 steps).
    """
    at, damped, sums = np.array([-1.2, 1.0]), DampedSteps(1e-20), []

    def lower(step):
        there = at + step
        return there if np.sum(residual(there) ** 2) < np.sum(residual(at) ** 2) else None

    while (nearer := damped.lower(LinearFit.of(slopes(at), residual(at)), lower)) is not None and len(sums) < 100:
        at = nearer
        sums.append(np.sum(residual(at) ** 2))
    np.testing.assert_allclose(at, 1, atol=1e-8)
    assert len(sums) < 40


def test_fall_and_step_of_linear_slopes():
    """The step without damping is that of least squares, and the falls are those of the sum of squares."""
    rng = np.random.default_rng(1)
    matrix, measured = rng.normal(size=(9, 3)) * [1, 100, 0.01], rng.normal(size=9)
    linear = LinearFit.of(matrix, measured)
    best = np.linalg.lstsq(matrix, measured)[0]
    for damping, expected in ((0.0, best), (0.3, None)):
        step, fall = linear.step(damping)
        left = measured - matrix @ step
        assert fall == pytest.approx(measured @ measured - left @ left)
        if expected is not None:
            np.testing.assert_allclose(step, expected)
            assert linear.fall == pytest.approx(fall)


def test_no_step_is_left_where_none_succeeds():
    """λ rises until a step would lower the sum by no more than `end`; the next steps start with the first λ again.

    No step is tried that is nearly as long as one that failed: λ = 0.001, then 1, 10, 100 and 1000.
    """
    seen = list[float]()

    def never(step):
        seen.append(float(np.abs(step).max()))

    linear, damped = LinearFit.of(np.eye(2), np.array([3.0, 4.0])), DampedSteps(0.01)
    assert damped.lower(linear, never) is None
    assert seen == pytest.approx([4 / (1 + damping) for damping in (1e-3, 1, 10, 100, 1000)])
    assert linear.step(1000)[1] > 0.01 >= linear.step(10000)[1]
    assert damped.lower(linear, lambda step: step) == pytest.approx([3, 4], rel=2e-3)


@pytest.mark.parametrize("damping", [1e-3, 1e4])
def test_a_weak_direction_is_followed_to_its_end(damping):
    """Two nearly equal columns, condition number 900, from 1 sd beside the minimum along what they determine weakly.

    Seen to fail, with no step at all, where the damped step alone ended the search.
    """
    angle = 2 * np.arctan(1 / 900)
    matrix = np.array([[1.0, np.cos(angle)], [0.0, np.sin(angle)]])
    weak = np.linalg.svd(matrix)[2][-1]
    at, damped = weak / np.linalg.norm(matrix @ weak), DampedSteps(0.01, damping=damping)
    for _ in range(20):
        if (nearer := damped.lower(LinearFit.of(matrix, -matrix @ at), lambda step, at=at: at + step)) is None:
            break
        at = nearer
    assert np.sum((matrix @ at) ** 2) <= 0.01


def test_slopes_that_are_no_numbers_end_the_search():
    """Seen not to come to an end where only a small fall ended it."""
    linear = LinearFit(np.ones(2), np.full((2, 2), np.nan), np.ones(2))
    assert DampedSteps(0.01).lower(linear, lambda step: None) is None


def test_the_first_step_alone_is_bounded():
    """10 sd away with `longest` 1: the first step is at most 1 long, the second goes as far as the slopes say."""
    damped = DampedSteps(1e-9, longest=1.0)
    linear = LinearFit.of(np.eye(1), np.array([10.0]))
    first = damped.lower(linear, lambda step: step)
    assert 0.05 < first[0] <= 1
    second = damped.lower(linear, lambda step: step)
    assert second[0] > first[0]
