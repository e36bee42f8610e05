"""Fresnel's reflectance inside of a smooth border, at nodes of quadrature rules over the hemisphere."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .boundary import fresnel_transmittance, index_of

Array = NDArray[np.float64]

NODES = 32  # of Gauss' rules below and above the critical angle: the extrapolation length is right to 1e-9


def hemisphere(n: float, nodes: int = NODES) -> tuple[Array, Array, Array]:
    """Inner cosines µ, weights of ∫ dµ over (0, 1) and Fresnel's reflectance R there, each (k,), at the index n.

    The nodes are Gauss' below the critical angle, where R = 1, and in the outer cosine above it, where R is smooth.
    """
    n = index_of(n)
    x, weight = np.polynomial.legendre.leggauss(nodes)
    x, weight = (x + 1) / 2, weight / 2
    if n == 1:
        return x, weight, np.zeros(nodes)
    inner = np.sqrt(1 - (1 - x**2) / n**2)
    critical = math.sqrt(1 - 1 / n**2)
    cosine = np.concatenate([critical * x, inner])
    reflectance = np.concatenate([np.ones(nodes), 1 - fresnel_transmittance(inner, n)])
    weights = np.concatenate([critical * weight, x / n**2 / inner * weight])
    return cosine, weights / weights.sum(), reflectance
