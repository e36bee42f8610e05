"""The methods that `converge` compares: the integral in both forms, the paper's sum over points, and Monte Carlo.

Each has one accuracy parameter, its knob: rtol, number of points, or samples per pixel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..rendering.monte_carlo import passes, tracer
from .convergence import DIRECT_SUM, INTEGRAL, PATH, PTRACER, SURFACE_FORM

if TYPE_CHECKING:
    import mitsuba as mi

SAMPLERS = ("multijitter", "independent", "stratified", "orthogonal", "ldsampler")
RTOL = (1.0, 0.5, 0.2, 0.05, 0.03, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
RTOL_SURFACE = (0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)
# Square roots of the samples per pixel; the orthogonal array needs primes.
SIDES = (2, 4, 6, 8, 10, 12, 16, 23, 32, 45, 64, 91, 128)
PRIMES = (2, 5, 11, 17, 23, 31, 47, 67, 89, 127)
POWERS_OF_TWO = (2, 4, 8, 16, 32, 64, 128)
PASS_SAMPLES = 1 << 26  # Monte Carlo samples in one pass: 1024 a pixel of 256 x 256
POINTS, MOST_POINTS = 1 << 10, 1 << 26  # least and largest number of points of the paper's sum

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class RunResult:
    """Result of a run: power, shape (h, w) [W]; number of rays; the knob's value, which may be rounded."""

    power: Plane
    rays: int
    knob: float


@dataclass(frozen=True)
class Method:
    """A method with the `values` of its `knob`, from coarse to fine; `prepare(value)` returns a function to run.

    Computations that a method makes once per scene are part of the first run of that function, not of `prepare`.
    """

    name: str
    knob: str
    values: tuple[float, ...]
    prepare: Callable[[float], Callable[[], RunResult]]


def methods(scene: mi.Scene, lens: mi.Sensor, least_rtol: float = 0.0) -> tuple[list[Method], dict[str, str]]:
    """The methods that apply to a scene, and the reason for each that does not.

    `least_rtol`: finest rtol of the integral's pupil form.
    """
    found = [integral(scene, lens, "pupil", tuple(rtol for rtol in RTOL if rtol >= least_rtol))]
    skipped = {}
    surfaces, reason = _surfaces_and_pupil(scene, lens)
    if surfaces:
        found += [integral(scene, lens, "surface", RTOL_SURFACE), _point_sum(scene, lens)]
    else:
        skipped = dict.fromkeys((SURFACE_FORM, DIRECT_SUM, PTRACER), reason)
    found += [_path(scene, lens, sampler) for sampler in SAMPLERS]
    found += [_ptracer(scene, lens)] if surfaces else []
    return found, skipped


def integral(scene: mi.Scene, lens: mi.Sensor, domain: str, values: tuple[float, ...]) -> Method:
    """The deterministic integral over the pixels' area, with rtol as its knob; the scene's integrator is not used.

    rtol = 1 means four lines of sight per pixel, without refinement.
    """
    import mitsuba as mi

    def prepare(rtol: float) -> Callable[[], RunResult]:
        accuracy = {"rtol": rtol} if rtol < 1 else {"rtol": 0.5, "max_nodes": 4}
        integrator = mi.load_dict({"type": "fspt_integral", "domain": domain, **accuracy})

        def run() -> RunResult:
            solution = integrator.solve(scene, lens)
            return RunResult(solution.power, solution.rays, rtol)

        return run

    return Method(INTEGRAL if domain == "pupil" else SURFACE_FORM, "rtol", values, prepare)


def _surfaces_and_pupil(scene: mi.Scene, lens: mi.Sensor) -> tuple[bool, str]:
    """Whether light can be traced from the surfaces to the pupil, and if not, why."""
    import mitsuba as mi

    from ..camera.of_sensor import camera_of
    from ..integral.lines.specular import Specular

    camera = camera_of(lens)
    if camera.lens.model.name == "pinhole":
        return False, "a pinhole is no disc that light from the surface could meet"
    for emitter in scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            return False, f"the emitter {emitter.class_name()} has no surface"
    if specular := Specular.of(scene, camera):
        return False, f"light reaches the lens through or off specular shapes: {', '.join(specular.names)}"
    return True, ""


def _point_sum(scene: mi.Scene, lens: mi.Sensor) -> Method:
    """The paper's sum over surface points."""
    from ..camera.of_sensor import camera_of
    from ..validation import direct_summation

    camera = camera_of(lens)
    # At a minimum of 1 the faces of a mesh are not divided. Minima that give the same number of points are one setting.
    minima = (1, *itertools.takewhile(lambda n: n <= MOST_POINTS, (POINTS * 4**k for k in itertools.count())))
    counts = {direct_summation.points_of(scene, minimum): minimum for minimum in reversed(minima)}

    def prepare(points: float) -> Callable[[], RunResult]:
        def run() -> RunResult:
            power, pairs = direct_summation.solve(scene, camera, counts[int(points)])
            return RunResult(power, pairs, points)

        return run

    values = tuple(float(count) for count in sorted(counts) if count > 2)
    return Method(DIRECT_SUM, "points", values, prepare)


