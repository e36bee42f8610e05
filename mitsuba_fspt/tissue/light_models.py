"""Models of light in tissue, as coupled equations of second order: diffusion (one component) and SP3 (two, Eq. M.47).

    -∇·(c_i ∇φ_i) + Σ_j C_ij φ_j = s_i q inside,   c_i ∂φ_i/∂n = -Σ_j H_ij φ_j + δ_i1 ∇_t·(τ ∇_t φ_1) on the border

with the gradient ∇_t along the border. The fluence is Σ_i s_i φ_i, J_n = h + f with h = -c_1 ∂φ_1/∂n and the flow of
light along the border, f - ∇_t·(b ∇_t f) = ∇_t·(a ∇_t h). τ = a = b = 0 for diffusion. C and H are symmetric.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optics.absorbing_border import absorbing
from ..optics.boundary import boundary_a
from ..optics.half_space import border
from ..optics.media import Medium
from ..optics.sp3_boundary import curvature_effect, shortened, sp3_boundary, sp3_coefficients
from ..runtime.errors import FluxError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MODELS = ("sp3", "diffusion")
DEFAULT = "sp3"


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations of m components in R regions.

    title : for provenance;  diffusion : c, (R, m) [mm];  reaction : C, (R, m, m) [1/mm];  source : s, (m,)
    border : H of a flat border, (R, m, m)
    length : extrapolation length in mean free paths that H_11 contains, (R,);  bend : its fall per curvature [mm], (R,)
    lateral : τ, (R,) [mm²];  flow, spread : a, b, (R,) [mm²]
    """

    title: str
    diffusion: Array
    reaction: Array
    source: Array
    border: Array
    length: Array
    bend: Array
    lateral: Array
    flow: Array
    spread: Array

    @property
    def components(self) -> int:
        """m."""
        return len(self.source)

    def border_at(self, region: Index, curvature: Array) -> Array:
        """H of border points in these regions (N,) where the border's mean curvature is `curvature` (N,) [1/mm]."""
        matrix = self.border[region]
        fall, length = self.bend[region] * curvature, self.length[region]
        matrix[:, 0, 0] += (1 / shortened(length, fall) - 1 / length) / 3
        return matrix

    def modes(self, region: int) -> tuple[Array, Array]:
        """Squares of the decay constants k (m,) [1/mm²] in a region, and the columns X (m, m) of their components.

        C X = diag(c) X diag(k²), Xᵀ diag(c) X = 1: an endless region has φ_i = Σ_k X_ik (Σ_j X_jk s_j) exp(-kr)/(4πr).
        """
        scale = 1 / np.sqrt(self.diffusion[region])
        squares, vectors = np.linalg.eigh(self.reaction[region] * np.outer(scale, scale))
        return np.maximum(squares, 0), vectors * scale[:, None]

    def same(self, one: int, other: int) -> bool:
        """True if two regions have the same c and C."""
        return bool(
            (self.diffusion[one] == self.diffusion[other]).all() and (self.reaction[one] == self.reaction[other]).all()
        )


def equations(model: str, media: Sequence[Medium], a: str | float = "robin") -> Equations:
    """Equations of the model "sp3" or "diffusion" in these media, one per region, with the boundary factor `a`.

    Raises
    ------
    FluxError : another model, an impossible `a`, or one beside 'robin' where the model is "sp3".
    """
    check_model(model, a)
    return _sp3(media) if model == "sp3" else _diffusion(media, a)


def check_model(model: str, a: str | float) -> None:
    """Raise FluxError where there is no such model, or where it does not take this boundary factor."""
    if model not in MODELS:
        raise FluxError(f"'model' must be one of {', '.join(MODELS)}, got '{model}'. Give \"sp3\" for the usual one.")
    if model == "sp3" and a != "robin":
        raise FluxError(
            f"'a' is of the diffusion equation, got {a!r} beside the model sp3. Leave 'a' out, or give "
            'model = "diffusion".'
        )


def _diffusion(media: Sequence[Medium], a: str | float) -> Equations:
    """-∇·(D ∇φ) + µa φ = q,  φ + 2 A D ∂φ/∂n = 0,  D = 1/(3 (µa + µs'))."""
    factors = np.array([boundary_a(a, medium.n) for medium in media])
    return Equations(
        "diffusion equation",
        np.array([[medium.diffusion] for medium in media]),
        np.array([[[medium.mua]] for medium in media]),
        np.ones(1),
        1 / (2 * factors[:, None, None]),
        2 / 3 * factors,
        *np.zeros((4, len(media))),
    )


def _sp3(media: Sequence[Medium]) -> Equations:
    """Eq. M.47 with φ₁ = Φ₀ + 2 Φ₂ and φ₂ = 3 Φ₂, Φ_l the moments of the radiance."""
    mua, musp, g = (np.array([getattr(medium, key) for medium in media]) for key in ("mua", "musp", "g"))
    total = mua + musp
    diffusion, reaction = sp3_coefficients(mua, musp, g)
    borders = [border(medium.n, medium.g) for medium in media]
    changes = [absorbing(one.n, one.g).at(one.mua / one.musp) for one in media]
    shift, lateral, flow, spread = np.transpose(changes)
    matrices = np.array([sp3_boundary(medium.n, medium.g) for medium in media])
    matrices[:, 0, 0] += shift
    flat = np.array([one.length for one in borders])
    bend = np.array([curvature_effect(one.n, one.g, one.mua / one.musp) for one in media])
    return Equations(
        "SP3 equations",
        diffusion,
        reaction,
        np.array([1, -2 / 3]),
        matrices,
        1 / (1 / flat + 3 * shift),
        bend / total,
        lateral * [one.lateral for one in borders] / (3 * flat**2 * total**2),
        flow * [one.flow for one in borders] / total**2,
        spread * [one.spread for one in borders] / total**2,
    )
