"""`fspt_surface`: emitter on the phantom's surface with the surface flux density J_n [W/mm²]."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emission import exitance
from ..emission.elements import ElementDistribution, elements_of
from ..emission.face_probe import Probe
from ..emission.laws import law_of
from ..jit.recording import evaluated_outside, scene_is_checked, zero_if_invalid
from ..jit.spectra import sample_wavelengths
from ..runtime.errors import ExitanceError


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
       - Absorption µa >= 0 and reduced scattering µs' > 0; only with last_flight.
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
        self.exitance = exitance.texture_of(props)
        self.law = law_of(props)
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
        self.m_needs_sample_2 = self.m_needs_sample_3 = True
        self._positions: ElementDistribution | None = None
        self._probe: Probe | None = None
        self._source: exitance.ExitanceState | None = None  # data of J_n at the last `check`
        self.single_faces: tuple[mi.Float, ...] = ()  # buffers of the mesh for which no face was found twice
        self.winding: tuple[Any, ...] = ()  # what `integral.mesh_faults` found, with the buffers of that mesh
        self.brightest = 0.0  # largest J_n [W/mm²], set by `check`
        # For caches: `mark` identifies this emitter, `edition` counts the changes of J_n. A cache must not hold the
        # emitter itself: Dr.Jit would record it even after its shape has been deleted.
        self.mark, self.edition = object(), 0
        self._shape: mi.ShapePtr | None = None

    def traverse(self, cb: mi.TraversalCallback) -> None:
        super().traverse(cb)
        cb.put("exitance", self.exitance, mi.ParamFlags.Differentiable)
        self.law.traverse(cb)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        if not keys or "parent" in keys:  # the shape itself changed
            self._probe = None
        self._forget_exitance()

    def _forget_exitance(self) -> None:
        """Discard all results that depend on J_n."""
        self._positions = self._source = None
        self.edition += 1

    @contextmanager
    def shining(self, value: float) -> Iterator[None]:
        """Context manager: within the block J_n is `value` [W/mm²] everywhere."""
        own, self.exitance = self.exitance, exitance.uniform(value)
        self._forget_exitance()
        try:
            yield
        finally:
            self.exitance = own
            self._forget_exitance()

    # ------------------------------------------------------------------ radiance

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] towards `si.wi`, 0 on the inward side."""
        return mi.depolarizer(self._radiance(si, si.to_world(si.wi), active))

    def _radiance(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Radiance [W/mm²/sr] towards a unit vector in world coordinates, 0 on the inward side."""
        if not self.sound():
            return mi.UnpolarizedSpectrum(0)
        outward = active & (dr.dot(si.n, direction) > 0)
        radiance = self.exitance.eval(si, outward) * self.law.profile(si, direction, outward)
        # On a sliver, where interpolation in single precision fails, J_n is NaN.
        # `select` returns a plain array, of which Mitsuba's depolarizer would take the first wavelength only.
        return mi.UnpolarizedSpectrum(dr.select(outward & dr.isfinite(radiance), radiance, 0))

    # ------------------------------------------------------------------ sampling

    @zero_if_invalid("PositionSample3f", "Float")
    def sample_position(
        self, time: mi.Float, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.PositionSample3f, mi.Float]:
        """Surface point with density ∝ J_n [1/mm²]; the weight is 1/density."""
        si, pdf = self._distribution().sample(sample, active)
        ps = mi.PositionSample3f(si)
        ps.n, ps.time, ps.pdf, ps.delta = si.n, time, pdf, False
        return ps, _rcp(pdf)

    @zero_if_invalid("Float")
    def pdf_position(self, ps: mi.PositionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample_position` [1/mm²]."""
        return self._distribution().pdf(self._surface_at(ps, active), active)

    @zero_if_invalid("Ray3f", "Spectrum")
    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Ray from a point with density ∝ J_n in a direction with density ∝ cosθ; the weight is its power [W]."""
        si, pdf = self._distribution().sample(sample2, active)
        si.wavelengths, weight = sample_wavelengths(sample1)
        direction = mi.Frame3f(si.n).to_world(mi.warp.square_to_cosine_hemisphere(sample3))
        si.time = time
        ray = si.spawn_ray(direction)
        power = self._radiance(si, direction, active) * (dr.pi * _rcp(pdf))
        return ray, mi.depolarizer(power * weight)

    @zero_if_invalid("DirectionSample3f", "Spectrum")
    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Direction from `it` to a surface point with density ∝ J_n; the weight is radiance over density [1/sr]."""
        si, pdf = self._distribution().sample(sample, active)
        ds = mi.DirectionSample3f(mi.PositionSample3f(si))
        ds.n, ds.time, ds.emitter, ds.delta = si.n, it.time, mi.EmitterPtr(self), False
        ds.d = si.p - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        ds.pdf = _solid_angle(pdf, ds)
        active &= ds.pdf > 0
        si.wavelengths = it.wavelengths
        return ds, mi.depolarizer(self._radiance(si, -ds.d, active) * _rcp(ds.pdf))

    @zero_if_invalid("Float")
    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample_direction` [1/sr]."""
        pdf = self._distribution().pdf(self._surface_at(ds, active), active)
        return dr.select(active, _solid_angle(pdf, ds), 0)

    @zero_if_invalid("Spectrum")
    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] that arrives at `it` from the surface point of `ds`."""
        si = self._surface_at(ds, active)
        si.wavelengths = it.wavelengths
        return mi.depolarizer(self._radiance(si, -ds.d, active))

    @zero_if_invalid("Wavelength", "Spectrum")
    def sample_wavelengths(
        self, si: mi.SurfaceInteraction3f, sample: mi.Float, active: mi.Bool = True
    ) -> tuple[mi.Wavelength, mi.Spectrum]:
        """Wavelengths, and the radiance at `si` over their density; light tracers obtain the radiance here.

        `si.wi` is in world coordinates: Mitsuba's `ptracer`, the only caller, sets it without `to_local`.
        """
        ps = mi.PositionSample3f(si)
        ps.n = si.n
        wavelengths, weight = sample_wavelengths(sample)
        here = self._surface_at(ps, active)
        here.wavelengths = wavelengths
        return wavelengths, mi.depolarizer(self._radiance(here, si.wi, active) * weight)

    # ------------------------------------------------------------------ the surface itself

    def _own_shape(self) -> mi.Shape:
        """Shape of the emitter; ExitanceError if it was deleted with its scene, while the emitter still exists."""
        if self._shape is None:
            self._shape = mi.ShapePtr(self.get_shape())
        if self._shape[0] is None:
            raise ExitanceError("fspt_surface: its scene was deleted. Keep the scene as well as its emitter.")
        return self._shape[0]

    def check(self) -> None:
        """Raise ExitanceError if J_n or the exit law does not fit the shape; repeated only after a change."""
        source = exitance.ExitanceState.of(self._own_shape(), self.exitance)
        # Mitsuba does not inform an emitter of new values on its mesh, or of objects that are updated separately.
        if self._source and (self._source.state() != source.state() or self.law.renewed()):
            self._forget_exitance()
        if self._source:
            return

        def checked(shape: mi.Shape) -> float:
            brightest = exitance.check_values(shape, self.exitance)
            self.law.prepare(shape)
            return brightest

        self.brightest = evaluated_outside(checked, self._own_shape())
        self._source = source

    def sound(self) -> bool:
        """True if `check` succeeds. During a recording for another scene, which must not raise: False if it fails."""
        if scene_is_checked() and (self._source or self._shape is None):
            # A surface that was never checked belongs to another scene. If the loading of that scene failed, the shape
            # is deleted and must not be accessed.
            return self._source is not None
        try:
            self.check()
        except ExitanceError:
            if scene_is_checked():
                return False
            raise
        return True

    def is_isotropic(self) -> bool:
        """True if the radiance is equal in all outward directions."""
        return self.law.isotropic

    def is_uniform(self) -> bool:
        """True if J_n is one number."""
        return exitance.is_uniform(self.exitance)

    def is_linear(self) -> bool:
        """True if J_n is a mesh attribute, and so linear on every face."""
        return bool(self._source) and self._source.attribute is not None and self._own_shape().is_mesh()

    def radiance_at_corners(self) -> tuple[mi.Float, mi.Float, mi.Float] | None:
        """Radiance [W/mm²/sr] at the corners of every face of a mesh; None if it is not linear or not Lambert's."""
        corners = exitance.at_corners(self._own_shape(), self.exitance) if self.is_isotropic() else None
        if corners is None:
            return None
        profile = self.law.profile(dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0, 0, 1), mi.Bool(True))
        return tuple(profile * value for value in corners)

    def _distribution(self) -> ElementDistribution:
        """Distribution of positions ∝ J_n, built on first use."""
        self.check()
        if self._positions is None:
            self._positions = evaluated_outside(
                lambda shape: ElementDistribution(elements_of(shape), exitance.function_on(shape, self.exitance)),
                self._own_shape(),
            )
        return self._positions

    def _surface_at(self, ps: mi.PositionSample3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Surface interaction at a position sample, which does not contain its face."""
        shape = self._own_shape()
        if not shape.is_mesh():
            return self._distribution().elements.at(ps.uv)
        if self._probe is None:
            self._probe = evaluated_outside(Probe, shape)
        return self._probe.at(shape, ps, active)

    def trace_beside(self, scene: mi.Scene) -> None:
        """Set up the search for faces for kernels that trace rays in `scene`, see `Probe`.

        Repeated on every call, since the probe may have been built beside another scene in between.
        """
        if self._own_shape().is_mesh():
            with dr.suspend_grad():
                self._probe = Probe(self._own_shape(), scene)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return self._own_shape().bbox()

    def to_string(self) -> str:
        return f"FsptSurface[\n  exitance = {self.exitance},\n  emission = {self.law}\n]"


def _solid_angle(pdf: mi.Float, ds: mi.DirectionSample3f) -> mi.Float:
    """Density per solid angle [1/sr] from density per area [1/mm²]; 0 on the inward side."""
    cos_theta = -dr.dot(ds.d, ds.n)
    return dr.select(cos_theta > 0, pdf * dr.square(ds.dist) / cos_theta, 0)


def _rcp(pdf: mi.Float) -> mi.Float:
    """1/pdf; 0 for pdf = 0."""
    return dr.select(pdf > 0, dr.rcp(pdf), 0)


mi.register_emitter("fspt_surface", FsptSurface)
