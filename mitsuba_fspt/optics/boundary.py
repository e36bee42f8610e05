"""The boundary factor A of the diffusion equation, which relates fluence and exitance at a jump of the index.

At the surface the fluence phi [W/mm²] obeys phi + 2 A D dphi/dn = 0, D the diffusion coefficient [mm], so the
exitance is J_n = -D dphi/dn = phi/(2A). A depends only on the relative index n >= 1 of the tissue; A = 1 for n = 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FluxError

LARGEST_INDEX = 100  # above it, rounding dominates the computed A


def robin_a(n: float) -> float:
    """A = (2/(1 − R0) − 1 + |cos θc|³)/(1 − |cos θc|²), no unit, >= 1; R0: normal reflectance, sin θc = 1/n.

    NIRFAST calls this approximation 'robin'. It sets the reflectance below the critical angle to R0, that at normal
    incidence. A is 2.570 at n = 1.37 and 3.571 at n = 1.53.

    Raises
    ------
    FluxError : n is below 1 or above 100.
    """
    n = index_of(n)
    face_on = ((n - 1) / (n + 1)) ** 2
    critical = math.sqrt(1 - 1 / n**2)
    return (2 / (1 - face_on) - 1 + critical**3) / (1 - critical**2)


def haskell_a(n: float) -> float:
    """A = (1 + R_J)/(1 − R_phi) with hemispherical moments of the Fresnel reflectance R; no unit, >= 1.

    R_phi = ∫ 2µ R(µ) dµ and R_J = ∫ 3µ² R(µ) dµ over the inner cosine µ in [0, 1]: 2.7586 at n = 1.37,
    3.846 at n = 1.53. Haskell et al., "Boundary conditions for the diffusion equation in radiative transfer",
    1994. With this A the exit radiance J_n/(4π) · (2A + 3µ) · T/n² carries exactly J_n.

    Raises
    ------
    FluxError : n is below 1 or above 100.
    """
    n = index_of(n)
    # As a function of the outer cosine (µ dµ = µ_o dµ_o / n²) the transmittance has no kink at the critical angle.
    # It is steep at grazing exit for n near 1, where the nodes µ_o = x² are dense.
    x, weight = np.polynomial.legendre.leggauss(64)
    x, weight = (x + 1) / 2, weight / 2
    outer = x**2
    inner = np.sqrt(1 - (1 - outer**2) / n**2)
    flux = fresnel_transmittance(inner, n) * outer / n**2 * 2 * x * weight
    return float((2 - (3 * inner * flux).sum()) / (2 * flux.sum()))


def boundary_a(a: str | float, n: float) -> float:
    """A [1] by one of its formulas, `a` = 'robin' or 'haskell' at the index n, or `a` itself, a number > 0 or its text.

    Raises
    ------
    FluxError : `a` is neither of the names nor a positive finite number, or n is below 1 or above 100.
    """
    if a == "robin":
        return robin_a(n)
    if a == "haskell":
        return haskell_a(n)
    try:
        value = float(a)
    except (TypeError, ValueError):
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise FluxError(f"boundary factor: 'a' must be robin, haskell or a number > 0, got '{a}'.")
    return value


def fresnel_transmittance(cos_inner: NDArray[np.float64], n: float) -> NDArray[np.float64]:
    """Unpolarised Fresnel transmittance from index n into 1 at the inner cosine (any shape), in [0, 1]."""
    cos_outer = np.sqrt(np.maximum(1 - n**2 * (1 - cos_inner**2), 0))
    with np.errstate(invalid="ignore"):  # 0/0 only at grazing incidence between matched indices
        s = (n * cos_inner - cos_outer) / (n * cos_inner + cos_outer)
        p = (n * cos_outer - cos_inner) / (n * cos_outer + cos_inner)
        transmittance = 1 - (s**2 + p**2) / 2
    return np.where(cos_outer > 0, transmittance, 0.0)


def index_of(n: float) -> float:
    """`n` as a float; FluxError if it is below 1 or above 100."""
    if not 1 <= n <= LARGEST_INDEX:
        raise FluxError(
            f"boundary factor: the refractive index n must be >= 1 and at most {LARGEST_INDEX}, got {n:g}. Give the "
            "tissue's index relative to the medium around it, for example 1.37."
        )
    return float(n)
