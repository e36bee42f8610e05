"""Derivatives of the power on the pixels by the numbers behind J_n, from rows that are kept while geometry stays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera.camera import Camera
from ..emission.emitting_surface import EmittingSurface
from ..emission.of_emitter import mark_of, surfaces_of
from ..jit.mesh_buffers import buffers
from ..jit.recording import recording
from ..runtime.cached_value import CachedValue
from ..runtime.errors import SceneError
from .lines.eq9 import View
from .lines.scene_checks import check_scene
from .lines.specular import Specular
from .lines.traced_scene import pose_of
from .quadrature import Quadrature
from .rows.exitance_rows import Rows, kinds_of, sizes_of
from .solver import Solver


class Derivative:
    """Derivative of Eq. 9 by the numbers behind J_n, with the solver and the quadrature of the power itself."""

    def __init__(self, solver: Solver, quadrature: Quadrature) -> None:
        self._solver, self._quadrature, self._rows = solver, quadrature, CachedValue()

    @contextmanager
    def rows(self, scene: mi.Scene, camera: Camera, surfaces: list[EmittingSurface]) -> Iterator[tuple[Rows, View]]:
        """Context manager: rows of the derivative by the J_n of these surfaces, and their view.

        Raises SceneError where light reaches the lens through or off specular shapes and the rows do not follow it.
        """
        with dr.suspend_grad():
            kinds = self.kinds(scene, camera, surfaces)
            rows = self._rows_of(scene, camera, kinds, sizes_of(surfaces))
            check_scene(scene, camera)
            with recording():
                yield rows, self._view(scene, camera)

    def kinds(self, scene: mi.Scene, camera: Camera, surfaces: list[EmittingSurface]) -> tuple[str, ...] | None:
        """`kinds_of` these surfaces; SceneError where it is None and light reaches the lens by specular shapes."""
        kinds = kinds_of(scene, surfaces, self._quadrature)
        if kinds is None:
            self._refuse_specular(scene, camera)
        return kinds

    def _view(self, scene: mi.Scene, camera: Camera) -> View:
        """The view through Mitsuba's surface records."""
        window = self._solver.visible_window(scene, camera, False, ())
        return View.of(self._solver.traced(scene, camera), camera, window)

    def _rows_of(self, scene: mi.Scene, camera: Camera, kinds: tuple[str, ...] | None, sizes: tuple[int, int]) -> Rows:
        """Rows of the derivative with respect to J_n; cached, since they do not depend on J_n."""
        shapes = scene.shapes()
        positions = tuple(buffers(shape)[0] for shape in shapes if shape.is_mesh())
        marks = [mark_of(emitter) for emitter in scene.emitters()]
        surfaces = surfaces_of(scene)
        linear = len(surfaces) == len(marks) and all(surface.law.linear for surface in surfaces)
        # Laws that depend on more than J_n may have changed.
        poses = [pose_of(shape) for shape in shapes]
        state = (kinds or sizes, marks, poses, camera.state, object() if not linear else None)

        def find() -> Rows:
            with ExitStack() as stack:
                for surface in surfaces:
                    stack.enter_context(surface.shining(1.0))
                image = self._solver.solve(scene, camera, self._quadrature)
                window = self._solver.visible_window(scene, camera, False, ())
                seen = window.expand(np.ones(window.shape)) > 0
                with recording(), dr.suspend_grad():
                    if kinds is None:
                        found = Rows.by_lines(self._view(scene, camera), self._quadrature, image, seen, sizes)
                    else:
                        found = Rows.on_meshes(scene, camera, self._quadrature, image, kinds)
                return replace(found, kept=positions)

        return self._rows.recall(state, find)

    def _refuse_specular(self, scene: mi.Scene, camera: Camera) -> None:
        """Raise SceneError where light reaches the lens through or off specular shapes."""
        with dr.suspend_grad():
            specular = Specular.of(scene, camera, self._quadrature)
        if specular:
            raise SceneError(
                f"fspt_integral: light reaches the lens through or off the specular shapes {', '.join(specular.names)}"
                ", which gradients do not follow. Leave them out, or render without gradients."
            )
