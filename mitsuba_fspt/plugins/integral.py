"""`fspt_integral`: the deterministic integrator of Eq. 9."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..quadrature import Quadrature, Solution
from . import pupil_form, surface_form
from .checks import check_scene
from .intersections import robust_scene
from .recording import nothing_collected


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
         over the pixels its blur disc covers. Two ways of writing Eq. 9.
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
        # The emitters of the last scene that lost no rays; the scene itself, whose child this is, must not be kept.
        self._sound: list[mi.Emitter] = []

    def solve(self, scene: mi.Scene, sensor: mi.Sensor) -> Solution:
        """Power, error and coverage of the sensor's crop window; errors as in `check_scene`."""
        check_scene(scene, sensor)
        form = surface_form if self.quadrature.domain == "surface" else pupil_form
        with nothing_collected():
            return form.solve(self._traced(scene, sensor), sensor, self.quadrature)

    def _traced(self, scene: mi.Scene, lens: mi.Sensor) -> mi.Scene:
        """`scene`, or its robust twin where it loses rays; looked at once a scene."""
        if scene.emitters() != self._sound:
            robust = robust_scene(scene, lens)
            if robust is not scene:
                return robust
            self._sound = scene.emitters()
        return scene

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
