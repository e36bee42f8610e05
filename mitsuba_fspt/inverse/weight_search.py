"""Search for the weight of the penalty, the fixed point of Eq. M.25."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def secant(tried: Sequence[tuple[float, float]]) -> float:
    """Next estimate of the solution of g(x) = x from the last pairs (x, g(x)), by the secant method.

    The slope of the secant is limited to -1 … 0.8, which bounds the step to five times g(x) - x.
    """
    x, found = tried[-1]
    slope = 0.0
    if len(tried) > 1 and abs(x - tried[-2][0]) > 1e-12:
        slope = float(np.clip((found - tried[-2][1]) / (x - tried[-2][0]), -1.0, 0.8))
    return x + (found - x) / (1 - slope)
