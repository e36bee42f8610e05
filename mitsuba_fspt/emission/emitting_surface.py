"""An emitting surface: exitance J_n and exit law on one shape, as integral and Mitsuba's samplers need them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.recording import evaluated_outside, scene_is_checked
from ..runtime.errors import ExitanceError, SceneError
from . import exitance
from .elements import ElementDistribution, elements_of
from .face_probe import Probe
from .laws import ExitLaw


class EmittingSurface:
    """Surface flux density J_n [W/mm²] and exit law on a shape, with all that is derived from them and kept.

    Parameters
    ----------
    texture : J_n as a texture of Mitsuba
    law : exit law
    shape_of : function that gives the shape; called once, when the shape is first needed

    Attributes
    ----------
    brightest : largest J_n [W/mm²], set by `check`
    mark, edition : for caches: `mark` identifies this surface, `edition` counts the changes of J_n
    single_faces, winding : what the checks of a mesh found, with the buffers of the mesh for which it holds
    """

    def __init__(self, texture: mi.Texture, law: ExitLaw, shape_of: Callable[[], mi.Shape]) -> None:
        self.exitance, self.law, self._shape_of = texture, law, shape_of
        self.brightest = 0.0
        # A cache must not hold the emitter itself: Dr.Jit would record it even after its shape has been deleted.
        self.mark, self.edition = object(), 0
        self.single_faces: tuple[mi.Float, ...] = ()
        self.winding: tuple[Any, ...] = ()
        self._positions: ElementDistribution | None = None
        self._probe: Probe | None = None
        self._source: exitance.ExitanceState | None = None  # data of J_n at the last `check`
        self._shape: mi.ShapePtr | None = None

    @property
    def shape(self) -> mi.Shape:
        """The shape; ExitanceError if it was deleted with its scene, while this surface still exists."""
        if self._shape is None:
            self._shape = mi.ShapePtr(self._shape_of())
        if self._shape[0] is None:
            raise ExitanceError("fspt_surface: its scene was deleted. Keep the scene as well as its emitter.")
        return self._shape[0]

    def forget_exitance(self) -> None:
        """Discard all results that depend on J_n."""
        self._positions = self._source = None
        self.edition += 1

    def forget_shape(self) -> None:
        """Discard all results that depend on the shape."""
        self._probe = None
        self.forget_exitance()

    @contextmanager
    def shining(self, value: float) -> Iterator[None]:
        """Context manager: within the block J_n is `value` [W/mm²] everywhere."""
        own, self.exitance = self.exitance, exitance.uniform(value)
        self.forget_exitance()
        try:
            yield
        finally:
            self.exitance = own
            self.forget_exitance()

    # ------------------------------------------------------------------ checks

    def check(self) -> None:
        """Raise ExitanceError if J_n or the exit law does not fit the shape; repeated only after a change.

        Raises SceneError for a shape whose surface Mitsuba gives no points of.
        """
        if self.shape.class_name() == "LinearCurve":
            raise SceneError(
                f"scene: shape '{self.shape.id()}' is a linearcurve, on whose surface Mitsuba gives no points to glow. "
                "Give a bsplinecurve, cylinders or a mesh."
            )
        source = exitance.ExitanceState.of(self.shape, self.exitance)
        # Mitsuba does not inform an emitter of new values on its mesh, or of objects that are updated separately.
        if self._source and (self._source.state() != source.state() or self.law.renewed()):
            self.forget_exitance()
        if self._source:
            return

        def checked(shape: mi.Shape) -> float:
            brightest = exitance.check_values(shape, self.exitance)
            self.law.prepare(shape)
            return brightest

        self.brightest = evaluated_outside(checked, self.shape)
        self._source = source

    def sound(self) -> bool:
        """True if `check` succeeds. During a recording for another scene, which must not raise: False if it fails."""
        if scene_is_checked() and (self._source or self._shape is None):
            # A surface that was never checked belongs to another scene. If the loading of that scene failed, the shape
            # is deleted and must not be accessed.
            return self._source is not None
        try:
            self.check()
        except (ExitanceError, SceneError):
            if scene_is_checked():
                return False
            raise
        return True

    # ------------------------------------------------------------------ radiance

    def radiance(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Radiance [W/mm²/sr] towards a unit vector in world coordinates, 0 on the inward side."""
        if not self.sound():
            return mi.UnpolarizedSpectrum(0)
        outward = active & (dr.dot(si.n, direction) > 0)
        radiance = self.exitance.eval(si, outward) * self.law.profile(si, direction, outward)
        # On a sliver, where interpolation in single precision fails, J_n is NaN.
        # `select` returns a plain array, of which Mitsuba's depolarizer would take the first wavelength only.
        return mi.UnpolarizedSpectrum(dr.select(outward & dr.isfinite(radiance), radiance, 0))

    def is_isotropic(self) -> bool:
        """True if the radiance is equal in all outward directions."""
        return self.law.isotropic

    def is_uniform(self) -> bool:
        """True if J_n is one number."""
        return exitance.is_uniform(self.exitance)

    def is_linear(self) -> bool:
        """True if J_n is a mesh attribute, and so linear on every face."""
        return bool(self._source) and self._source.attribute is not None and self.shape.is_mesh()

    def exitance_at_corners(self) -> tuple[mi.Float, mi.Float, mi.Float] | None:
        """J_n [W/mm²] at the corners of every face of a mesh; None if it is not linear on the faces."""
        return exitance.at_corners(self.shape, self.exitance) if self.shape.is_mesh() else None

    def radiance_at_corners(self) -> tuple[mi.Float, mi.Float, mi.Float] | None:
        """Radiance [W/mm²/sr] at the corners of every face of a mesh; None if it is not linear or not Lambert's."""
        corners = exitance.at_corners(self.shape, self.exitance) if self.is_isotropic() else None
        if corners is None:
            return None
        profile = self.law.profile(dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0, 0, 1), mi.Bool(True))
        return tuple(profile * value for value in corners)

    # ------------------------------------------------------------------ points on the surface

    def distribution(self) -> ElementDistribution:
        """Distribution of positions ∝ J_n, built on first use."""
        self.check()
        if self._positions is None:
            self._positions = evaluated_outside(
                lambda shape: ElementDistribution(elements_of(shape), exitance.function_on(shape, self.exitance)),
                self.shape,
            )
        return self._positions

    def interaction_at(self, ps: mi.PositionSample3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Surface interaction at a position sample, which does not contain its face."""
        shape = self.shape
        if not shape.is_mesh():
            return self.distribution().elements.at(ps.uv)
        if self._probe is None:
            self._probe = evaluated_outside(Probe, shape)
        return self._probe.at(shape, ps, active)

    def trace_beside(self, scene: mi.Scene) -> None:
        """Set up the search for faces for kernels that trace rays in `scene`, see `Probe`.

        Repeated on every call, since the probe may have been built beside another scene in between.
        """
        if self.shape.is_mesh():
            with dr.suspend_grad():
                self._probe = Probe(self.shape, scene)
