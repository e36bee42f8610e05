"""Penalty on the roughness of J_n, and what it says as a prior (Eq. M.23 of docs/model.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from ..runtime.errors import InversionError
from ..runtime.numbers import number
from .surface import Surface

Array = NDArray[np.float64]
# Of the median diagonal of the penalty per area: keeps J_n determined where no pixel sees a whole connected piece. The
# smoothest mode of a surface of 100 edges across has an eigenvalue of 1e-6 of it, so that no visible mode changes.
RIDGE = 1e-10


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of J_n: the numbers of the penalty in addition to its weight (Eq. M.23 of docs/model.md).

    correlation_length : 1/κ [mm], > 0; None: infinite, so that only the curvature of J_n is penalised
    mean : [W/mm²], >= 0, value that J_n tends to over lengths larger than `correlation_length`
    reference : ρ [W/mm²], > 0, by which J_n is divided in the penalty; None: J_n of a first fit at each vertex

    Raises InversionError for a number outside its range.
    """

    correlation_length: float | None = None
    mean: float = 0.0
    reference: float | None = None

    def __post_init__(self) -> None:
        for name, positive, unit in (("correlation_length", True, "mm"), ("mean", False, "W/mm²"),
                                     ("reference", True, "W/mm²")):  # fmt: skip
            if (value := getattr(self, name)) is None:
                continue
            value = number(f"prior: '{name}'", value, InversionError, "1e-3")
            if not 0 <= value < np.inf or (positive and value == 0):
                raise InversionError(
                    f"prior: '{name}' must be finite and {'>' if positive else '>='} 0 {unit}, got {value:g}."
                    " Give for example 1e-3."
                )
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class Smoothness:
    """½ weight ∫ ((κ² − Δ)(J_n − mean)/ρ)² dS (Eq. M.23, M.33), without its weight, on the unknowns of a surface.

    root : (m, m) [mm⁻¹], R with ‖R x‖² = ∫ ((κ² − Δ) x/r)² dS for x = (J_n − mean)/reference, r = ρ/reference
    matrix : (m, m) RᵀR [mm⁻²]
    """

    root: csr_array
    matrix: csr_array

    @classmethod
    def of(cls, surface: Surface, correlation_length: float | None, relative: Array | float = 1.0) -> Smoothness:
        """Penalty with κ = 1/`correlation_length` [1/mm], or κ = 0 for None, and r = `relative` (m,) > 0."""
        rough, mass = surface.roughness
        kappa = 0.0 if correlation_length is None else 1 / correlation_length
        operator = rough + kappa**2 * diags_array(mass * (np.diff(rough.indptr) > 0))
        root = csr_array(diags_array(1 / (np.sqrt(mass) * relative)) @ operator)
        matrix = csr_array(root.T @ root)
        ridge = RIDGE * float(np.median(matrix.diagonal() / mass))
        return cls(root, csr_array(matrix + diags_array(ridge * mass)))

    def energy(self, x: Array) -> float:
        """xᵀ RᵀR x [mm⁻²]."""
        return float(x @ (self.matrix @ x))
