"""Boundary condition of the SP3 equations at a jump of the refractive index (Eq. M.48), as numbers of the index alone.

The outward flux of the components φ₁, φ₂ is -c ∂φ/∂n = H φ with a symmetric matrix H. The condition
of Marshak sets ∫ P_k(µ) [ψ(-µ) - R(µ) ψ(µ)] dµ = 0 on the inner hemisphere for k = 1, 3, ψ the radiance of SP3, R the
reflectance of Fresnel, P_k Legendre's polynomials:

    H = diag(1/3, 1/7) S⁻¹ N,   N_kl = ½ ∫ (1 - R) P_k P_l dµ/µ,   S_kl = ½ ∫ (1 + R) P_k P_l dµ

A. D. Klose, E. W. Larsen, J. Comput. Phys. 220, 441 (2006), write the same with the moments R_1 … R_6. H_12 and H_21
differ by at most 0.007; their mean stands for both, as transport has reciprocity. R jumps at the critical angle, which
two polynomials do not follow: the extrapolation length would be 2.6 % too short at n = 1.37, 4.6 % at n = 1.5. H_11 is
therefore changed so that the extrapolation length is that of transport, z₀ - β κ on a border of the mean curvature κ
(both per mean free path).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .boundary import fresnel_transmittance, index_of

Array = NDArray[np.float64]

NODES = 32  # of Gauss' rules below and above the critical angle: the extrapolation length is right to 1e-9
# Outward flux per φ₂ of a layer at the border in which φ₂ decays, κ/7 with κ = √(35/9) per mean free path, without
# absorption. H + diag(0, LAYER) is positive definite, and so is the whole problem, though for n > 1.7 H alone is not.
LAYER = math.sqrt(35 / 9) / 7
# n, β: from photons in spheres of 6 to 24 mean free paths with a source in the middle (scripts/tissue_models.py). The
# extrapolation length is linear in the curvature there.
CURVATURE_EFFECT = ((1.0, 0.44), (1.1, 0.84), (1.2, 1.24), (1.33, 1.73), (1.4, 1.97), (1.5, 2.3), (1.7, 2.9))
# n, δ: from the distribution of exit power over spheres with a source near the surface (the same script).
LATERAL_EFFECT = ((1.0, 0.2), (1.1, 0.24), (1.2, 0.42), (1.33, 0.86), (1.4, 1.2), (1.5, 1.76), (1.7, 3.0))


@cache
def sp3_boundary(n: float) -> Array:
    """H, shape (2, 2), no unit: outward flux of φ₁, φ₂ per φ₁, φ₂ on the border of tissue of the relative index n >= 1.

    Raises
    ------
    FluxError : n is below 1 or above 100.
    """
    marshak = marshak_boundary(n)
    matrix = (marshak + marshak.T) / 2
    matrix[0, 0] = 1 / (3 * extrapolation_length(n)) + matrix[0, 1] ** 2 / (matrix[1, 1] + LAYER)
    matrix.setflags(write=False)
    return matrix


def marshak_boundary(n: float) -> Array:
    """H of Marshak's condition, shape (2, 2), no unit, as Klose and Larsen give it; raises FluxError as above."""
    cosine, weight, reflectance = hemisphere(n)
    legendre = np.array([cosine, (5 * cosine**3 - 3 * cosine) / 2])
    odd = (legendre * (weight * (1 + reflectance))) @ legendre.T / 2
    even = (legendre * (weight * (1 - reflectance) / cosine)) @ legendre.T / 2
    return np.asarray(np.linalg.solve(odd * [3, 7], even))


@cache
def extrapolation_length(n: float) -> float:
    """Depth outside of the border where the fluence of a half space, continued linearly, is 0, in mean free paths.

    Milne's problem of transport with isotropic scattering, without absorption, and Fresnel's reflectance, by discrete
    ordinates: 0.71045 at n = 1, 1.73855 at n = 1.37. Raises FluxError as above.
    """
    cosine, weight, reflectance = hemisphere(n)
    # Sum e and difference o of the radiance at µ and -µ: µ² e'' = e - Σ w e, o = -µ e'. The modes are eigenvectors.
    root = np.sqrt(weight)
    rates, vectors = np.linalg.eigh((np.eye(len(root)) - np.outer(root, root)) / np.outer(cosine, cosine))
    even = vectors[:, 1:] / (root * cosine)[:, None]
    odd = cosine[:, None] * even * np.sqrt(rates[1:])
    # e = z + length far from the border; ψ(µ) = R ψ(-µ) on it for the unknown length and amplitudes of the modes.
    enters = (1 - reflectance)[:, None] * even + (1 + reflectance)[:, None] * odd
    found = np.linalg.solve(np.column_stack([1 - reflectance, enters]), (1 + reflectance) * cosine)
    return float(found[0])


def curvature_effect(n: float) -> float:
    """β: fall of the extrapolation length per mean curvature of the border, both in mean free paths."""
    return float(np.interp(index_of(n), *np.transpose(CURVATURE_EFFECT)))


def lateral_effect(n: float) -> float:
    """δ: fall of the extrapolation length per square of the wave number along the border, in mean free paths."""
    return float(np.interp(index_of(n), *np.transpose(LATERAL_EFFECT)))


def shortened(length: Array, fall: Array) -> Array:
    """Extrapolation length less its `fall` where this is less than half of it; beyond, as at an edge, it stays > 0."""
    share = np.maximum(fall / length, -1)
    return length * np.where(share < 0.5, 1 - share, 0.25 / np.maximum(share, 0.5))


def hemisphere(n: float) -> tuple[Array, Array, Array]:
    """Inner cosines µ, weights of ∫ dµ over (0, 1) and Fresnel's reflectance R there, each (k,), at the index n.

    The nodes are Gauss' below the critical angle, where R = 1, and in the outer cosine above it, where R is smooth.
    """
    n = index_of(n)
    x, weight = np.polynomial.legendre.leggauss(NODES)
    x, weight = (x + 1) / 2, weight / 2
    if n == 1:
        return x, weight, np.zeros(NODES)
    inner = np.sqrt(1 - (1 - x**2) / n**2)
    critical = math.sqrt(1 - 1 / n**2)
    cosine = np.concatenate([critical * x, inner])
    reflectance = np.concatenate([np.ones(NODES), 1 - fresnel_transmittance(inner, n)])
    weights = np.concatenate([critical * weight, x / n**2 / inner * weight])
    return cosine, weights / weights.sum(), reflectance
