"""Exact solutions of the diffusion equation for the tests: a sphere, a slab of two layers. Lengths in mm, powers in W.

Written from the equations alone; shares nothing with the package.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.special import eval_legendre, j0, spherical_in, spherical_kn

Array = NDArray[np.float64]


def ball_exitance(
    radius: float, offset: float, mua: float, musp: float, a: float, cosine: Array, orders: int = 40
) -> Array:
    """J_n [1/mm²] per watt at angles of given cosine from a point source, `offset` off the middle of a sphere.

    exp(-kd)/(4πd) = k/(2π²) Σ (2l + 1) i_l(k offset) k_l(kr) P_l(cos); each order meets the boundary
    condition alone.
    """
    diffusion = 1 / (3 * (mua + musp))
    k = np.sqrt(mua / diffusion)
    result = np.zeros_like(cosine)
    for order in range(orders):
        grown, growth = spherical_in(order, k * radius), k * spherical_in(order, k * radius, derivative=True)
        decayed, decay = spherical_kn(order, k * radius), k * spherical_kn(order, k * radius, derivative=True)
        mirror = -(decayed + 2 * a * diffusion * decay) / (grown + 2 * a * diffusion * growth)
        amplitude = (2 * order + 1) * spherical_in(order, k * offset) * (decayed + mirror * grown)
        result += amplitude * eval_legendre(order, cosine)
    return k / (2 * np.pi**2 * diffusion) * result / (2 * a)


def layers_fluence(
    border: tuple[float, float, float],
    mua: tuple[float, float],
    musp: tuple[float, float],
    a: tuple[float, float],
    source: float,
    across: Array,
    height: float,
) -> Array:
    """φ [1/mm²] per watt `across` from the axis at z = `height` (a face), for a point source at z = `source`.

    `border`: z of the bottom, the interface and the top of two endless layers; the source is in the lower
    one. In the plane a Hankel transform: φ = 1/(2π) ∫ g(s, z) J₀(s·across) s ds; g solves the equation in z.
    """
    bottom, middle, top = border
    x, weight = np.polynomial.legendre.leggauss(400)
    s, weight = 6 * (x + 1), 6 * weight
    d1, d2 = (1 / (3 * (m + p)) for m, p in zip(mua, musp, strict=True))
    k1, k2 = np.sqrt(s**2 + mua[0] / d1), np.sqrt(s**2 + mua[1] / d2)

    def free(z: float) -> tuple[Array, Array]:
        value = np.exp(-k1 * abs(z - source)) / (2 * d1 * k1)
        return value, -k1 * np.sign(z - source) * value

    # Lower layer: free + p exp(-k1 (z - bottom)) + q exp(k1 (z - middle)); upper: u exp(-k2 (z - middle)) + v
    # exp(k2 (z - top)). Rows: bottom, fluence and flux at the interface, top.
    e1, e2, one = np.exp(-k1 * (middle - bottom)), np.exp(-k2 * (top - middle)), np.ones_like(s)
    zero = np.zeros_like(s)
    h1, h2 = 2 * a[0] * d1 * k1, 2 * a[1] * d2 * k2
    matrix = np.array(
        [
            [1 + h1, e1 * (1 - h1), zero, zero],
            [e1, one, -one, -e2],
            [-d1 * k1 * e1, d1 * k1, d2 * k2, -d2 * k2 * e2],
            [zero, zero, e2 * (1 - h2), 1 + h2],
        ]
    )
    low, slope_low = free(bottom)
    mid, slope_mid = free(middle)
    right = np.array([2 * a[0] * d1 * slope_low - low, -mid, -d1 * slope_mid, zero])
    p, q, u, v = np.linalg.solve(matrix.transpose(2, 0, 1), right.T[:, :, None])[:, :, 0].T
    if height == bottom:
        g = low + p + q * e1
    elif height == top:
        g = u * e2 + v
    else:
        raise ValueError("height must be that of a face")
    return (j0(np.outer(across, s)) * (g * s * weight)).sum(axis=1) / (2 * np.pi)


def coupled_ball_exitance(
    radius: float,
    offset: float,
    diffusion: Array,
    reaction: Array,
    source: Array,
    border: Array,
    lateral: float,
    cosine: Array,
    orders: int = 40,
    flow: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """As `ball_exitance` for -c ∇²φ + C φ = s q with c ∂φ/∂n = -(H φ) + τ ∇_t²φ_1 = -h_1 (in the first equation).

    J_n = h_1 + f with f - b ∇_t² f = a ∇_t² h_1 and (a, b) = `flow`.
    """
    squares, vectors = eigh(reaction, np.diag(diffusion))
    k, power = np.sqrt(squares), vectors.T @ source
    result = np.zeros_like(cosine)
    for order in range(orders):
        matrix = border.copy()
        along = order * (order + 1) / radius**2
        matrix[0, 0] += lateral * along
        # Both functions of each mode over their values on the border, which under- and overflow.
        decayed = spherical_kn(order, k * radius)
        decay = k * spherical_kn(order, k * radius, derivative=True)
        growth = k * spherical_in(order, k * radius, derivative=True) / spherical_in(order, k * radius)
        own = power * k / (2 * np.pi**2) * (2 * order + 1) * spherical_in(order, k * offset)
        right = -(diffusion * (vectors @ (own * decay)) + matrix @ (vectors @ (own * decayed)))
        mirror = np.linalg.solve(diffusion[:, None] * vectors * growth + matrix @ vectors, right)
        outward = matrix @ (vectors @ (own * decayed + mirror))
        result += outward[0] * (1 - flow[0] * along / (1 + flow[1] * along)) * eval_legendre(order, cosine)
    return result
