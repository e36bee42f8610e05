"""Stated errors of SP3 and diffusion."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mitsuba_fspt.inverse.model_error import MODEL_ERRORS, ModelError, shapes
from mitsuba_fspt.inverse.source_fit import LocationSettings, SourceFit


def test_deviations():
    """By hand: t² = 0.03² + (0.5 · 0.1 · 4)², s² = (0.4/4)² + (2.5 · 0.1)²; above a depth of 1, those of 1."""
    error = ModelError(0.03, 0.5, 0.4, 2.5, 0.1)
    assert error.deviations(4.0, 0.1) == pytest.approx((np.hypot(0.03, 0.2), np.hypot(0.1, 0.25)))
    assert error.deviations(0.2, 0.1) == error.deviations(1.0, 0.1)


def test_columns():
    """A common factor, and Legendre's polynomials over (0, 1), which are orthogonal; 1 at the nearest point.

    What is near creases is an error of its own.
    """
    x, weight = np.polynomial.legendre.leggauss(8)
    cosine = (x + 1) / 2
    near = np.linspace(0, 1, 8)
    columns = ModelError(0.03, 0.0, 0.4, 0.0, 0.2).columns(cosine, 4.0, 0.1, near)
    np.testing.assert_allclose(columns[:, 3], 0.2 * near)
    columns = columns[:, :3]
    np.testing.assert_allclose(columns[:, 0], 0.03)
    np.testing.assert_allclose(
        (columns.T * weight / 2) @ columns, np.diag([0.03**2, 0.1**2 / 3, 0.1**2 / 5]), atol=1e-17
    )
    np.testing.assert_allclose(shapes(np.ones(1)), 1)


@pytest.mark.parametrize("names", [("red",), ("red", "green")], ids=["one band", "two bands"])
def test_half_of_the_errors_is_common_to_the_bands(names):
    """Rationale: e eᵀ of errors of a pixel is their variance, of pixels of two bands half of what it is in one.

    With the power 2 W and the columns m of two sources, the errors of each source are independent of the other's. Seen
    to fail with all of them common, and with all of them of each band alone.
    """
    rng = np.random.default_rng(0)
    relative = rng.normal(size=(2, 3, len(names), 4))  # sources, unknowns, bands, pixels
    columns, powers = rng.uniform(1, 2, (4 * len(names), 2)), np.array([2.0, 3.0])

    def band(k):
        return SimpleNamespace(model_error=lambda position, radius: relative[int(position[0]), :, k].T)

    fit = SimpleNamespace(
        settings=LocationSettings(model_error=1.5),
        power=columns[:, 0],
        bands=[band(k) for k in range(len(names))],
        parts=[slice(4 * k, 4 * k + 4) for k in range(len(names))],
    )
    found = SimpleNamespace(powers=powers, columns=columns, radii=np.zeros(2), positions=np.eye(2, 3, 0)[::-1])
    errors = SourceFit.model_errors(fit, found)
    expected = np.zeros((len(columns), len(columns)))
    for k, power in enumerate(powers):
        own = 1.5 * power * columns[:, k] * relative[int(found.positions[k, 0])].reshape(3, -1)
        expected += own.T @ own
    same = np.kron(np.eye(len(names)), np.ones((4, 4)))
    np.testing.assert_allclose(errors @ errors.T, expected * (same + 0.5 * (1 - same)), rtol=1e-12)


def test_diffusion_is_less_certain_than_sp3():
    """Of a source five mean free paths deep, at µa/µs' = 0.03 and 0.1: both errors twice as large or more."""
    for absorption in (0.03, 0.1):
        sp3, diffusion = (np.array(MODEL_ERRORS[model].deviations(5.0, absorption)) for model in ("sp3", "diffusion"))
        assert (diffusion > 2 * sp3).all()
