"""Last-flight law: the exit radiance follows from where inside the tissue the light was scattered for the last time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.from_numpy import from_numpy
from ...jit.loops import repeat
from ...optics.media import Medium, scattering_warning
from ...runtime.errors import ExitanceError
from ..elements import elements_of
from . import ExitLaw, refractive_index, required, required_number

LOG = logging.getLogger("mitsuba_fspt")
NODES = 8  # of the quadrature along the line of sight inside the tissue
RINGS, SPOKES = 8, 8  # of the quadrature over the hemisphere, which normalises the law to J_n


class LastFlight(ExitLaw):
    r"""Radiance of light scattered for the last time on the refracted line of sight ω_i inside the tissue (Eq. M.16).

    L(r, ω) ∝ T/n² · µs'/(4π) ∫₀^∞ Φ(r − s ω_i) exp(−(µa + µs') s) ds by Gauss–Laguerre, with a factor that makes
    ∫ L µ dΩ = J_n at every point r. Φ, the `fluence`, is a volume in world coordinates; only its relative values
    matter, not its unit. The rate of scattering is µs' Φ; scattering is taken as isotropic. Where the line leaves the
    tissue again, the values of the volume there are used.

    Raises
    ------
    FluxError : a number of the medium is out of its range.
    """

    linear: ClassVar[bool] = False

    def __init__(self, medium: Medium, fluence: mi.Volume) -> None:
        self.medium, self.fluence = medium, fluence
        self._n = dr.opaque(mi.Float, medium.n)
        flight, weight = np.polynomial.laguerre.laggauss(NODES)
        self._flight = from_numpy(mi.Float, flight / (medium.mua + medium.musp))
        self._weight = from_numpy(mi.Float, weight)
        self._hemisphere = _hemisphere()
        self._total: _Table | None = None  # ∫ of `_relative_radiance` times µ over the hemisphere
        self._values: mi.Float | None = None  # grid values of the volume at the time of `prepare`

    @classmethod
    def of(cls, props: mi.Properties) -> LastFlight:
        """Law with the medium of `mua`, `musp` and `int_ior`, and the volume `fluence`.

        A line on stderr tells of a scattering that no soft tissue has, as of numbers in 1/cm.
        """
        n = refractive_index(props)
        mua, musp = (
            required_number(props, name, "a float [1/mm]", example)
            for name, example in (("mua", "0.01"), ("musp", "1"))
        )
        fluence = required(props, "fluence", "a volume, such as a gridvolume")
        if not isinstance(fluence, mi.Volume):
            raise ExitanceError(f"fspt_surface: 'fluence' must be a volume, got {fluence!r}. Give a gridvolume.")
        medium = Medium(mua, musp, n)
        if warning := scattering_warning([medium]):
            LOG.warning("fspt: fspt_surface: %s", warning)
        return cls(medium, fluence)

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the volume `fluence`."""
        cb.put("fluence", self.fluence, mi.ParamFlags.NonDifferentiable)

    def prepare(self, shape: mi.Shape) -> None:
        """Tabulate the hemisphere integral of the relative radiance on the surface.

        Raises
        ------
        ExitanceError : the volume does not contain the shape, or Φ gives an integral <= 0 or not finite.
        """
        inside, outside = shape.bbox(), self.fluence.bbox()
        if not (outside.contains(inside.min) and outside.contains(inside.max)):
            raise ExitanceError(
                f"fspt_surface: the volume 'fluence', {_extent(outside)}, does not hold shape '{shape.id()}', "
                f"{_extent(inside)}. Set its 'use_grid_bbox' or 'to_world'."
            )
        self._total, self._values = _Table(shape, self._hemisphere_integral), _values_of(self.fluence)
        if not self._total.positive():
            raise ExitanceError(
                f"fspt_surface: the volume 'fluence' has values <= 0 or not finite under shape '{shape.id()}'. Write "
                "it with 'fspt flux solve --volume'."
            )

    def renewed(self) -> bool:
        """True if the volume has other values than in `prepare`."""
        return self._values is not None and self._values.index != _values_of(self.fluence).index

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Relative radiance towards `direction` over its hemisphere integral [1/sr]."""
        return self._relative_radiance(si, direction, active) / self._total(si)

    def _relative_radiance(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """T · Σ wₖ Φ(r − sₖ ω_i): radiance towards an outward unit vector, up to a factor."""
        mu = dr.dot(si.n, direction)
        reflectance, cos_inner, _, _ = mi.fresnel(mu, self._n)
        inside = (direction - mu * si.n) / self._n + dr.abs(cos_inner) * si.n

        def node(k: mi.UInt32, total: mi.Float) -> tuple[mi.Float]:
            at = dr.zeros(mi.Interaction3f)
            at.p = si.p - dr.gather(mi.Float, self._flight, k) * inside
            return (total + dr.gather(mi.Float, self._weight, k) * self.fluence.eval_1(at, active),)

        (total,) = repeat(NODES, node, mi.Float(0))
        return (1 - reflectance) * total

    def _hemisphere_integral(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """∫ of `_relative_radiance` times µ over the outward hemisphere."""
        frame = mi.Frame3f(si.n)

        def add(k: mi.UInt32, total: mi.Float) -> tuple[mi.Float]:
            x, y, z, weight = (dr.gather(mi.Float, column, k) for column in self._hemisphere)
            direction = frame.to_world(mi.Vector3f(x, y, z))
            return (total + weight * self._relative_radiance(si, direction, mi.Bool(True)),)

        return repeat(RINGS * SPOKES, add, mi.Float(0))[0]

    def __str__(self) -> str:
        m = self.medium
        return f"last_flight, mua = {m.mua:g}, musp = {m.musp:g}, int_ior = {m.n:g}"


class _Table:
    """Function on a surface, tabulated at the corners of its elements and interpolated between them."""

    def __init__(self, shape: mi.Shape, function: Callable[[mi.SurfaceInteraction3f], mi.Float]) -> None:
        self._elements = elements_of(shape, minimum=1 << 14)
        index = dr.arange(mi.UInt32, self._elements.count)
        corners = (self._elements.place(index, mi.Point2f(*corner))[0] for corner in self._elements.corners)
        self._values = [function(si) for si in corners]
        dr.eval(self._values)

    def positive(self) -> bool:
        """True if all values are > 0 and finite."""
        return all(dr.all((value > 0) & dr.isfinite(value)) for value in self._values)

    def __call__(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        index, weights = self._elements.weigh(si)
        return sum(w * dr.gather(mi.Float, value, index) for w, value in zip(weights, self._values, strict=True))


def _values_of(volume: mi.Volume) -> mi.Float:
    """Grid values of a volume, which an update of the volume changes; empty if it has no grid."""
    parameters = mi.traverse(volume)
    return mi.Float(parameters["data"].array) if "data" in parameters else mi.Float()


def _hemisphere() -> tuple[mi.Float, ...]:
    """Unit vectors (x, y, z) about +z and weights such that Σ w f is ∫ f µ dΩ.

    The directions form rings at µ = x² with Gauss nodes x: the transmittance is steep at grazing exit, where these
    rings are dense. Each ring is rotated relative to the next.
    """
    x, weight = np.polynomial.legendre.leggauss(RINGS)
    x, weight = (x + 1) / 2, weight / 2
    mu, ring = x**2, 2 * np.pi / SPOKES * x**2 * 2 * x * weight
    azimuth = 2 * np.pi * (np.arange(SPOKES) + np.arange(RINGS)[:, None] / RINGS) / SPOKES
    sine = np.sqrt(1 - mu**2)[:, None]
    columns = (sine * np.cos(azimuth), sine * np.sin(azimuth), mu[:, None], ring[:, None])
    return tuple(from_numpy(mi.Float, np.broadcast_to(column, azimuth.shape)) for column in columns)


def _extent(box: mi.BoundingBox3f) -> str:
    """Corners of a box as text for messages."""
    low, high = ([float(c) for c in corner] for corner in (box.min, box.max))
    return "from ({:g}, {:g}, {:g}) to ({:g}, {:g}, {:g}) mm".format(*low, *high)