def _path(scene: mi.Scene, lens: mi.Sensor, sampler: str) -> Method:
    """Mitsuba's `path` of depth 1 from a copy of the lens with this sampler; the copy is not in the scene."""
    sides = {"multijitter": SIDES, "orthogonal": PRIMES}.get(sampler, POWERS_OF_TWO)
    return Method(PATH + sampler, "spp", _squares(sides), _monte_carlo("path", scene, lens_with(lens, sampler)))


def _ptracer(scene: mi.Scene, lens: mi.Sensor) -> Method:
    """Mitsuba's particle tracer."""
    own_lens = lens_with(lens, "independent")
    return Method(PTRACER, "spp", _squares(POWERS_OF_TWO), _monte_carlo("ptracer", scene, own_lens))


def _squares(sides: tuple[int, ...]) -> tuple[float, ...]:
    return tuple(float(side * side) for side in sides)


def lens_with(lens: mi.Sensor, sampler: str) -> mi.Sensor:
    """A copy of an `fspt_lens` and its film with another sampler."""
    import mitsuba as mi

    from ..camera.of_sensor import camera_of

    own, camera = dict(mi.traverse(lens)), camera_of(lens)
    numbers = {name: float(value[0]) for name, value in own.items() if isinstance(value, mi.Float64)}
    numbers.pop("wavelength_nm", None)  # belongs to a curve; `numbers` has the curve's transmittance there
    numbers["transmittance"] = camera.filters.transmittance
    bent = {} if camera.lens.distortion is None else {"distortion": str(camera.lens.distortion)}
    bent |= {} if camera.vignetting is None else {"vignetting": camera.vignetting.file}
    film = camera.film
    names = ("width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
    sizes = (*film.size, *film.crop_size, *film.crop_offset)
    return mi.load_dict(
        {
            "type": "fspt_lens",
            **numbers,
            **bent,
            "model": camera.lens.model.name,
            "to_world": mi.ScalarTransform4f(np.array(camera.placement).reshape(4, 4)),
            "film": {"type": "hdrfilm", "pixel_format": "luminance", **dict(zip(names, sizes, strict=True))},
            "sampler": {"type": sampler},
        }
    )


def _monte_carlo(kind: str, scene: mi.Scene, lens: mi.Sensor) -> Callable[[float], Callable[[], RunResult]]:
    """`prepare` for a number of samples per pixel, in as few passes as memory permits; every run has another seed."""
    from ..emission.of_emitter import probe_beside

    probe_beside(scene)
    integrator, seed = tracer(kind, scene, lens), itertools.count(1)
    pixels = math.prod(int(n) for n in lens.film().crop_size())

    def prepare(spp: float) -> Callable[[], RunResult]:
        count = math.ceil(spp * pixels / PASS_SAMPLES)

        def run() -> RunResult:
            total, samples = np.zeros(()), 0
            for power, taken in passes(scene, lens, integrator, itertools.islice(seed, count), math.ceil(spp / count)):
                total, samples = total + power, samples + taken
            return RunResult(total / count, samples * pixels, samples)

        return run

    return prepare


def raw_rate(scene: mi.Scene, lens: mi.Sensor, together: bool, least: int = 1 << 20) -> Callable[[], int]:
    """A function that only traces rays, reads them from memory, writes the intersections to memory, and counts them.

    The rays are lines of sight like the integral's: four nodes on every pixel that can see a glowing surface, rotated
    about the pupil's centre until there are `least` rays. Rays of neighbouring pixels are neighbours in memory.
    `together`: Embree traces them in packets, else one by one. Pixels that cannot see a glowing surface have no rays
    here. As such rays are far faster to trace, a method with many of them may reach more rays per second than this.
    """
    import drjit as dr
    import mitsuba as mi

    from ..camera.of_sensor import camera_of
    from ..integral.lines.visible_window import visible_window
    from ..integral.pupil import node_rules
    from ..jit.from_numpy import from_numpy
    from ..jit.pixel_grid import Grid

    camera = camera_of(lens)
    window = visible_window(scene, camera)
    pixels = math.prod(window.shape)
    rule = node_rules.four(True)
    turns = max(1, math.ceil(least / (len(rule) * pixels)))
    angle = np.arange(turns)[:, None] * (math.pi * (3 - math.sqrt(5)))
    x, y = rule.pupil.T
    pupil = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])
    columns = np.concatenate([pupil.reshape(2, -1), np.tile(rule.pixel.T, turns)])
    node = dr.arange(mi.UInt32, pixels * columns.shape[1])
    pixel, node = dr.gather(mi.UInt32, Grid(window.shape).pixels(), node % pixels), node // pixels
    ax, ay, dx, dy = (dr.gather(mi.Float, from_numpy(mi.Float, column), node) for column in columns)
    ray, _, _ = camera.line_of_sight(window.centres(pixel) + mi.Point2f(dx, dy), mi.Point2f(ax, ay))
    dr.eval(ray)

    def run() -> int:
        hits = scene.ray_intersect_preliminary(ray, coherent=together)  # type: ignore[call-overload]  # a bool
        dr.eval(hits)
        dr.sync_thread()
        return len(node)

    return run
