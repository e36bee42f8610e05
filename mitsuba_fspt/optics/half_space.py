"""Light at the border of scattering tissue by the transport equation, for the boundary condition of SP3 (Eq. M.48).

A half space, in which light varies as exp(ikx) along the border; lengths in mean free paths 1/(µa + µs'). `border` is
of tissue without absorption, `absorbing_border` has what absorption changes. Discrete ordinates in the polar cosine,
modes cos(mφ) of the azimuth, phase function of Henyey and Greenstein. Two of the solutions, the diffusing light, vary
as exp(±κz); the others decay within a mean free path. On the border the diffusing light has the extrapolation length
z(k), φ = z ∂φ/∂z, and a flux; the flux that leaves is another one for k > 0, since the light that does not diffuse
flows along the border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, lpmv

from .hemisphere import hemisphere

Array = NDArray[np.float64]
NODES = 10  # of Gauss' rules below and above the critical angle
AZIMUTH = 5  # largest m
DEGREES = 16  # of the phase function; what it has beyond counts as not scattered
SMALL = 0.05  # k for z(0), by extrapolation from it and twice of it
TYPICAL = 0.6  # k of δ: J_n above a source three mean free paths deep has k up to about 0.7
LOW, HIGH = 0.35, 0.75  # k of a and b


@dataclass(frozen=True)
class Border:
    """Numbers of the border of tissue, in mean free paths.

    length : z(0);  lateral : δ, 1/z(k) = 1/z(0) + δ k²/z(0)²
    flow, spread : a, b >= 0, the flux that leaves is that of the diffusing light times 1 - a k²/(1 + b k²)
    """

    length: float
    lateral: float
    flow: float
    spread: float


@cache
def border(n: float, g: float) -> Border:
    """Numbers of the border of tissue of the relative index n >= 1 and the anisotropy g."""
    near, far = (diffusing(n, g, k)[0] for k in (SMALL, 2 * SMALL))
    length = 3 / (4 / near - 1 / far)
    lateral = (1 / diffusing(n, g, TYPICAL)[0] - 1 / length) * (length / TYPICAL) ** 2
    low, high = (1 - diffusing(n, g, k)[1] for k in (LOW, HIGH))
    if not 1e-3 < low < high:  # n of about 1, where less than 1 % flows along the border
        return Border(length, lateral, 0.0, 0.0)
    spread = max((low / LOW**2 - high / HIGH**2) / (high - low), 0.0)
    return Border(length, lateral, low / LOW**2 + spread * low, spread)


@dataclass(frozen=True)
class Light:
    """The diffusing light exp(±κz) of a half space, of the fluence 1 on its way to the border.

    rate : κ;  back : fluence of what the border reflects;  flux : that leaves;  own : of the diffusing light there
    """

    rate: float
    back: float
    flux: float
    own: float


def diffusing(n: float, g: float, k: float) -> tuple[float, float]:
    """z(k), and the flux that leaves over that of the diffusing light."""
    light = half_space(n, g, k)
    return (1 + light.back) / (light.rate * (1 - light.back)), light.flux / light.own


@cache
def half_space(n: float, g: float, k: float, absorption: float = 0.0) -> Light:
    """Diffusing light at the border, lengths in 1/(µa + µs') where µa/µs' is `absorption`; k > 0 without it."""
    cosine, weight, reflectance = hemisphere(n, NODES)
    both, weights, count = np.concatenate([cosine, -cosine]), np.tile(weight, 2), len(cosine)
    matrix = operator(both, weights, g, k * (1 + absorption))
    matrix = (matrix + absorption * np.eye(len(matrix))) / (1 + absorption)
    rates, modes = np.linalg.eig(-matrix / np.tile(both, AZIMUTH + 1)[:, None])
    order = np.argsort(np.abs(rates))
    falls, rises = sorted(order[:2], key=lambda one: rates[one].real)
    modes = modes / np.where(np.isin(np.arange(len(rates)), [falls, rises]), weights @ modes[: 2 * count], 1.0)
    decays = [falls, *(one for one in order[2:] if rates[one].real < 0)]
    inward = np.concatenate([np.arange(count) + 2 * count * m for m in range(AZIMUTH + 1)])
    # Radiance that enters is what Fresnel's reflectance leaves of that towards the border, in each mode of the azimuth.
    enters = modes[inward] - np.tile(reflectance, AZIMUTH + 1)[:, None] * modes[inward + count]
    amplitude = np.linalg.lstsq(enters[:, decays], -enters[:, rises], rcond=None)[0]
    back = float(amplitude[0].real)
    outflow = (weights * both) @ modes[: 2 * count]
    flux = -(outflow[rises] + outflow[decays] @ amplitude).real
    own = -(outflow[rises] + back * outflow[falls]).real
    return Light(float(rates[rises].real), back, float(flux), float(own))


def operator(cosine: Array, weight: Array, g: float, k: float) -> Array:
    """Extinction, scattering and flow along the border, of all modes of the azimuth: -µ ∂/∂z of the radiance.

    With (-i)^m times mode m all is real. What the phase function has beyond its last degree is no scattering.
    """
    size, sine = len(cosine), np.sqrt(1 - cosine**2)
    beyond = g ** (DEGREES + 1)
    total = (1 - beyond) / (1 - g)
    result = np.zeros(((AZIMUTH + 1) * size,) * 2)
    for m in range(AZIMUTH + 1):
        own = slice(m * size, (m + 1) * size)
        legendre = _legendre(m, cosine)
        moments = (g ** np.arange(m, DEGREES + 1, dtype=float) - beyond) / (1 - beyond)
        block = total * (np.eye(size) - (legendre.T * moments) @ legendre * weight)
        if m == 0:
            block -= np.diag(block.sum(axis=1))  # the nodes' rule is not exact: no absorption all the same
        result[own, own] = block
        if m < AZIMUTH:
            result[own, (m + 1) * size : (m + 2) * size] = np.diag(k / 2 * sine)
        if m > 0:
            result[own, (m - 1) * size : m * size] = np.diag(-(k if m == 1 else k / 2) * sine)
    return result


def _legendre(m: int, cosine: Array) -> Array:
    """Associated Legendre polynomials of the degrees m … DEGREES, ∫ P² dµ = 1, (degrees, nodes)."""
    degrees = range(m, DEGREES + 1)
    scale = [math.exp((math.log(i + 0.5) + gammaln(i - m + 1) - gammaln(i + m + 1)) / 2) for i in degrees]
    return np.array([factor * lpmv(m, degree, cosine) for factor, degree in zip(scale, degrees, strict=True)])
