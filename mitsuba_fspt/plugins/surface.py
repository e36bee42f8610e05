"""`fspt_surface`: the phantom's surface as an emitter with the surface flux density J_n [W/mm²]."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..emission import exitance
from ..emission.elements import ElementDistribution, elements_of
from ..emission.face_probe import Probe
from ..emission.laws import law_of
from ..jit.recording import aside, dark_elsewhere, scene_is_checked
from ..jit.spectra import sample_wavelengths
from ..runtime.errors import ExitanceError


class FsptSurface(mi.Emitter):
    r"""
    .. _emitter-fspt_surface:

    Glowing surface (:monosp:`fspt_surface`)
    ----------------------------------------

    .. pluginparameters::

     * - exitance
       - |float| or |texture| [W/mm²]
       - Surface flux density J_n >= 0, finite, > 0 somewhere: a number, a mesh attribute, a raw bitmap.
         Updatable, differentiable.
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
       - Fluence Φ > 0 in the tissue, in any unit, a gridvolume that holds the shape; only with last_flight. Updatable.

    The radiance is 0 on the inward side, the side away from the geometric normal; on the outward side, with µ the
    cosine to the normal, ∫ L µ dΩ = J_n and

    - lambert (Eq. 1, the paper's): L = J_n/π [W/mm²/sr];
    - fresnel: L = J_n/(4π) · (2A + 3µ_i) · T(µ)/n², the diffusion approximation's radiance refracted at a smooth
      border; µ_i = √(1 − (1 − µ²)/n²), T the unpolarised Fresnel transmittance, A of Haskell et al. (1994). At
      n = 1.37 it is 1.11 × J_n/π face-on and falls to 0 at the limb;
    - last_flight: L = C · T(µ)/n² · µs'/(4π) ∫₀^∞ Φ(r − s ω_i) exp(−(µa + µs') s) ds. What leaves is what scatters
      last, on the refracted line of sight ω_i; it sees the slope of the fluence along the surface and its bend above a
      shallow source, which the other laws do not. C(r) is such that the hemisphere carries J_n(r). The volume is what
      'fspt flux solve --volume' writes; turn it along with the shape.

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
        self._source: exitance.ExitanceState | None = None  # known after `check`
        self.single_faces: tuple[mi.Float, ...] = ()  # of the mesh that is known to hold no face twice
        self.brightest = 0.0  # largest J_n [W/mm²], known after `check`
        # For those who remember something about it: what tells it from all others, and counts the changes of J_n. Who
        # kept it instead, and not its shape, would leave Dr.Jit an emitter to record whose shape is gone.
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
        self._positions = self._source = None
        self.edition += 1

    # ------------------------------------------------------------------ radiance

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] towards `si.wi`, 0 on the inward side."""
        return mi.depolarizer(self._radiance(si, si.to_world(si.wi), active))

    def _radiance(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Radiance [W/mm²/sr] towards a unit vector of the world, 0 on the inward side."""
        if not self.sound():
            return mi.UnpolarizedSpectrum(0)
        outward = active & (dr.dot(si.n, direction) > 0)
        radiance = self.exitance.eval(si, outward) * self.law.profile(si, direction, outward)
        # On a sliver, where single precision finds no place to interpolate at, J_n is not a number.
        # `select` makes a plain array of it, of which Mitsuba's depolarizer would take the first wavelength alone.
        return mi.UnpolarizedSpectrum(dr.select(outward & dr.isfinite(radiance), radiance, 0))

    # ------------------------------------------------------------------ sampling

    @dark_elsewhere("PositionSample3f", "Float")
    def sample_position(
        self, time: mi.Float, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.PositionSample3f, mi.Float]:
        """Surface point with density ∝ J_n [1/mm²]; the weight is 1/density."""
        si, pdf = self._distribution().sample(sample, active)
        ps = mi.PositionSample3f(si)
        ps.n, ps.time, ps.pdf, ps.delta = si.n, time, pdf, False
        return ps, _rcp(pdf)

    @dark_elsewhere("Float")
    def pdf_position(self, ps: mi.PositionSample3f, active: mi.Bool = True) -> mi.Float:
        return self._distribution().pdf(self._surface_at(ps, active), active)

    @dark_elsewhere("Ray3f", "Spectrum")
    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Ray from a point ∝ J_n in a direction ∝ cosθ; its weight is the power it stands for [W]."""
        si, pdf = self._distribution().sample(sample2, active)
        si.wavelengths, weight = sample_wavelengths(sample1)
        direction = mi.Frame3f(si.n).to_world(mi.warp.square_to_cosine_hemisphere(sample3))
        si.time = time
        ray = si.spawn_ray(direction)
        power = self._radiance(si, direction, active) * (dr.pi * _rcp(pdf))
        return ray, mi.depolarizer(power * weight)

    @dark_elsewhere("DirectionSample3f", "Spectrum")
    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Direction from `it` to a surface point ∝ J_n; the weight is radiance over its density [1/sr]."""
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

    @dark_elsewhere("Float")
    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        pdf = self._distribution().pdf(self._surface_at(ds, active), active)
        return dr.select(active, _solid_angle(pdf, ds), 0)

    @dark_elsewhere("Spectrum")
    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance [W/mm²/sr] that arrives at `it` from the surface point of `ds`."""
        si = self._surface_at(ds, active)
        si.wavelengths = it.wavelengths
        return mi.depolarizer(self._radiance(si, -ds.d, active))

    @dark_elsewhere("Wavelength", "Spectrum")
    def sample_wavelengths(
        self, si: mi.SurfaceInteraction3f, sample: mi.Float, active: mi.Bool = True
    ) -> tuple[mi.Wavelength, mi.Spectrum]:
        """Wavelengths, and the radiance at `si` over their density; light tracers learn the radiance here.

        `si.wi` is a direction of the world: Mitsuba's `ptracer`, the one caller, sets it so, without `to_local`.
        """
        ps = mi.PositionSample3f(si)
        ps.n = si.n
        wavelengths, weight = sample_wavelengths(sample)
        here = self._surface_at(ps, active)
        here.wavelengths = wavelengths
        return wavelengths, mi.depolarizer(self._radiance(here, si.wi, active) * weight)

    # ------------------------------------------------------------------ the surface itself

    def _home(self) -> mi.Shape:
        """The shape; ExitanceError where it is gone with its scene, for Dr.Jit records every emitter that is left."""
        if self._shape is None:
            self._shape = mi.ShapePtr(self.get_shape())
        if self._shape[0] is None:
            raise ExitanceError("fspt_surface: its scene is gone. Keep the scene, not its emitter.")
        return self._shape[0]

    def check(self) -> None:
        """Raise ExitanceError where J_n or the law of emission does not fit the shape; once a change."""
        source = exitance.ExitanceState.of(self._home(), self.exitance)
        # Mitsuba does not tell an emitter of new values on its mesh, nor of what is updated by itself.
        if self._source and (self._source.state() != source.state() or self.law.renewed()):
            self._forget_exitance()
        if self._source:
            return

        def look(shape: mi.Shape) -> float:
            brightest = exitance.check_values(shape, self.exitance)
            self.law.prepare(shape)
            return brightest

        self.brightest = aside(look, self._home())
        self._source = source

    def sound(self) -> bool:
        """True after `check`; False where it fails in a recording for another scene, which must not care."""
        if scene_is_checked() and (self._source or self._shape is None):
            # Never looked at, it is none of that scene; where loading failed, its shape is gone and must not be asked.
            return self._source is not None
        try:
            self.check()
        except ExitanceError:
            if scene_is_checked():
                return False
            raise
        return True

    def is_isotropic(self) -> bool:
        """True where the radiance is the same in all outward directions."""
        return self.law.isotropic

    def is_uniform(self) -> bool:
        """True where J_n is one number."""
        return exitance.is_uniform(self.exitance)

    def is_linear(self) -> bool:
        """True where J_n is linear on every face of a mesh: an attribute of it."""
        return bool(self._source) and self._source.attribute is not None and self._home().is_mesh()

    def radiance_at_corners(self) -> tuple[mi.Float, mi.Float, mi.Float] | None:
        """Radiance [W/mm²/sr] at the corners of every face of a mesh; None where it is not linear or not Lambert's."""
        corners = exitance.at_corners(self._home(), self.exitance) if self.is_isotropic() else None
        if corners is None:
            return None
        profile = self.law.profile(dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0, 0, 1), mi.Bool(True))
        return tuple(profile * value for value in corners)

    def _distribution(self) -> ElementDistribution:
        self.check()
        if self._positions is None:
            self._positions = aside(
                lambda shape: ElementDistribution(elements_of(shape), exitance.function_on(shape, self.exitance)),
                self._home(),
            )
        return self._positions

    def _surface_at(self, ps: mi.PositionSample3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The full surface record at a position sample, which lacks the face it lies on."""
        shape = self._home()
        if not shape.is_mesh():
            return self._distribution().elements.at(ps.uv)
        if self._probe is None:
            self._probe = aside(Probe, shape)
        return self._probe.at(shape, ps, active)

    def trace_beside(self, scene: mi.Scene) -> None:
        """Find faces in the kernels that trace rays in `scene`, see `Probe`.

        Each time anew: faces may have been looked for beside another scene since.
        """
        if self._home().is_mesh():
            with dr.suspend_grad():
                self._probe = Probe(self._home(), scene)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return self._home().bbox()

    def to_string(self) -> str:
        return f"FsptSurface[\n  exitance = {self.exitance},\n  emission = {self.law}\n]"


def _solid_angle(pdf: mi.Float, ds: mi.DirectionSample3f) -> mi.Float:
    """Density per solid angle [1/sr] from density per area [1/mm²]; 0 from behind."""
    cos_theta = -dr.dot(ds.d, ds.n)
    return dr.select(cos_theta > 0, pdf * dr.square(ds.dist) / cos_theta, 0)


def _rcp(pdf: mi.Float) -> mi.Float:
    return dr.select(pdf > 0, dr.rcp(pdf), 0)


mi.register_emitter("fspt_surface", FsptSurface)
