"""Maximum likelihood by expectation maximisation (MLEM) with a background, the plain alternative without a penalty.

    y_i = k_i P_i + b_i,   m = k T x + b,   x ← x · [Tᵀk (y/m)] / [Tᵀk],   b the variance of read-out and dark current

in electrons: a Poisson number of mean m has the mean and the variance of the data (Eq. M.28 of docs/model.md). It ends
when the duality gap of the likelihood is below a bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MlemAccuracy:
    """Bounds of MLEM.

    gap : bound of log-likelihood(maximum) − log-likelihood(x). At 0.5 it is what one standard deviation of one
        combination of J_n costs.
    iterations : most of them; what is left after them is in the result
    every : iterations between two looks at the gap
    """

    gap: float = 0.5
    iterations: int = 20_000
    every: int = 50


def mlem(
    transport: csr_array,
    power: Array,
    per_watt: Array,
    background: Array,
    accuracy: MlemAccuracy,
    report: Callable[[float], None],
) -> tuple[Array, float]:
    """x (m,) >= 0, 0 where no pixel sees it, and its duality gap.

    transport : (N, m) [W], the power of x = 1;  power : (N,) [W];  per_watt, background : (N,), k [e⁻/W] and b [e⁻]
    """
    system = csr_array(diags_array(per_watt) @ transport)
    back = csr_array(system.T)
    counted = np.maximum(per_watt * power + background, 0)
    sensitivity = np.asarray(system.sum(axis=0)).ravel()
    seen = sensitivity > 0
    x = np.where(seen, max(float((counted - background).sum()), 1.0) / sensitivity.sum(), 0.0)
    inverse = np.divide(1.0, sensitivity, out=np.zeros_like(sensitivity), where=seen)
    gap = np.inf
    for count in range(accuracy.iterations):
        model = np.maximum(system @ x + background, 1e-300)
        share = counted / model
        ratio = inverse * (back @ share)
        if count % accuracy.every == 0:
            gap = _gap(counted, model, background, share / max(float(ratio.max()), 1.0))
            report(min(accuracy.gap / max(gap, 1e-300), 1.0))
            if gap <= accuracy.gap:
                break
        x = x * ratio
    return x, gap


def _gap(counted: Array, model: Array, background: Array, dual: Array) -> float:
    """Σ (m − y log m) less the value of its dual at v, which is feasible: Aᵀ v <= Aᵀ 1."""
    lit = counted > 0
    y, v = counted[lit], dual[lit]
    primal = model.sum() - y @ np.log(model[lit])
    return float(primal - (y.sum() - y @ np.log(y) + y @ np.log(v) + (1 - dual) @ background))
