"""`fspt_integral`: the deterministic integrator of Eq. 9."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..optics import Lens
from ..quadrature import Quadrature, Solution
from . import pupil_form, surface_form
from .checks import check_scene
from .intersections import robust_scene
from .narrow import NarrowLight, narrow_light
from .recording import recording
from .window import visible_window

NARROW = 0.1  # pixels with more than so many times rtol of light in narrow spots are left to the surface form


class FsptIntegral(mi.ad.integrators.common.ADIntegrator):
    r"""
    .. _integrator-fspt_integral:

    Free-space transport integral (:monosp:`fspt_integral`)
    -------------------------------------------------------

    .. pluginparameters::

     * - rtol
       - |float|
       - Error asked for on every pixel, relative to the brightest pixel (Default: 1e-3).
     * - domain
       - |string|
       - pupil: lines of sight from every pixel (Default). surface: the power of every surface element is spread
         over the pixels its blur disc covers. Two ways of writing Eq. 9. Light from bodies and spots far below a
         pixel, which lines of sight from the pixels would miss, is spread in either case.
     * - pixel
       - |string|
       - area: integrate over the pixel (Default). centre: the value at its centre times its area, as in the paper.
     * - max_nodes
       - |int|
       - Lines of sight a pixel may take at most (Default: 131072).

    Needs an `fspt_lens`. Deterministic: the same bits every run; sampler, samples per pixel and seed are not used.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        defaults = Quadrature()
        self.quadrature = Quadrature(
            rtol=float(props.get("rtol", defaults.rtol)),
            domain=str(props.get("domain", defaults.domain)),
            pixel=str(props.get("pixel", defaults.pixel)),
            max_nodes=int(props.get("max_nodes", defaults.max_nodes)),
        )
        # What was found out about the last scene; the scene itself, whose child this is, must not be kept.
        self._sound: list[mi.Emitter] = []
        self._narrow: tuple[object, Lens, NarrowLight] | None = None

    def solve(self, scene: mi.Scene, sensor: mi.Sensor, quadrature: Quadrature | None = None) -> Solution:
        """Power, error and coverage of the sensor's crop window, with another `quadrature` than the integrator's own.

        Raises SceneError or ExitanceError as in `check_scene`.
        """
        quadrature = quadrature or self.quadrature
        check_scene(scene, sensor)
        with recording(), dr.suspend_grad():
            return self._solve(scene, sensor, quadrature)

    def _solve(self, scene: mi.Scene, lens: mi.Sensor, quadrature: Quadrature) -> Solution:
        traced = self._traced(scene, lens)
        # Light from the surface knows no border on the film: pixels that the image-plane stop cuts take lines of sight.
        inside, cut = visible_window(scene, lens).stopped(lens)
        if quadrature.domain == "surface":
            if not cut.any():
                return surface_form.solve(traced, lens, quadrature)
            known = surface_form.solve(traced, lens, quadrature, inside)
            return known.completed_by(pupil_form.solve(traced, lens, quadrature, known))
        narrow = self._narrow_light(scene, lens)
        where = inside & (narrow.on_pixels > NARROW * quadrature.rtol * narrow.brightest)
        if not where.any():
            return pupil_form.solve(traced, lens, quadrature)
        known = surface_form.solve(traced, lens, quadrature, where, narrow.brightest / 2)
        return known.completed_by(pupil_form.solve(traced, lens, quadrature, known))

    def _traced(self, scene: mi.Scene, lens: mi.Sensor) -> mi.Scene:
        """`scene`, or its robust twin where it loses rays; looked at once a scene."""
        if scene.emitters() != self._sound:
            robust = robust_scene(scene, lens)
            if robust is not scene:
                return robust
            self._sound = scene.emitters()
        return scene

    def _narrow_light(self, scene: mi.Scene, lens: mi.Sensor) -> NarrowLight:
        """`narrow_light`, found once for as long as neither surfaces nor lens nor film change."""
        emitters, window = scene.emitters(), visible_window(scene, lens)
        state = (emitters, [getattr(emitter, "edition", 0) for emitter in emitters], window)
        # A lens makes new optics with every change, if only of its place.
        if self._narrow is None or self._narrow[0] != state or self._narrow[1] is not lens.optics:
            self._narrow = (state, lens.optics, narrow_light(emitters, lens, window))
        return self._narrow[2]

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Power on every pixel [W], shape (h, w, 1)."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        solution = self.solve(scene, sensor)
        return mi.TensorXf(solution.power[..., None].astype(np.float32))

    def to_string(self) -> str:
        return f"FsptIntegral[{self.quadrature}]"


mi.register_integrator("fspt_integral", FsptIntegral)
