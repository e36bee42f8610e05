"""Exitance of a homogeneous cylinder with a small light source inside: diffusion equation, solved exactly.

-D ∇²φ + µa φ = q inside, φ + 2 A D ∂φ/∂n = 0 on the surface, J_n = φ/(2A): a closed cylinder is a box in its
own coordinates, so that its modes are products of an axial, an angular and a radial function which all meet
the boundary condition exactly. On the side the radial factor is summed in closed form, on the caps the axial
one; both series then fall off exponentially with the distance between source and surface. No mesh, no image
sources, no extrapolated boundary. NumPy has no Bessel functions but I_0; ratios of I_m and K_m come from
their recurrences.

Lengths in mm, powers in W, per watt of source.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_fspt.optics.boundary import robin_a

Array = NDArray[np.floating[Any]]

# What is left out falls as exp(-wave number · depth of the source) and (source_x / radius)^order: 1e-13 of
# the peak for the default phantom, source 7 mm below the side.
AXIAL_MODES = 64
ANGULAR_ORDERS = 56


@dataclass(frozen=True)
class Phantom:
    """Homogeneous cylinder about the z axis, centred at the origin, a uniform sphere of light at (x, 0, z).

    `radius`, `height`, `source_x` (0 <= source_x < radius), `source_z`, `source_diameter` [mm]; `mua`, `musp`
    [1/mm]; `index` of the tissue relative to air, no unit.
    """

    radius: float = 15.0
    height: float = 30.0
    mua: float = 0.0138
    musp: float = 0.91
    index: float = 1.37
    source_x: float = 8.0
    source_z: float = -1.0
    source_diameter: float = 1.0

    @property
    def diffusion(self) -> float:
        """D = 1/(3 (µa + µs')) [mm]."""
        return 1 / (3 * (self.mua + self.musp))

    @property
    def decay(self) -> float:
        """Effective attenuation √(µa/D) [1/mm]."""
        return float(np.sqrt(self.mua / self.diffusion))

    @property
    def slope(self) -> float:
        """h = 1/(2AD) [1/mm] of the boundary condition ∂φ/∂n = -h φ, A after `robin_a`; J_n = D h φ."""
        return 1 / (2 * robin_a(self.index) * self.diffusion)

    @property
    def ball(self) -> float:
        """φ outside a uniform sphere over φ of a point in its centre (mean value property), no unit, >= 1."""
        x = self.decay * self.source_diameter / 2
        return 1.0 if x == 0 else float(3 * (x * np.cosh(x) - np.sinh(x)) / x**3)


def exitance(phantom: Phantom, vertices: Array) -> Array:
    """J_n (V,) [1/mm²] per unit source power at points of the cylinder's surface, `vertices` (V, 3) [mm].

    Points on a rim belong to the side. The series are cut at 1e-13 of the peak for the default phantom.
    """
    x, y, z = np.asarray(vertices, dtype=np.float64).T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    side = radius > phantom.radius * (1 - 1e-6)
    result = np.empty(len(x))
    result[side] = _side(phantom, angle[side], z[side])
    for sign in (1, -1):
        cap = ~side & (np.sign(z) == sign)
        result[cap] = _cap(phantom, radius[cap], angle[cap], sign * phantom.source_z)
    return result * phantom.ball


def _side(phantom: Phantom, angle: Array, z: Array) -> Array:
    """J_n at r = R: Σ_mn of axial mode × cos(mθ) × I_m(κ r0) / (I_m' + h I_m)(κR)."""
    wave, profile = _axial_modes(phantom)
    kappa = np.hypot(wave, phantom.decay)[:, None]
    radial = _bessel_i(kappa * phantom.source_x, kappa * phantom.radius)
    radial /= _log_derivative(kappa, phantom.radius) + phantom.slope
    weight = profile(phantom.source_z)[:, None] * radial
    series = (profile(z) @ weight) * _angular(angle)
    return phantom.slope / phantom.radius * series.sum(1)


def _cap(phantom: Phantom, radius: Array, angle: Array, source_z: float) -> Array:
    """J_n at z = +H/2: that of a slab without side wall, minus what the wall takes from each of its modes."""
    distance = np.sqrt(radius**2 + phantom.source_x**2 - 2 * radius * phantom.source_x * np.cos(angle))
    # The wall's part needs Bessel functions at every radius; a structured mesh has few of them.
    rings, ring = np.unique(np.round(radius, 9), return_inverse=True)
    wave, profile = _axial_modes(phantom)
    kappa = np.hypot(wave, phantom.decay)
    rim = kappa[:, None] * phantom.radius
    order = np.arange(ANGULAR_ORDERS)
    ratio_i, ratio_k = _ratio_i(rim), _ratio_k(rim)
    reflection = (kappa[:, None] * (order / rim - ratio_k) + phantom.slope) / (
        kappa[:, None] * (order / rim + ratio_i) + phantom.slope
    )
    reflection /= rim * (ratio_i + ratio_k)  # I_m K_m at the rim, from their Wronskian
    weight = (profile(source_z) * profile(phantom.height / 2))[:, None] * reflection
    weight *= _bessel_i(kappa[:, None] * phantom.source_x, rim)
    inside = _bessel_i(kappa[:, None] * rings[:, None, None], rim)
    wall = np.einsum("nm,rnm->rm", weight, inside)[ring] * _angular(angle)
    return phantom.slope * (_slab(phantom, distance, source_z) - wall.sum(1))


def _slab(phantom: Phantom, distance: Array, source_z: float) -> Array:
    """D φ at the top of an infinite slab, `distance` beside a point source: ∫ k J_0(kd) g(k) dk / 2π."""
    depth = phantom.height / 2 - source_z
    k, weight = np.polynomial.legendre.leggauss(80)
    k, weight = (k + 1) / 2 * 40 / depth, weight / 2 * 40 / depth
    q, h = np.hypot(k, phantom.decay), phantom.slope
    below, full = phantom.height / 2 + source_z, phantom.height
    source = (1 + h / q) + (1 - h / q) * np.exp(-2 * q * below)
    top = (q + h) * (1 + h / q) - (q - h) * (1 - h / q) * np.exp(-2 * q * full)
    spectrum = weight * k * source / top * np.exp(-q * depth)
    # J_0(x) is the mean of cos(x sin t) over a quarter turn; the midpoint rule is exact here for x < 100.
    turn = (np.arange(40) + 0.5) * np.pi / 80
    total = np.zeros_like(distance)
    for t in turn:
        total += np.cos(np.outer(distance, k * np.sin(t))) @ spectrum
    return total / len(turn) / (2 * np.pi)


def _axial_modes(phantom: Phantom) -> tuple[Array, Callable[[Array | float], Array]]:
    """Wave numbers µ_n (N,) [1/mm]; function from z (...) to modes cos(µ_n z - nπ/2) of norm 1 (..., N)."""
    shift, h, height = np.arange(AXIAL_MODES) * np.pi, phantom.slope, phantom.height
    wave = (shift + np.pi / 2) / height
    for _ in range(60):  # µ_n H = nπ + 2 atan(h/µ_n), from both ends; each step contracts
        wave = (shift + 2 * np.arctan2(h, wave)) / height
    norm = np.sqrt(height / 2 + np.cos(shift) * np.sin(wave * height) / (2 * wave))
    return wave, lambda z: np.cos(np.multiply.outer(z, wave) - shift / 2) / norm


def _angular(angle: Array) -> Array:
    """ε_m cos(mθ) / 2π, shape (V, M), ε_0 = 1, else 2."""
    epsilon = np.where(np.arange(ANGULAR_ORDERS) == 0, 1, 2)
    return epsilon * np.cos(np.outer(angle, np.arange(ANGULAR_ORDERS))) / (2 * np.pi)


def _bessel_i(inner: Array, outer: Array) -> Array:
    """I_m(inner) / I_m(outer) for all orders m, shape (..., M), from arguments of shape (..., 1)."""
    steps = _ratio_i(inner)[..., :-1] / _ratio_i(outer)[..., :-1]
    ratio = np.cumprod(np.concatenate([np.ones_like(steps[..., :1]), steps], -1), -1)
    return np.i0(inner) / np.i0(outer) * ratio


def _log_derivative(kappa: Array, radius: float) -> Array:
    """d/dr ln I_m(κ r) at r = `radius`, shape (..., M) [1/mm]."""
    return kappa * (_ratio_i(kappa * radius) + np.arange(ANGULAR_ORDERS) / (kappa * radius))


def _ratio_i(x: Array) -> Array:
    """I_{m+1}(x) / I_m(x), shape (..., M), by the backward recurrence, which forgets its start."""
    ratio, orders = np.zeros_like(x), []
    for m in range(ANGULAR_ORDERS + 200, -1, -1):
        ratio = x / (2 * (m + 1) + x * ratio)
        orders.append(ratio)
    return np.concatenate(orders[: -ANGULAR_ORDERS - 1 : -1], -1)


def _ratio_k(x: Array) -> Array:
    """K_{m+1}(x) / K_m(x), shape (..., M), by the forward recurrence, for x > 1."""
    cosh = np.cosh(np.linspace(0, 5, 201))  # K_ν(x) = ∫ exp(-x cosh t) cosh(νt) dt, trapezoidal rule
    kernel = np.exp(-x * (cosh - 1)) * np.where(cosh == 1, 0.5, 1)
    ratio = (kernel @ cosh / kernel.sum(-1))[..., None]
    orders = [ratio]
    for m in range(1, ANGULAR_ORDERS):
        ratio = 2 * m / x + 1 / ratio
        orders.append(ratio)
    return np.concatenate(orders, -1)
