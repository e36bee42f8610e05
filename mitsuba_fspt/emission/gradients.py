"""Parameters of a scene that carry gradients, and the refusal of those that the integral cannot differentiate.

The power P on a pixel is linear in J_n, so that its derivative with respect to any number behind `exitance` is a sum
over lines of sight. Lens and shapes determine where a line of sight ends; a derivative with respect to them would need
an integral along silhouettes, which is not computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from ..runtime.errors import SceneError
from ..runtime.plugin_types import is_surface
from .emitting_surface import EmittingSurface
from .exitance import attribute_name
from .of_emitter import surfaces_of


def surfaces_with_gradients(scene: mi.Scene, sensor: mi.Sensor) -> list[EmittingSurface]:
    """Emitting surfaces of a scene whose J_n depends on numbers with gradients. To be called while gradients are on.

    Raises
    ------
    SceneError : a parameter with gradients is not one of the numbers behind `exitance`.
    """
    found, parameters = [], mi.traverse(scene)
    for surface in surfaces_of(scene):
        if any(dr.grad_enabled(value) for value in _behind_exitance(surface)):
            found.append(surface)
    _refuse_others(scene, parameters)
    _refuse_others(scene, mi.traverse(sensor))
    return found


def _behind_exitance(surface: EmittingSurface) -> Iterator[Any]:
    """Values of the numbers behind `exitance` that may have gradients."""
    parameters = mi.traverse(surface.exitance)
    yield from (parameters[key] for key in parameters.keys() if _differentiable(parameters, key))
    name, on_shape = attribute_name(surface.exitance), mi.traverse(surface.shape)
    if name is not None and name in on_shape:
        yield on_shape[name]


def _refuse_others(scene: mi.Scene, parameters: mi.SceneParameters) -> None:
    """Raise SceneError for a parameter with gradients that is not behind `exitance`."""
    attributes = {(surface.shape.id(), attribute_name(surface.exitance)) for surface in surfaces_of(scene)}
    for key in parameters.keys():
        if not dr.grad_enabled(parameters[key]):
            continue
        node, last = parameters.properties[key][2], key.rpartition(".")[2]
        on_mesh = isinstance(node, mi.Shape) and (node.id(), last) in attributes
        if not (on_mesh or (_below_surface(parameters, node) and _differentiable(parameters, key))):
            raise SceneError(
                f"fspt_integral: parameter '{key}' has gradients enabled, but the image is differentiable with "
                f"respect to 'exitance' alone. Call dr.disable_grad(params['{key}']), or use fspt.derivatives."
            )


def _differentiable(parameters: mi.SceneParameters, key: str) -> bool:
    return not parameters.flags(key) & mi.ParamFlags.NonDifferentiable


def _below_surface(parameters: mi.SceneParameters, node: Any) -> bool:
    """True for an `fspt_surface` and what belongs to it."""
    while node is not None:
        if isinstance(node, mi.Emitter):
            return is_surface(node)
        node = parameters.hierarchy[node][0]
    return False
