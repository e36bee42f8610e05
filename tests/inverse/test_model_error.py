"""Stated errors of SP3 and diffusion."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt.inverse.model_error import MODEL_ERRORS, ModelError, shapes


def test_deviations():
    """By hand: t² = 0.03² + (0.5 · 0.1 · 4)², s² = (0.4/4)² + (2.5 · 0.1)²; above a depth of 1, those of 1."""
    error = ModelError(0.03, 0.5, 0.4, 2.5)
    assert error.deviations(4.0, 0.1) == pytest.approx((np.hypot(0.03, 0.2), np.hypot(0.1, 0.25)))
    assert error.deviations(0.2, 0.1) == error.deviations(1.0, 0.1)


def test_columns():
    """A common factor, and Legendre's polynomials over (0, 1), which are orthogonal; 1 at the nearest point."""
    x, weight = np.polynomial.legendre.leggauss(8)
    cosine = (x + 1) / 2
    columns = ModelError(0.03, 0.0, 0.4, 0.0).columns(cosine, 4.0, 0.1)
    np.testing.assert_allclose(columns[:, 0], 0.03)
    np.testing.assert_allclose(
        (columns.T * weight / 2) @ columns, np.diag([0.03**2, 0.1**2 / 3, 0.1**2 / 5]), atol=1e-17
    )
    np.testing.assert_allclose(shapes(np.ones(1)), 1)


def test_diffusion_is_less_certain_than_sp3():
    """Of a source five mean free paths deep, at µa/µs' = 0.03 and 0.1: both errors twice as large or more."""
    for absorption in (0.03, 0.1):
        sp3, diffusion = (np.array(MODEL_ERRORS[model].deviations(5.0, absorption)) for model in ("sp3", "diffusion"))
        assert (diffusion > 2 * sp3).all()
