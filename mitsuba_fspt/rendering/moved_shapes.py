"""Rigid motion of the shapes of a loaded scene, in place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

Matrix = NDArray[np.float64]  # (4, 4), acts on homogeneous coordinates [mm]


class MovedShapes:
    """Rigid motions of the shapes of `scene`, relative to their positions when it was loaded.

    The vertices of a mesh are moved; any other shape gets a new `to_world`. `moved` is True once a shape has been
    moved: the scene then equals one that is loaded with the moved shapes, but for rounding.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.moved = False
        self._scene = scene
        self._at: list[Matrix] = [np.eye(4) for _ in scene.shapes()]  # motion of each shape
        self._home: dict[str, Any] = {}  # values of parameters before the first motion

    def move(self, motions: Sequence[Matrix | None]) -> bool:
        """Move each shape, in the scene's order, by its motion from where it was loaded; None: no motion.

        Returns False, without moving any shape, if one of them cannot be moved in place.
        """
        import mitsuba as mi

        shapes, wanted = self._scene.shapes(), [np.eye(4) if motion is None else motion for motion in motions]
        if len(shapes) != len(wanted):  # groups and their instances
            return False
        differ = [k for k, motion in enumerate(wanted) if not np.array_equal(motion, self._at[k])]
        if not differ:
            return True
        parameters = mi.traverse(self._scene)
        names = [_places(shapes[k], parameters) for k in differ]
        if not all(names):
            return False
        for k, own in zip(differ, names, strict=True):
            for name in own:
                self._move(parameters, name, wanted[k])
            self._at[k] = wanted[k]
        parameters.update()
        self.moved = True
        return True

    def _move(self, parameters: mi.SceneParameters, name: str, motion: Matrix) -> None:
        """Set one parameter to its first value, moved."""
        import mitsuba as mi

        from ..jit.from_numpy import from_numpy
        from ..jit.mesh_buffers import motions_of, shaped_like

        fourth = motions_of([name], name.rpartition(".")[0] + ".").get(name)
        if fourth is not None:
            home = self._home.setdefault(name, np.array(parameters[name], np.float64).reshape(-1, 3))
            moved = home @ motion[:3, :3].T + fourth * motion[:3, 3]
            parameters[name] = shaped_like(parameters[name], from_numpy(mi.Float, moved))
        else:
            home = self._home.setdefault(name, np.array(parameters[name].matrix, np.float64).reshape(4, 4))
            parameters[name] = mi.Transform4f(motion @ home)


def _places(shape: mi.Shape, parameters: mi.SceneParameters) -> list[str]:
    """Names of the parameters that determine the position of a shape; empty if it has none of them."""
    from ..jit.mesh_buffers import motions_of

    if shape.is_mesh():
        return [name for name in motions_of(parameters, f"{shape.id()}.") if np.size(parameters[name])]
    placement = f"{shape.id()}.to_world"
    return [placement] if placement in parameters else []
