"""Warnings of `invert` about its fit: χ², structure of the residuals, a coarse mesh, variances that still change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, hstack
from scipy.stats import norm

from ..runtime.stderr_lines import told
from .measurement import LOG, tell_misfit
from .nonnegative import factor
from .patterns import Patterns, views_of
from .problem import Fit, Problem
from .sensitivity_picture import view_labels
from .structure import common_errors, structure

Array = NDArray[np.float64]


def fit_warnings(
    problem: Problem, fit: Fit, signal: Array, chi2_sum: float, confidence: float
) -> tuple[list[str], float]:
    """Warnings, each told on stderr: χ² of the residuals, and but for `mlem` their structure and a coarse mesh.

    signal : (N,) fitted power [W];  chi2_sum : Σ (residual/σ)²

    With them the largest change of a weighted sum of J_n by a J_n that is curved on faces, over the sum's standard
    deviation (Eq. M.42); 0 for `mlem`.
    """
    measurement, rows = problem.measurement, problem.rows
    noise = measurement.chi2(rows, signal, fit.sigma)
    if not fit.determined > 0:  # mlem follows the noise: its χ² may be small
        return tell_misfit("invert", chi2_sum, len(rows), fit.determined, [replace(noise, mean=0.0)]), 0.0
    lines = tell_misfit("invert", chi2_sum, len(rows), fit.determined, [noise])
    views = views_of(view_labels(problem.matrix), measurement.as_images(rows, signal)[0], rows, fit.sigma)
    free, design = ~problem.bounds | (fit.x > 0), problem.design(fit.x)
    slopes = csr_array((diags_array(1 / fit.sigma) @ design)[:, free])
    if free.all():
        _, solve = problem.normal(design, fit.sigma, fit.weight)
    else:
        solve = factor(csr_array(problem.hessian(design, fit.sigma, fit.weight)[free][:, free]))
    between, edge = problem.between(fit.x)
    common = hstack([common_errors(fit.numerical / fit.sigma, views), csr_array((between / fit.sigma)[:, None])])
    residual = (measurement.power[rows] + fit.correction - signal) / fit.sigma  # Eq. M.29
    parts = measurement.common(rows, signal)
    found = structure(residual, slopes, solve, Patterns.of(views), csr_array(common), None, parts, fit.sigma)
    right = slopes.T @ (between / fit.sigma)
    largest = float(max(right @ solve(right), 0.0) ** 0.5)
    coarse = [] if largest < norm.ppf((1 + confidence) / 2) else [_coarse(largest, edge, problem.settings.fine)]
    return [*lines, *told("invert", [*found.lines(), *coarse])], largest


def _coarse(largest: float, edge: float, fine: float) -> str:
    """Words on edges [mm] of a mesh on which sums of J_n change by up to `largest` standard deviations."""
    return (
        f"the mesh is coarse for so little noise: J_n curves between vertices {edge:.2g} mm apart, which changes sums "
        f"of J_n by up to {largest:.2g} of their standard deviations. Intervals contain it. With edges of "
        f"{edge * (fine / largest) ** 0.5:.2g} mm it would be at most {fine:.2g}."
    )


def tell_unconverged(found: Fit, rounds: int) -> None:
    """Say in one line on stderr that the rounds were too few for variances and weight."""
    if not found.converged:
        LOG.warning(
            "fspt: invert: variances and weight still change after %d rounds; the last ones are kept. Give a weight, "
            "for example %.3g.",
            rounds,
            found.weight,
        )
