"""Laws of emission: how the exit radiance L(r, ω) of a point shares its exitance J_n out over the outward hemisphere.

A law's `profile` is L/J_n [1/sr], with ∫ L cosθ dΩ = J_n. Laws do not look at which side a direction is on.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ..optics.boundary import haskell_a
from ..optics.media import Medium
from ..runtime.errors import ExitanceError, FluxError
from ..runtime.numbers import number
from .last_flight import LastFlight

LAWS = ("lambert", "fresnel", "last_flight")


class Law(Protocol):
    """What `fspt_surface` asks of a law of emission."""

    def prepare(self, shape: mi.Shape) -> None:
        """Look at the surface once before the first `profile`; ExitanceError where the law does not fit it."""

    def renewed(self) -> bool:
        """True where what the law follows has changed since, so that it is to be prepared again."""

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """L/J_n [1/sr] at the surface point `si` towards the outward unit vector `direction` of the world."""


class Lambert:
    """The same radiance in all directions, L = J_n/π (Eq. 1)."""

    def prepare(self, shape: mi.Shape) -> None:
        pass

    def renewed(self) -> bool:
        return False

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return mi.Float(dr.inv_pi)

    def __str__(self) -> str:
        return "lambert"


class Fresnel:
    """Diffuse light that leaves a smooth border of relative index n >= 1, to first order in the angle.

    L(µ) = J_n/(4π) · (2A + 3µ_i) · T(µ)/n²,  µ_i = √(1 − (1 − µ²)/n²): inside, the radiance of diffusion is
    φ/(4π) + 3J_n µ_i/(4π) with φ = 2A J_n; crossing the border, a share T (unpolarised) of it passes and its solid
    angle grows n²-fold. A is Haskell's, the one with which the power that leaves is J_n.

    Raises
    ------
    ExitanceError : n is below 1 or not finite.
    """

    def __init__(self, n: float) -> None:
        try:
            a = haskell_a(n)
        except FluxError as error:
            raise ExitanceError(
                f"fspt_surface: 'int_ior' must be >= 1 and finite, got {n:g}. Give the tissue's refractive index "
                "relative to the medium around it, for example 1.37."
            ) from error
        self.n = n
        self._n, self._a = dr.opaque(mi.Float, n), dr.opaque(mi.Float, a)

    def prepare(self, shape: mi.Shape) -> None:
        pass

    def renewed(self) -> bool:
        return False

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        # Transmittance is the same both ways: the border is looked through from outside.
        reflectance, cos_inner, _, _ = mi.fresnel(dr.dot(si.n, direction), self._n)
        inside = 2 * self._a + 3 * dr.abs(cos_inner)
        return inside * (1 - reflectance) / (4 * dr.pi * dr.square(self._n))

    def __str__(self) -> str:
        return f"fresnel, int_ior = {self.n:g}"


def law_of(props: mi.Properties) -> Law:
    """The law that a plugin's `emission` and its parameters name.

    Raises
    ------
    ExitanceError, FluxError : there is no such law, or a parameter is missing or out of its range.
    """
    name = str(props.get("emission", "lambert"))
    if name == "lambert":
        return Lambert()
    if name not in LAWS:
        raise ExitanceError(f"fspt_surface: 'emission' must be one of {', '.join(LAWS)}, got '{name}'.")
    n = _number(props, name, "int_ior", "a float", "1.37")
    if name == "fresnel":
        return Fresnel(n)
    mua, musp = (
        _number(props, name, key, "a float [1/mm]", example) for key, example in (("mua", "0.01"), ("musp", "1"))
    )
    fluence = _required(props, name, "fluence", "a volume, such as a gridvolume")
    if not isinstance(fluence, mi.Volume):
        raise ExitanceError(f"fspt_surface: 'fluence' must be a volume, got {fluence!r}. Give a gridvolume.")
    return LastFlight(Medium(mua, musp, n), fluence)


def _number(props: mi.Properties, law: str, name: str, kind: str, example: str) -> float:
    return number(f"fspt_surface: '{name}'", _required(props, law, name, kind), ExitanceError, example)


def _required(props: mi.Properties, law: str, name: str, kind: str) -> Any:
    """The parameter `name`, which the law cannot do without."""
    if name not in props:
        raise ExitanceError(f"fspt_surface: emission '{law}' needs '{name}'. Give it as {kind}.")
    return props[name]
