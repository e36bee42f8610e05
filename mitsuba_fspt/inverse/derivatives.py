"""Derivatives of the power on the pixels by the parameters of a scene: central differences of the integral."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.image import Image
from ..rendering.live_scene import LiveScene
from ..rendering.provenance import source_of
from ..rendering.render import render
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import SceneXml, is_text, read_text, read_xml
from ..runtime.errors import FsptError, InversionError
from ..runtime.numbers import number

if TYPE_CHECKING:
    import mitsuba as mi

Array = NDArray[np.float64]

COARSEST = 1e-3  # first rtol of the integrals; their errors are stated in any case
GROWTH = 10  # times the lines of sight for a tenth of rtol, where the error falls with their inverse


@dataclass(frozen=True, eq=False)
class Derivative:
    """dP/dname of one parameter.

    value : (h, w), W per unit of the parameter;  error : (h, w), estimated absolute error of it
    step : of the shorter of the two central differences it was taken from, in the unit of the parameter
    """

    value: Array
    error: Array
    step: float


@dataclass(frozen=True)
class Steps:
    """Steps h of the central differences, doubled or halved from `first` times the parameter (times 1 where it is 0).

    Two differences with h and h/2 give one of fourth order. Its error is estimated by half its change from 2h to h, and
    by the errors of the integrals over h: the first falls with h, the second grows. The step is taken for which their
    sum, root mean square over the pixels, is least.

    The integrals begin with `COARSEST` and take a tenth of that until the derivative is as accurate as wanted.

    most : times that the first step is doubled, or halved, at the most
    error : wanted of the derivative, root mean square over the pixels, relative to that of the derivative
    rtol : the smallest of the integrals;  lines : of sight that all images of a derivative may take, about
    """

    first: float = 0.02
    most: int = 6
    error: float = 5e-3
    rtol: float = 1e-5
    lines: int = 50_000_000


def derivatives(
    scene: mi.Scene | str | os.PathLike[str],
    names: Sequence[str],
    /,
    *,
    rtol: float | None = None,
    sensor: int = 0,
    steps: Steps | None = None,
    **parameters: object,
) -> dict[str, Derivative]:
    """Derivatives of the power on each pixel by `<default>` parameters of a scene, silhouettes included.

        D = fspt.derivatives("scene.xml", ["f_number", "view"])
        D["view"].value, D["view"].error   # (h, w), W per degree

    Parameters
    ----------
    scene : name or text of a scene file, or a scene that `load` made of one. Its file or text is loaded again with the
        values that it was loaded with: what was changed in a loaded scene afterwards has no effect
    names : of `<default>` parameters that are numbers, but for those of the film and of the integrator
    rtol : of the integral, relative to the brightest pixel. Unless given, 1e-3, 1e-4 or 1e-5: the first for which the
        stated error is 0.5 % of the derivative, root mean square, or of which the next would take too many lines of
        sight (`Steps`)
    sensor : number of the sensor
    steps : how the step is chosen
    parameters : values of `<default>` parameters at which the derivatives are taken

    Raises
    ------
    InversionError : a name is no parameter, no number, or sets the film or the accuracy; a loaded scene that `load`
        did not make of a file or text.
    SceneError, OpticsError, ExitanceError : as `render`.
    """
    steps = steps or Steps()
    file, parameters = origin(scene, parameters)
    xml = scene_text(file, parameters)
    values = {name: varied_value(xml, name) for name in _listed(names)}
    live = LiveScene(file, parameters, sensor, any_sensor=True)

    def image(rtol: float, change: Mapping[str, float]) -> Image:
        return render(live.scene(change), method="integral", sensor=sensor, rtol=rtol)

    if rtol is not None:
        one = partial(image, rtol)
        return {name: _Differences(name, value, one, steps).best() for name, value in values.items()}
    return {name: _as_accurate_as_wanted(name, value, image, steps) for name, value in values.items()}


def _as_accurate_as_wanted(
    name: str, value: float, image: Callable[[float, Mapping[str, float]], Image], steps: Steps
) -> Derivative:
    """The derivative by integrals of the largest rtol that reaches `steps.error`, or that `steps.lines` allow."""
    rtol = max(COARSEST, steps.rtol)
    while True:
        differences = _Differences(name, value, partial(image, rtol), steps)
        found = differences.best()
        reached = _size(found.error) <= steps.error * _size(found.value)
        if reached or rtol <= steps.rtol or GROWTH * differences.lines > steps.lines:
            return found
        rtol = max(rtol / 10, steps.rtol)


class _Differences:
    """Central differences of an image by one parameter at its value, for steps of any power of 2 of the first."""

    def __init__(self, name: str, value: float, image: Callable[[Mapping[str, float]], Image], steps: Steps) -> None:
        self._name, self._value, self._image, self._steps = name, value, image, steps
        self._first = steps.first * (abs(value) or 1.0)
        self._known: dict[int, tuple[Array, Array]] = {}
        self.lines = 0  # of sight of all images

    def best(self) -> Derivative:
        """The derivative of the least estimated error; from the first steps on, steps get longer where the errors of
        the integrals are the larger part, and else shorter."""
        best, noise = self._derivative(0)
        way = 1 if _size(noise) > 0.5 * _size(best.error) else -1
        for doubled in range(way, way * (self._steps.most + 1), way):
            try:
                found, _ = self._derivative(doubled)
            except FsptError:  # no scene with a value so far off
                break
            if _size(found.error) >= _size(best.error):
                break
            best = found
        return best

    def _derivative(self, doubled: int) -> tuple[Derivative, Array]:
        """The derivative with a step that is doubled so often, and what of its error is from the integrals."""
        slopes = [self._slope(k) for k in (doubled + 2, doubled + 1, doubled)]
        coarse, fine = ((4 * one[0] - two[0]) / 3 for two, one in itertools.pairwise(slopes))
        noise = (4 * slopes[2][1] + slopes[1][1]) / 3
        return Derivative(fine, np.abs(fine - coarse) / 2 + noise, self._first * 2.0**doubled), noise

    def _slope(self, doubled: int) -> tuple[Array, Array]:
        """Central difference and the errors of its integrals."""
        if doubled not in self._known:
            step = self._first * 2.0**doubled
            high, low = (self._image({self._name: self._value + sign * step}) for sign in (1, -1))
            self.lines += sum(int(one.metadata.get("nodes", 0)) for one in (high, low))
            slope = (high.power.astype(np.float64) - low.power) / (2 * step)
            error: Array = np.asarray(high.error, np.float64) + np.asarray(low.error, np.float64)
            self._known[doubled] = slope, error / (2 * step)
        return self._known[doubled]


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _listed(names: Sequence[str]) -> Sequence[str]:
    if isinstance(names, str) or not names:
        raise InversionError(f"derivatives: the second argument must be a list of names, got {names!r}. Give ['view'].")
    return names


def origin(scene: Any, parameters: Mapping[str, object]) -> tuple[Any, dict[str, object]]:
    """File or text of a scene, and all values that it is given; of a loaded one, those that it was loaded with, too."""
    if isinstance(scene, Mapping):
        raise InversionError("derivatives: a dictionary has no parameters. Give a scene file with <default> values.")
    if isinstance(scene, (str, os.PathLike)):
        return scene, dict(parameters)
    kept = source_of(scene) if hasattr(scene, "sensors") else None
    if kept is None:
        raise InversionError(
            f"derivatives: a {type(scene).__name__} that fspt.load did not make of a file or text has no parameters. "
            "Give the name of its file."
        )
    return kept[0], {**kept[1], **parameters}


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
    names = _filled_from(xml, name)
    for node in xml.nodes:
        inside = [node, *node.iter()] if node.tag == "integrator" else [node] if node.tag == "integer" else []
        if any(_uses(text, names) for part in inside for text in part.attrib.values()):
            raise InversionError(
                f"derivatives: '{name}' sets the film or the accuracy, on which no power depends smoothly. Leave it."
            )
    return number(f"derivatives: '{name}'", float(known[name]), InversionError, "1.0")


def _filled_from(xml: SceneXml, name: str) -> set[str]:
    """A parameter and those whose own `<default>` values contain it."""
    names, size = {name}, 0
    while len(names) > size:
        size = len(names)
        for node in xml.nodes:
            if node.tag == "default" and _uses(node.get("value", ""), names):
                names.add(node.get("name", ""))
    return names


def _uses(text: str, names: set[str]) -> bool:
    return any(word in text.replace(",", " ").split() for word in (f"${name}" for name in names))
