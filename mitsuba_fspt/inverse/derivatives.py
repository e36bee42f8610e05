"""Derivatives of the power on the pixels by the parameters of a scene: central differences of the integral."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..images.image import Image
from ..rendering.render import render
from ..rendering.scene import load
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import SceneXml, is_text, read_text, read_xml
from ..runtime.errors import InversionError
from ..runtime.numbers import number

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Derivative:
    """dP/dname of one parameter.

    value : (h, w), W per unit of the parameter;  error : (h, w), estimated absolute error of it
    step : of the central difference that was chosen, in the unit of the parameter
    """

    value: Array
    error: Array
    step: float


@dataclass(frozen=True)
class Steps:
    """Steps of the central differences: `first` times the parameter (times 1 where it is 0), each half of the last.

    With the step h the error of the difference falls with h², that of the two integrals over h grows: the step is taken
    for which their sum, root mean square over the pixels, is least.

    count : most steps;  rtol : of the integrals, unless given
    """

    first: float = 0.02
    count: int = 6
    rtol: float = 1e-5


def derivatives(
    scene: str | os.PathLike[str],
    names: Sequence[str],
    /,
    *,
    rtol: float | None = None,
    sensor: int = 0,
    steps: Steps | None = None,
    **parameters: object,
) -> dict[str, Derivative]:
    """Derivatives of the power on each pixel by `<default>` parameters of a scene file, silhouettes included.

        D = fspt.derivatives("scene.xml", ["f_number", "view"])
        D["view"].value, D["view"].error   # (h, w), W per degree

    Parameters
    ----------
    scene : name or text of a scene file
    names : of `<default>` parameters that are numbers, but for those of the film and of the integrator
    rtol : of the integral, relative to the brightest pixel
    sensor : number of the sensor
    steps : how the step is chosen
    parameters : values of `<default>` parameters at which the derivatives are taken

    Raises
    ------
    InversionError : a name is no parameter, no number, or sets the film or the accuracy.
    SceneError, OpticsError, ExitanceError : as `render`.
    """
    steps = steps or Steps()
    xml = scene_text(scene, parameters)
    values = {name: varied_value(xml, name) for name in _listed(names)}
    accuracy = steps.rtol if rtol is None else rtol

    def picture(change: Mapping[str, float]) -> Image:
        return render(load(scene, **{**parameters, **change}), method="integral", sensor=sensor, rtol=accuracy)

    return {name: _derivative(name, value, picture, steps) for name, value in values.items()}


def _derivative(name: str, value: float, picture: object, steps: Steps) -> Derivative:
    """Central difference with the step of the least estimated error."""
    best: Derivative | None = None
    before: Array | None = None
    step = steps.first * (abs(value) or 1.0)
    for _ in range(steps.count):
        high, low = (picture({name: value + sign * step}) for sign in (1, -1))  # type: ignore[operator]
        width = 2 * step
        slope = (high.power.astype(np.float64) - low.power) / width
        noise = (high.error.astype(np.float64) + low.error) / width
        if before is not None:
            # The difference of two steps is three times what the halved one is still wrong by, for an error ~ h².
            found = Derivative(slope, np.abs(slope - before) / 3 + noise, step)
            if best is not None and _size(found.error) > _size(best.error):
                break
            best = found
        before, step = slope, step / 2
    if best is None:
        raise InversionError(f"derivatives: 'count' must be at least 2 steps, got {steps.count}. Give for example 6.")
    return best


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _listed(names: Sequence[str]) -> Sequence[str]:
    if isinstance(names, str) or not names:
        raise InversionError(f"derivatives: the second argument must be a list of names, got {names!r}. Give ['view'].")
    return names


def scene_text(scene: object, parameters: Mapping[str, object]) -> SceneXml:
    """XML of the scene with these values."""
    given = {name: str(value) for name, value in parameters.items()}
    if is_text(scene):
        return read_text(str(scene), given)
    if not isinstance(scene, (str, os.PathLike)):
        raise InversionError(
            f"derivatives: the scene must be a file with parameters, got {type(scene).__name__}. Give its name."
        )
    return read_xml(Path(scene), given)


def varied_value(xml: SceneXml, name: str) -> float:
    """Value of a parameter that can be varied; InversionError for any other."""
    known: dict[str, str] = {**xml.defaults, **xml.given}
    if name not in known:
        raise InversionError(f"derivatives: the scene has no parameter '{name}'. It has: {', '.join(known) or 'none'}.")
    if not is_number(known[name]):
        raise InversionError(f"derivatives: '{name}' = {known[name]!r} is no number. Leave it out.")
    for node in xml.nodes:
        inside = [node, *node.iter()] if node.tag == "integrator" else [node] if node.tag == "integer" else []
        if any(f"${name}" in text.replace(",", " ").split() for part in inside for text in part.attrib.values()):
            raise InversionError(
                f"derivatives: '{name}' sets the film or the accuracy, on which no power depends smoothly. Leave it."
            )
    return number(f"derivatives: '{name}'", float(known[name]), InversionError, "1.0")
