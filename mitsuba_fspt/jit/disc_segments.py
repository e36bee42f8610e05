"""Segments of the unit disc: the share of its area below a chord, the inverse of that, and its integrals."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

NEWTON_STEPS = 8
DEGREE = 9  # of the polynomial for the inverse, with an error of 2e-8


def segment(y: mi.Float) -> mi.Float:
    """F(y), the share of the disc's area on which a coordinate is less than y; 0 for y <= -1, 1 for y >= 1."""
    y = dr.clip(y, -1, 1)
    return 0.5 + (y * dr.sqrt(1 - y * y) + dr.asin(y)) / dr.pi


def segment_height(share: mi.Float) -> mi.Float:
    """Height y with F(y) = share, for a share in [0, 1].

    The angle δ = 2 acos |y| of the smaller segment satisfies δ - sin δ = 2π times its share. As a function of
    (δ - sin δ)^(2/3), |y| is smooth up to the disc's rim and is evaluated as a polynomial.
    """
    smaller = 2 * dr.pi * dr.minimum(share, 1 - share)
    z = dr.square(dr.cbrt(smaller)) / (0.5 * LARGEST) - 1
    y = mi.Float(_HEIGHT[-1])
    for coefficient in reversed(_HEIGHT[:-1]):
        y = dr.fma(y, z, coefficient)
    return dr.mulsign(y, share - 0.5)


def _height(square: NDArray[np.float64]) -> NDArray[np.float64]:
    """cos(δ/2) as a function of `square` = (δ - sin δ)^(2/3)."""
    wanted = square**1.5
    angle = np.cbrt(6 * wanted)  # first approximation of δ
    for _ in range(NEWTON_STEPS):
        angle -= (angle - np.sin(angle) - wanted) / (1 - np.cos(angle))
    return np.cos(angle / 2)


LARGEST = math.pi ** (2 / 3)
_HEIGHT = np.polynomial.chebyshev.cheb2poly(Chebyshev.interpolate(_height, DEGREE, domain=[0, LARGEST]).coef).tolist()


def segment_integral(y: mi.Float64) -> mi.Float64:
    """Integral of F from -1 to y; 0 for y < -1."""
    z = dr.clip(y, -1, 1)
    rest = dr.sqrt(1 - z * z)
    return z * segment(z) + 2 / (3 * dr.pi) * rest**3 + dr.maximum(y - 1, 0)


def segment_double_integral(y: mi.Float64) -> mi.Float64:
    """Integral of `segment_integral` from -1 to y; 0 for y < -1."""
    z = dr.clip(y, -1, 1)
    rest = dr.sqrt(1 - z * z)
    arc = dr.asin(z) * (4 * z * z + 1) / 8 + z * rest * (2 * z * z + 13) / 24
    return (4 * z * z + 1) / 16 + arc / dr.pi + 0.5 * (dr.square(dr.maximum(y, 1)) - 1)
