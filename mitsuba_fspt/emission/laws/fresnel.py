"""Fresnel law: diffuse light refracted at the smooth boundary of the tissue."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...optics.boundary import LARGEST_INDEX, haskell_a
from ...runtime.errors import ExitanceError, FluxError
from . import ExitLaw, refractive_index


class Fresnel(ExitLaw):
    """Diffuse light that leaves a smooth boundary of relative index n >= 1 (Eq. M.15 of docs/model.md).

    L(µ) = J_n/(4π) · (2A + 3µ_i) · T(µ)/n²,  µ_i = √(1 − (1 − µ²)/n²): inside, the radiance of the diffusion
    approximation is φ/(4π) + 3J_n µ_i/(4π) with φ = 2A J_n; at the boundary, a share T (unpolarised) is transmitted and
    the solid angle grows n²-fold. A is Haskell's, with which the exitance is J_n.

    Raises
    ------
    ExitanceError : n is below 1, above 100 or not finite.
    """

    def __init__(self, n: float) -> None:
        try:
            a = haskell_a(n)
        except FluxError as error:
            raise ExitanceError(
                f"fspt_surface: 'int_ior' must be >= 1 and at most {LARGEST_INDEX}, got {n:g}. Give the tissue's "
                "refractive index relative to the medium around it, for example 1.37."
            ) from error
        self.n = n
        self._n, self._a = dr.opaque(mi.Float, n), dr.opaque(mi.Float, a)

    @classmethod
    def of(cls, props: mi.Properties) -> Fresnel:
        """Law with n from `int_ior`."""
        return cls(refractive_index(props))

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """(2A + 3µ_i)/(4π) · T(µ)/n² [1/sr]."""
        # The transmittance is equal in both directions, so it is computed for light from outside.
        reflectance, cos_inner, _, _ = mi.fresnel(dr.dot(si.n, direction), self._n)
        inside = 2 * self._a + 3 * dr.abs(cos_inner)
        return inside * (1 - reflectance) / (4 * dr.pi * dr.square(self._n))

    def __str__(self) -> str:
        return f"fresnel, int_ior = {self.n:g}"
