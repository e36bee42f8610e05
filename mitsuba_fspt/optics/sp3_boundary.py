"""Boundary condition of the SP3 equations at a jump of the refractive index (Eq. M.48), as numbers of the index alone.

The outward flux of the components φ₁, φ₂ is -c ∂φ/∂n = H φ with a symmetric matrix H. The condition
of Marshak sets ∫ P_k(µ) [ψ(-µ) - R(µ) ψ(µ)] dµ = 0 on the inner hemisphere for k = 1, 3, ψ the radiance of SP3, R the
reflectance of Fresnel, P_k Legendre's polynomials:

    H = diag(1/3, 1/7) S⁻¹ N,   N_kl = ½ ∫ (1 - R) P_k P_l dµ/µ,   S_kl = ½ ∫ (1 + R) P_k P_l dµ

A. D. Klose, E. W. Larsen, J. Comput. Phys. 220, 441 (2006), write the same with the moments R_1 … R_6. H_12 and H_21
differ by at most 0.007; their mean stands for both, as transport has reciprocity. R jumps at the critical angle, which
two polynomials do not follow: the extrapolation length would be 2.6 % too short at n = 1.37, 4.6 % at n = 1.5. H_11 is
therefore changed so that the extrapolation length is that of transport (`half_space`), z₀ - β κ on a border of the mean
curvature κ (both per mean free path).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .boundary import index_of
from .half_space import border
from .hemisphere import hemisphere

Array = NDArray[np.float64]

# Outward flux per φ₂ of a layer at the border in which φ₂ decays, κ/7 with κ = √(35/9) per mean free path, for g = 0
# without absorption. H + diag(0, LAYER) is positive definite, and so is the whole problem, though for n > 1.7 H alone
# is not.
LAYER = math.sqrt(35 / 9) / 7
# n, β at g = 0 and 0.9 without absorption, and their rise per µa/µs': from photons in spheres with a source in the
# middle (scripts/tissue_models.py --border). The extrapolation length is linear in the curvature there, for radii of
# 6 to 24 mean free paths.
CURVATURE_EFFECT = (
    (1.0, 0.44, 0.27, 0.0, 0.0),
    (1.1, 0.84, 0.47, 0.0, 0.4),
    (1.2, 1.24, 0.67, 0.5, 0.9),
    (1.33, 1.73, 0.87, 1.8, 1.6),
    (1.4, 1.97, 0.97, 3.0, 2.0),
    (1.5, 2.3, 1.11, 5.2, 2.7),
    (1.7, 2.9, 1.34, 11.0, 4.0),
)
FORWARD = 0.9  # g of the second and the last column
LARGEST = 0.15  # µa/µs' from which the numbers of the border stay the same


@cache
def sp3_boundary(n: float, g: float = 0.0) -> Array:
    """H, shape (2, 2), no unit: outward flux of φ₁, φ₂ per φ₁, φ₂ on the border of tissue of the relative index n >= 1.

    g : anisotropy of the scattering

    Raises
    ------
    FluxError : n is below 1 or above 100.
    """
    marshak = marshak_boundary(n)
    matrix = (marshak + marshak.T) / 2
    layer = LAYER * math.sqrt((1 + g) / (1 + g + g**2))
    matrix[0, 0] = 1 / (3 * border(n, g).length) + matrix[0, 1] ** 2 / (matrix[1, 1] + layer)
    matrix.setflags(write=False)
    return matrix


def sp3_coefficients(mua: Array, musp: Array, g: Array) -> tuple[Array, Array]:
    """c (R, 2) [mm] and C (R, 2, 2) [1/mm] of Eq. M.47 in media of µa, µs' [1/mm] and g, (R,) each."""
    total, second, third = mua + musp, mua + musp * (1 + g), mua + musp * (1 + g + g**2)
    reaction = np.array([[mua, -2 / 3 * mua], [-2 / 3 * mua, 4 / 9 * mua + 5 / 9 * second]])
    return np.column_stack([1 / (3 * total), 1 / (7 * third)]), np.moveaxis(reaction, 2, 0)


def marshak_boundary(n: float) -> Array:
    """H of Marshak's condition, shape (2, 2), no unit, as Klose and Larsen give it; raises FluxError as above."""
    cosine, weight, reflectance = hemisphere(n)
    legendre = np.array([cosine, (5 * cosine**3 - 3 * cosine) / 2])
    odd = (legendre * (weight * (1 + reflectance))) @ legendre.T / 2
    even = (legendre * (weight * (1 - reflectance) / cosine)) @ legendre.T / 2
    return np.asarray(np.linalg.solve(odd * [3, 7], even))


def curvature_effect(n: float, g: float = 0.0, absorption: float = 0.0) -> float:
    """β: fall of the extrapolation length per mean curvature of the border, both in mean free paths.

    Linear in n between the table's, in g/(1 + g): at n = 1.37 photons of g = 0.5 and 0.8 agree to 2 %, and in
    µa/µs' = `absorption` up to `LARGEST`.
    """
    index, *columns = np.transpose(CURVATURE_EFFECT)
    isotropic, forward = np.array(columns[:2]) + min(absorption, LARGEST) * np.array(columns[2:])
    share = g / (1 + g) / (FORWARD / (1 + FORWARD))
    return float(np.interp(index_of(n), index, (1 - share) * isotropic + share * forward))


def shortened(length: Array, fall: Array) -> Array:
    """Extrapolation length less its `fall` where this is less than half of it; beyond, as at an edge, it stays > 0."""
    share = np.maximum(fall / length, -1)
    return length * np.where(share < 0.5, 1 - share, 0.25 / np.maximum(share, 0.5))
