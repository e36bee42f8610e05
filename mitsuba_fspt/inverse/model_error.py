"""Stated error of the equation itself, SP3 or diffusion, in the J_n of a source (Eq. M.51).

    δJ_n/J_n = t x₀ + s (x₁ (2µ − 1) + x₂ (6µ² − 6µ + 1)) + e η x₃,   µ = d/r,   x ~ N(0, 1)

with the distances d of the source and r of a point of the surface: a common factor, and what varies from the nearest
point of the surface, µ = 1, to far ones, µ = 0. J_n of SP3 differs from photons one by one by such polynomials but for
0.1 to 1 %, J_n of diffusion but for up to 2 %. t grows with the absorption along the way; s falls with the depth in
mean free paths, and grows with the absorption. Both equations are wrong near creases of the border, as the rim of a
cylinder; η is 1 there and falls over a mean free path (`border_curvature`). e η is not only an error in common: pixels
have it in their σ, too, so that the fit takes little from what J_n is near creases.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST_DEPTH = 1.0  # mean free paths: a source nearer to the border has the errors of this depth


@dataclass(frozen=True)
class ModelError:
    """t² = total² + (total_absorbed α D)² and s² = (shape/D)² + (shape_absorbed α)² of a source D mean free paths deep
    in tissue of α = µa/µs'; e = `crease`.
    """

    total: float
    total_absorbed: float
    shape: float
    shape_absorbed: float
    crease: float

    def deviations(self, depth: float, absorption: float) -> tuple[float, float]:
        """t and s of a source `depth` mean free paths deep, in tissue of the ratio µa/µs' `absorption`."""
        deep = max(depth, LEAST_DEPTH)
        t = np.hypot(self.total, self.total_absorbed * absorption * deep)
        return float(t), float(np.hypot(self.shape / deep, self.shape_absorbed * absorption))

    def columns(self, cosine: Array, depth: float, absorption: float, near: Array) -> Array:
        """(n, 4) relative errors of J_n by one standard deviation of x₀ … x₃ where µ = `cosine`, η = `near`, (n,)."""
        t, s = self.deviations(depth, absorption)
        first, second = shapes(cosine)
        return np.column_stack([np.full(len(cosine), t), s * first, s * second, self.crease * near])


def shapes(cosine: Array) -> tuple[Array, Array]:
    """Legendre's polynomials of the degrees 1 and 2 over (0, 1)."""
    return 2 * cosine - 1, 6 * cosine**2 - 6 * cosine + 1


# Least squares over the phantoms of docs/tissue_models.csv, by `scripts/tissue_models.py --errors`, rounded up; those
# of SP3 are larger, 1.1 to 2.6 times the least squares, but for `total`. `crease` is the deviation of J_n at the rim of
# cylinders, by `scripts/tissue_models.py --creases`.
MODEL_ERRORS: Mapping[str, ModelError] = {
    "sp3": ModelError(0.0045, 0.03, 0.055, 0.26, 0.1),
    "diffusion": ModelError(0.0075, 0.26, 0.26, 1.4, 0.15),
}
