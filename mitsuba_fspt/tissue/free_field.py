"""Fluence of uniform spherical sources in infinite homogeneous tissue: the closed-form part of the solution.

-D ∇²φ + µa φ = q has φ = P/(4πDr) · exp(−kr) around a point of power P, k = √(µa/D). Outside a uniform ball
of radius a the same holds with P · 3 i₁(ka)/(ka) in place of P (mean value property), i₁ the modified
spherical Bessel function; inside, φ = q/(Dk²) · (1 − (1 + ka) exp(−ka) i₀(kr)). The components of coupled equations
are sums of such fields with the decay constants of the medium.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .light_models import Equations

Array = NDArray[np.float64]

# With this decay constant [1/mm] the factor exp(-kr) is 1 over any phantom. It replaces k = 0 of tissue without
# absorption, for which the closed form of the ball is 0/0.
SMALLEST_DECAY = 1e-7
PAIRS_AT_ONCE = 500_000


@dataclass(frozen=True, eq=False)
class FreeField:
    """Field of K spherical sources in infinite tissue.

    centres : array, shape (K, 3) [mm]
    radii : array, shape (K,) [mm], 0 for a point source
    powers : array, shape (K,) [W]
    diffusion, mua : D [mm] and µa [1/mm]
    """

    centres: Array
    radii: Array
    powers: Array
    diffusion: float
    mua: float

    @property
    def decay(self) -> float:
        """Decay k = √(µa/D) [1/mm], at least `SMALLEST_DECAY`."""
        return max(float(np.sqrt(self.mua / self.diffusion)), SMALLEST_DECAY)

    def fluence(self, points: Array, core: float = 0.0) -> Array:
        """φ [W/mm²] at `points` (N, 3) [mm], shape (N,).

        Closer than `core` [mm] to a centre φ is constant; with core 0 it is infinite at a point source.
        """
        fluence = np.empty(len(points))
        for part, distance in self._distances(points):
            fluence[part] = self._fluence_of_balls(np.maximum(distance, core)).sum(axis=1)
        return fluence

    def with_gradient(self, points: Array) -> tuple[Array, Array, Array]:
        """φ [W/mm²], shape (N,), ∇φ [W/mm³] and Σ P r/(4πr³) [W/mm²], shape (N, 3), at `points` (N, 3) [mm].

        The last one equals -D ∇φ outside the spheres in tissue without absorption.
        """
        fluence, gradient = np.empty(len(points)), np.empty((len(points), 3))
        outflow = np.empty_like(gradient)
        for part, distance in self._distances(points):
            value = self._fluence_of_balls(distance)
            fluence[part] = value.sum(axis=1)
            gradient[part] = self._along(points[part], self._slope_of_balls(distance, value))
            outflow[part] = self._along(points[part], self.powers / (4 * np.pi * distance**3))
        return fluence, gradient, outflow

    def _distances(self, points: Array) -> Iterator[tuple[slice, Array]]:
        """Slices of the points, each with the distances (n, K) [mm] of its points from the centres."""
        from scipy.spatial.distance import cdist

        step = max(1, PAIRS_AT_ONCE // len(self.centres))
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            yield part, cdist(points[part], self.centres)

    def _along(self, points: Array, weights: Array) -> Array:
        """Σ weight · (point - centre) over the spheres, shape (N, 3), for weights (N, K)."""
        return points * weights.sum(axis=1, keepdims=True) - weights @ self.centres

    def _fluence_of_balls(self, r: Array) -> Array:
        """φ [W/mm²] of each ball at the distances r (N, K) [mm] from its centre."""
        k, x = self.decay, self.decay * self.radii
        # 3 i₁(x)/x · exp(-kr) with the exponents together: each alone may leave double precision.
        inflation = 3 * _scaled_i1_over(x)
        with np.errstate(divide="ignore"):
            decay = np.exp(np.minimum(x - k * r, 0))
            value = self.powers * inflation / (4 * np.pi * self.diffusion) * decay / r
        inside, a, density = self._inside(r)
        if len(a):
            # 1 − (1 + ka) exp(−ka) i₀(kr) as two terms that are both small for small ka and kr.
            second = (1 + k * a) * _i0_minus_one(k * r[inside], k * a)
            value[inside] = density / (self.diffusion * k**2) * (_one_minus(k * a) - second)
        return value

    def _slope_of_balls(self, r: Array, fluence: Array) -> Array:
        """(dφ/dr)/r [W/mm⁴] of each ball at the distances r (N, K) [mm], where its φ is `fluence`."""
        k = self.decay
        slope = -fluence * (k + 1 / r) / r
        inside, a, density = self._inside(r)
        if len(a):
            own = k * r[inside]
            bessel = k * _scaled_i1_over(own) * np.exp(own - k * a)  # i₁(kr)/r · exp(-ka)
            slope[inside] = -density / (self.diffusion * k) * (1 + k * a) * bessel
        return slope

    def _inside(self, r: Array) -> tuple[NDArray[np.bool_], Array, Array]:
        """Mask (N, K) of the distances inside the ball, and for those the ball's radius [mm] and density [W/mm³]."""
        inside = r < self.radii
        ball = np.nonzero(inside)[1]
        return inside, self.radii[ball], self.powers[ball] / (4 / 3 * np.pi * self.radii[ball] ** 3)


