"""`fspt_integral`: the deterministic integrator of Eq. 9."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera.of_sensor import camera_of
from ..emission.emitting_surface import EmittingSurface
from ..emission.face_table import shape_number
from ..emission.gradients import surfaces_with_gradients
from ..integral.derivative import Derivative
from ..integral.lines.eq9 import View
from ..integral.lines.left_out import LeftOut, light_left_out
from ..integral.lines.scene_warnings import scene_warnings
from ..integral.lines.traced_scene import pose_of
from ..integral.quadrature import Quadrature
from ..integral.rows.exitance_rows import Rows
from ..integral.shortcuts import SHORTCUTS
from ..integral.solution import Solution
from ..integral.solver import Solver
from ..integral.work_log import WorkLog
from ..jit.from_numpy import from_numpy
from ..runtime.cached_value import CachedValue
from ..runtime.deadline import Deadline
from ..runtime.errors import SceneError, named

MEANINGLESS = ("max_depth", "rr_depth", "hide_emitters", "samples_per_pass", "timeout")


class FsptIntegral(mi.ad.integrators.common.ADIntegrator):
    r"""
    .. _integrator-fspt_integral:

    Free-space transport integral (:monosp:`fspt_integral`)
    -------------------------------------------------------

    .. pluginparameters::

     * - rtol
       - |float|
       - Requested error of every pixel, relative to the brightest pixel (Default: 1e-3).
     * - domain
       - |string|
       - pupil: lines of sight from every pixel (Default). surface: the power of every surface element is distributed
         over the pixels that its blur disc covers. Both are forms of Eq. 9. The second one is always used for light
         from objects and spots thinner than half a pixel or half their blur disc, which lines of sight would miss.
     * - pixel
       - |string|
       - area: integrate over the pixel (Default). centre: the value at its centre times its area, as in the paper.
     * - max_nodes
       - |int|
       - Largest number of lines of sight per pixel, at least four (Default: 65536, below rtol 1e-3 more, up to 4194304
         at 5e-5; few pixels take more, together at most 67 million). Where it is reached, the error is larger than
         requested and stated. In domain surface it is the mean per pixel, at least 256 and at most 65536.
     * - max_specular
       - |int|
       - Largest number of specular surfaces (null, thin and solid glass, mirrors, masks) that a line of sight passes
         through or is reflected by (Default: 8). The light that is cut off there is contained in the error.
     * - shortcuts
       - |bool|
       - Omit computations that the scene does not need (Default: true). false gives the same power, within the
         requested error, in more time.

    Needs an `fspt_lens`. Deterministic: the same bits every run; sampler, samples per pixel and seed are not used.
    """

    def __init__(self, props: mi.Properties) -> None:
        _refuse_meaningless(props)
        super().__init__(props)
        self.quadrature = _quadrature_of(props)
        self._solver = Solver()
        self._derivative = Derivative(self._solver, self.quadrature)
        self._warnings, self._logged = CachedValue(), set[str]()

    def solve(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        quadrature: Quadrature | None = None,
        progress: Callable[[float], None] | None = None,
        *,
        narrow: bool = True,
        deadline: Deadline | None = None,
        log: WorkLog | None = None,
    ) -> Solution:
        """Power, error and coverage of the sensor's crop window, by `quadrature` or the integrator's own.

        Arguments and errors as of `Solver.solve`; SceneError for a sensor that is no `fspt_lens`.
        """
        wanted = quadrature or self.quadrature
        return self._solver.solve(scene, camera_of(sensor), wanted, progress, narrow=narrow, deadline=deadline, log=log)

    def light_left_out(
        self, scene: mi.Scene, sensor: mi.Sensor, quadrature: Quadrature | None = None
    ) -> LeftOut | None:
        """Light that Eq. 9 leaves out in a scene that `solve` can render; None if there can be none."""
        return light_left_out(scene, camera_of(sensor), quadrature or self.quadrature)

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
        with dr.resume_grad():
            asked = surfaces_with_gradients(scene, sensor)
        if asked:
            self._derivative.kinds(scene, camera_of(sensor), asked)
        solution = self.solve(scene, sensor)
        self._log_warnings(scene, sensor)
        return mi.TensorXf(from_numpy(mi.Float, solution.power), (*solution.power.shape, 1))

    def render_forward(
        self,
        scene: mi.Scene,
        params: object,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Tangent of the image [W], shape (h, w, 1), from the tangents of the numbers behind `exitance`.

        Raises SceneError for gradients of any other parameter, and as `render`.
        """
        with self._rows(scene, sensor) as (rows, view, surfaces):
            tangent = rows.forward(view, self.quadrature, surfaces)
        return mi.TensorXf(from_numpy(mi.Float, tangent), (*tangent.shape, 1))

    def render_backward(
        self,
        scene: mi.Scene,
        params: object,
        grad_in: mi.TensorXf,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        """Apply the transpose of `render_forward` to `grad_in`, and add the result to the gradients behind `exitance`.

        grad_in : gradient with respect to the image, shape (h, w, 1) [1/W]
        Raises as `render_forward`.
        """
        with self._rows(scene, sensor) as (rows, view, surfaces):
            gradient = np.broadcast_to(np.array(grad_in, np.float64).reshape(-1, 1), (math.prod(rows.shape), 1))
            rows.backward(view, self.quadrature, surfaces, gradient.reshape(rows.shape))

    @contextmanager
    def _rows(self, scene: mi.Scene, sensor: mi.Sensor | int) -> Iterator[tuple[Rows, View, list[EmittingSurface]]]:
        """Context manager: rows of the derivative by J_n, their view, and the surfaces with gradients."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        with dr.resume_grad():
            surfaces = surfaces_with_gradients(scene, sensor)
        with self._derivative.rows(scene, camera_of(sensor), surfaces) as (rows, view):
            yield rows, view, surfaces

    def _log_warnings(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Log what an image does not show and what is odd about the scene: each line once, when shapes or lens change.

        `mitsuba_fspt.render` has the same lines in its metadata.
        """
        shapes, camera = scene.shapes(), camera_of(sensor)
        state = ([shape_number(shape) for shape in shapes], [pose_of(shape) for shape in shapes], camera.state)

        def find() -> list[str]:
            left_out = self.light_left_out(scene, sensor)
            found = [left_out.warning(self.quadrature.rtol)] if left_out else []
            return [text for text in (*found, *scene_warnings(scene, camera, self)) if text]

        for text in self._warnings.recall(state, find):
            if text not in self._logged:
                mi.Log(mi.LogLevel.Warn, f"fspt_integral: {text}.")
                self._logged.add(text)

    def to_string(self) -> str:
        return f"FsptIntegral[{self.quadrature}]"


def _refuse_meaningless(props: mi.Properties) -> None:
    """Raise SceneError for a parameter that Mitsuba's base classes accept and that would have no effect here."""
    for name in MEANINGLESS:
        if name in props:
            raise SceneError(
                f"fspt_integral: '{name}' has no meaning, light goes straight to the lens and nothing is sampled. "
                "Leave it out; 'rtol' and 'max_nodes' set accuracy and time."
            )


def _quadrature_of(props: mi.Properties) -> Quadrature:
    """Quadrature from the integrator's parameters; SceneError if one is wrong."""
    defaults = Quadrature()
    shortcuts = props.get("shortcuts", True)
    if not isinstance(shortcuts, bool):
        raise SceneError(f"fspt_integral: 'shortcuts' must be true or false, got {shortcuts!r}. Give it as a boolean.")
    with named("fspt_integral"):
        return Quadrature(
            rtol=props.get("rtol", defaults.rtol),
            domain=str(props.get("domain", defaults.domain)),
            pixel=str(props.get("pixel", defaults.pixel)),
            max_nodes=props.get("max_nodes", defaults.max_nodes),
            max_specular=props.get("max_specular", defaults.max_specular),
            shortcuts_off=frozenset() if shortcuts else frozenset(SHORTCUTS),
        )


mi.register_integrator("fspt_integral", FsptIntegral)
