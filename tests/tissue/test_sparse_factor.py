"""The order of elimination, and solutions by the factor in this order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from mitsuba_fspt.tissue.sparse_factor import dissection, factor

COUNT = 3000


@pytest.fixture(scope="module", params=["lowest", "highest"])
def capped(request):
    """Points of a body of 10 × 10 × 20 mm, 55 % of them on a flat end, and the Laplacian of their neighbours plus 1."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (COUNT, 3)) * [10, 10, 20]
    points[: 55 * COUNT // 100, 2] = 0 if request.param == "lowest" else 20
    ends = np.concatenate(
        [Delaunay(points + 1e-3 * rng.normal(size=points.shape)).simplices[:, [k, k - 1]] for k in range(4)]
    )
    joined = csr_array((np.ones(len(ends)), ends.T), shape=(COUNT, COUNT))
    joined = (joined + joined.T).sign()
    return points, csr_array(eye_array(COUNT) * (1 + joined.sum(axis=1)) - joined)


def test_a_fine_end_is_divided_as_well(capped):
    """Expected: each point once, and at most 3 times the entries of minimum degree, which is the better one here.

    Seen to fail, with 8 times the entries, where a part is always divided across its longest side.
    """
    points, matrix = capped
    order = dissection(matrix, points)
    np.testing.assert_array_equal(np.sort(order), np.arange(COUNT))
    options = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    own = splu(matrix[order][:, order].tocsc(), permc_spec="NATURAL", **options)
    other = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", **options)
    assert own.L.nnz < 3 * other.L.nnz


def test_the_factor_solves(capped):
    """To 1e-12, several right sides at once."""
    points, matrix = capped
    expected = np.random.default_rng(2).normal(size=(COUNT, 3))
    np.testing.assert_allclose(factor(matrix, points)(matrix @ expected), expected, rtol=0, atol=1e-12)