@dataclass(frozen=True, eq=False)
class SourceField:
    """Components φ_i of the sources in one region, as if all tissue were of it: φ_i = Σ_k mixing_ik · field of mode k.

    region : number of the region;  modes : the fields, one for each decay constant;  mixing : (m, m), no unit
    diffusion : (m,) c of the region [mm]
    """

    region: int
    modes: tuple[FreeField, ...]
    mixing: Array
    diffusion: Array

    @classmethod
    def of(cls, equations: Equations, region: int, centres: Array, radii: Array, powers: Array) -> SourceField:
        """Field of spheres (K,) in a region, as `FreeField` takes them."""
        squares, vectors = equations.modes(region)
        modes = tuple(FreeField(centres, radii, powers, 1.0, float(square)) for square in squares)
        return cls(region, modes, vectors * (equations.source @ vectors), equations.diffusion[region])

    @property
    def centres(self) -> Array:
        """Centres of the spheres (K, 3) [mm]."""
        return self.modes[0].centres

    def components(self, points: Array, core: float = 0.0) -> Array:
        """φ_i [W/mm²] at `points` (N, 3) [mm], shape (m, N); `core` as in `FreeField.fluence`."""
        return self.mixing @ np.array([mode.fluence(points, core) for mode in self.modes])

    def with_gradient(self, points: Array) -> tuple[Array, Array, Array]:
        """φ_i (m, N) [W/mm²], ∇φ_i (m, N, 3) [W/mm³] and Σ P r/(4πr³) (N, 3) [W/mm²] at `points` (N, 3) [mm]."""
        fluence, gradient, outflow = zip(*(mode.with_gradient(points) for mode in self.modes), strict=True)
        return self.mixing @ np.array(fluence), np.tensordot(self.mixing, np.array(gradient), 1), outflow[0]


def _one_minus(x: Array) -> Array:
    """1 − (1 + x) exp(−x), accurate for small x."""
    return np.where(x < 1e-2, x**2 * (1 / 2 - x / 3 + x**2 / 8 - x**3 / 30), 1 - (1 + x) * np.exp(-x))


def _i0_minus_one(y: Array, x: Array) -> Array:
    """exp(−x) (i₀(y) − 1) = exp(−x) (sinh(y)/y − 1) for y <= x, accurate for small y, without overflow for large y."""
    large = (np.exp(y - x) - np.exp(-y - x)) / np.where(y > 0, 2 * y, 1) - np.exp(-x)
    return np.where(y < 1e-2, np.exp(-x) * y**2 / 6 * (1 + y**2 / 20), large)


def _scaled_i1_over(x: Array) -> Array:
    """exp(−x) i₁(x)/x, 1/3 at x = 0."""
    safe = np.where(x > 0.1, x, 1)
    large = ((safe - 1) + (safe + 1) * np.exp(-2 * safe)) / (2 * safe**3)
    small = np.exp(-x) / 3 * (1 + x**2 / 10 * (1 + x**2 / 28 * (1 + x**2 / 54)))
    return np.where(x > 0.1, large, small)
