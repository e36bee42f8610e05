"""Factors of H + w Q that are kept for matrices near them, against dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from mitsuba_fspt.inverse import kept_factor
from mitsuba_fspt.inverse.kept_factor import KeptFactor


@pytest.fixture
def made(monkeypatch):
    """The matrices of which a factor is made."""
    matrices = []
    own = kept_factor.factor
    monkeypatch.setattr(kept_factor, "factor", lambda matrix: matrices.append(matrix) or own(matrix))
    return matrices


def normal(design, sigma, weight):
    return csr_array(design.T @ np.diag(sigma**-2.0) @ design + weight * eye_array(design.shape[1]))


@pytest.mark.parametrize(("share", "factors"), [(0.0, 1), (1e-3, 1), (0.04, 1), (0.3, 2)])
def test_solutions_of_a_matrix_near_another(made, share, factors):
    """Variances change by up to a share, w by all of it; the solution is right to 1e-5 in the norm of the matrix.

    Seen to fail without the steps, by 0.02 for a share of 0.04, and with one factor for all matrices.
    """
    rng = np.random.default_rng(4)
    design, sigma = rng.normal(size=(80, 30)), rng.uniform(0.5, 2, 80)
    kept, of = KeptFactor(), (design,)
    kept.solve(normal(design, sigma, 3.0), sigma, 3.0, of)
    other, weight = sigma * (1 + share * rng.uniform(-1, 1, 80)) ** 0.5, 3 * (1 + share)
    matrix, right = normal(design, other, weight), rng.normal(size=(30, 4))
    found = kept.solve(matrix, other, weight, of)(right)
    expected = np.linalg.solve(matrix.toarray(), right)
    off = found - expected
    assert np.sqrt(np.sum(off * (matrix @ off))) <= 1e-5 * np.sqrt(np.sum(expected * (matrix @ expected)))
    assert len(made) == factors


def test_many_solutions_and_other_designs_have_a_factor_of_their_own(made):
    """`exact` is for draws: steps for each of hundreds of them would take longer than a factor."""
    rng = np.random.default_rng(5)
    design, sigma = rng.normal(size=(20, 6)), np.ones(20)
    kept = KeptFactor()
    for scale, of, exact, factors in (
        (1.0, (design,), False, 1),
        (1.0, (design,), True, 1),
        (1.001, (design,), False, 1),
        (1.001, (design,), True, 2),
        (1.001, (design.copy(),), False, 3),
    ):
        kept.solve(normal(design, scale * sigma, 1.0), scale * sigma, 1.0, of, exact)
        assert len(made) == factors
    endless = np.where(np.arange(20) == 3, np.inf, sigma)  # an error so large that its square is infinite
    for scale, factors in ((1.0, 4), (2.0, 5)):
        kept.solve(normal(design, scale * endless, 1.0), scale * endless, 1.0, (design,))
        assert len(made) == factors
