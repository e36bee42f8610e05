"""`fspt_surface`: emitter on the phantom's surface with the surface flux density J_n [W/mm²]."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emission.emitting_surface import EmittingSurface
from ..emission.exitance import texture_of
from ..emission.laws import law_of
from ..jit.spectra import sample_wavelengths
from ..runtime.errors import ExitanceError


def _zero_if_invalid(*kinds: str) -> Callable[[Callable], Callable]:
    """Decorator of an emitter's method: for an invalid `surface` of another scene it returns zeros of types `kinds`."""

    def decorate(method: Callable) -> Callable:
        @wraps(method)
        def guarded(emitter: Any, *arguments: Any, **named: Any) -> Any:
            if emitter.surface.sound():
                return method(emitter, *arguments, **named)
            zeros = tuple(dr.zeros(getattr(mi, kind)) for kind in kinds)
            return zeros if len(zeros) > 1 else zeros[0]

        return guarded

    return decorate


class FsptSurface(mi.Emitter):
    r"""
    .. _emitter-fspt_surface:

    Emitting surface (:monosp:`fspt_surface`)
    -----------------------------------------

    .. pluginparameters::

     * - exitance
       - |float| or |texture| [W/mm²]
       - Surface flux density J_n >= 0, finite: a number, a mesh attribute, a raw bitmap.
         Updatable, differentiable under `fspt_integral`.
     * - emission
       - |string|
       - How the radiance depends on the direction: lambert (Default) | fresnel | last_flight.
     * - int_ior
       - |float|
       - Refractive index n >= 1 of the tissue relative to outside; not with lambert.
     * - mua, musp
       - |float| [1/mm]
       - Absorption µa >= 0 and reduced scattering µs' > 0; only with last_flight. A warning tells of a µs'
         above that of soft tissue, as of numbers in 1/cm.
     * - fluence
       - |volume|
       - Fluence Φ > 0 in the tissue, in any unit, a gridvolume around the shape; only with last_flight. Updatable.

    The radiance is 0 on the inward side, the side away from the geometric normal; on the outward side, with µ the
    cosine to the normal, ∫ L µ dΩ = J_n and

    - lambert (Eq. 1, the paper's): L = J_n/π [W/mm²/sr];
    - fresnel: L = J_n/(4π) · (2A + 3µ_i) · T(µ)/n², the diffusion approximation's radiance refracted at a smooth
      boundary; µ_i = √(1 − (1 − µ²)/n²), T the unpolarised Fresnel transmittance, A of Haskell et al. (1994). At
      n = 1.37 it is 1.11 × J_n/π along the normal and falls to 0 at the limb;
    - last_flight: L = C · T(µ)/n² · µs'/(4π) ∫₀^∞ Φ(r − s ω_i) exp(−(µa + µs') s) ds. The light was scattered for the
      last time on the refracted line of sight ω_i. The law includes the slope of the fluence along the surface and its
      curvature above a shallow source, which the other laws neglect. C(r) makes ∫ L µ dΩ = J_n(r). 'fspt flux solve
      --volume' writes the volume; it must be rotated along with the shape.

    Positions are sampled ∝ J_n, directions ∝ µ.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        if "exitance" not in props:
            raise ExitanceError("fspt_surface: 'exitance' is missing. Give J_n in W/mm² as a float or a texture.")
        if "to_world" in props:
            raise ExitanceError("fspt_surface: 'to_world' has no meaning, light comes from the shape. Give it to that.")
        own = weakref.ref(self)  # a reference would be a cycle
        self.surface = EmittingSurface(texture_of(props), law_of(props), lambda: own().get_shape())
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
        self.m_needs_sample_2 = self.m_needs_sample_3 = True

    def traverse(self, cb: mi.TraversalCallback) -> None:
        super().traverse(cb)
        cb.put("exitance", self.surface.exitance, mi.ParamFlags.Differentiable)
        self.surface.law.traverse(cb)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        if not keys or "parent" in keys:  # the shape itself changed
            self.surface.forget_shape()
        else:
            self.surface.forget_exitance()

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] towards `si.wi`, 0 on the inward side."""
        return mi.depolarizer(self.surface.radiance(si, si.to_world(si.wi), active))

    # ------------------------------------------------------------------ sampling

    @_zero_if_invalid("PositionSample3f", "Float")
    def sample_position(
        self, time: mi.Float, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.PositionSample3f, mi.Float]:
        """Surface point with density ∝ J_n [1/mm²]; the weight is 1/density."""
        si, pdf = self.surface.distribution().sample(sample, active)
        ps = mi.PositionSample3f(si)
        ps.n, ps.time, ps.pdf, ps.delta = si.n, time, pdf, False
        return ps, _rcp(pdf)

    @_zero_if_invalid("Float")
    def pdf_position(self, ps: mi.PositionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample_position` [1/mm²]."""
        return self.surface.distribution().pdf(self.surface.interaction_at(ps, active), active)

    @_zero_if_invalid("Ray3f", "Spectrum")
    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Ray from a point with density ∝ J_n in a direction with density ∝ cosθ; the weight is its power [W]."""
        si, pdf = self.surface.distribution().sample(sample2, active)
        si.wavelengths, weight = sample_wavelengths(sample1)
        direction = mi.Frame3f(si.n).to_world(mi.warp.square_to_cosine_hemisphere(sample3))
        si.time = time
        ray = si.spawn_ray(direction)
        power = self.surface.radiance(si, direction, active) * (dr.pi * _rcp(pdf))
        return ray, mi.depolarizer(power * weight)

    @_zero_if_invalid("DirectionSample3f", "Spectrum")
    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Direction from `it` to a surface point with density ∝ J_n; the weight is radiance over density [1/sr]."""
        si, pdf = self.surface.distribution().sample(sample, active)
        ds = mi.DirectionSample3f(mi.PositionSample3f(si))
        ds.n, ds.time, ds.emitter, ds.delta = si.n, it.time, mi.EmitterPtr(self), False
        ds.d = si.p - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        ds.pdf = _solid_angle(pdf, ds)
        active &= ds.pdf > 0
        si.wavelengths = it.wavelengths
        return ds, mi.depolarizer(self.surface.radiance(si, -ds.d, active) * _rcp(ds.pdf))

    @_zero_if_invalid("Float")
    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample_direction` [1/sr]."""
        pdf = self.surface.distribution().pdf(self.surface.interaction_at(ds, active), active)
        return dr.select(active, _solid_angle(pdf, ds), 0)

    @_zero_if_invalid("Spectrum")
    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] that arrives at `it` from the surface point of `ds`."""
        si = self.surface.interaction_at(ds, active)
        si.wavelengths = it.wavelengths
        return mi.depolarizer(self.surface.radiance(si, -ds.d, active))

    @_zero_if_invalid("Wavelength", "Spectrum")
    def sample_wavelengths(
        self, si: mi.SurfaceInteraction3f, sample: mi.Float, active: mi.Bool = True
    ) -> tuple[mi.Wavelength, mi.Spectrum]:
        """Wavelengths, and the radiance at `si` over their density; light tracers obtain the radiance here.

        `si.wi` is in world coordinates: Mitsuba's `ptracer`, the only caller, sets it without `to_local`.
        """
        ps = mi.PositionSample3f(si)
        ps.n = si.n
        wavelengths, weight = sample_wavelengths(sample)
        here = self.surface.interaction_at(ps, active)
        here.wavelengths = wavelengths
        return wavelengths, mi.depolarizer(self.surface.radiance(here, si.wi, active) * weight)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return self.surface.shape.bbox()

    def to_string(self) -> str:
        return f"FsptSurface[\n  exitance = {self.surface.exitance},\n  emission = {self.surface.law}\n]"


def _solid_angle(pdf: mi.Float, ds: mi.DirectionSample3f) -> mi.Float:
    """Density per solid angle [1/sr] from density per area [1/mm²]; 0 on the inward side."""
    cos_theta = -dr.dot(ds.d, ds.n)
    return dr.select(cos_theta > 0, pdf * dr.square(ds.dist) / cos_theta, 0)


def _rcp(pdf: mi.Float) -> mi.Float:
    """1/pdf; 0 for pdf = 0."""
    return dr.select(pdf > 0, dr.rcp(pdf), 0)


mi.register_emitter("fspt_surface", FsptSurface)
