"""Images of a scene by the deterministic integral, or by Mitsuba's Monte Carlo with its standard error."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.image import Image
from ..integral.shortcuts import SHORTCUTS
from ..runtime import backend
from ..runtime.deadline import Deadline, required_time
from ..runtime.errors import SceneError, named
from ..runtime.numbers import whole
from ..runtime.plugin_types import is_integral
from ..runtime.progress_bar import Progress, reported
from ..runtime.versions import versions
from . import monte_carlo
from .provenance import origin_of
from .scene import loaded

if TYPE_CHECKING:
    import mitsuba as mi

    from ..camera.camera import Camera

METHODS = ("integral", *monte_carlo.METHODS)
PASSES = 32  # independent Monte Carlo passes whose scatter gives the standard error
SAMPLES_IN_FLIGHT = 1 << 23  # Monte Carlo samples of one pass, which bounds its memory
DARK = (
    "the picture is dark, no light reaches the lens. Check the lens's 'to_world', that 'exitance' is not 0 everywhere, "
    "and that the faces' normals point outwards"
)


def render(
    scene: mi.Scene | str | os.PathLike[str] | Mapping[str, object],
    *,
    method: str | None = None,
    sensor: int = 0,
    rtol: float | None = None,
    domain: str | None = None,
    pixel: str | None = None,
    max_nodes: int | None = None,
    max_specular: int | None = None,
    shortcuts: bool = True,
    spp: int | None = None,
    max_depth: int | None = None,
    seed: int | None = None,
    max_time: float | None = None,
    progress: Progress | None = None,
) -> Image:
    """Image of a scene, power in W on every pixel, with its error and coverage.

    Parameters
    ----------
    scene : Mitsuba scene, or what `load` takes
    method : 'integral' (Eq. 9, deterministic), 'path' or 'ptracer' (Monte Carlo); None takes the scene's own
    sensor : number of the sensor, an `fspt_lens`
    rtol, domain, pixel, max_nodes, max_specular : parameters of `fspt_integral`, see there; None takes the scene's own
    shortcuts : False: the integral also does work that the scene does not need; True takes the scene's own setting
    spp : Monte Carlo samples per pixel, >= 2 (default 256). The error is the standard error of independent passes. On a
        pixel where no sample met light although one could have, it is about the power of a single sample
    max_depth : segments of light paths that path and ptracer follow (default: 1, or 1 + max_specular in a scene with
        specular surfaces)
    seed : of the Monte Carlo, 0 … 2³² - 1 (default 0)
    max_time : [s], after which no further batch of lines of sight, or pass, begins; None: no limit. The image is the
        best so far, with the errors of the level that each pixel has reached, and `warnings` and `stopped_after` [s]
        say so. Every pixel takes four lines of sight in any case, or two passes
    progress : function called with the name of the stage and the share done, 0 … 1

    If `rtol` was not reached, light after a scattering reflection is left out, the image is dark, or the method does
    not treat a part of the scene, such as a medium, the metadata state so in `warnings`.

    Raises
    ------
    SceneError : the scene, or a setting, cannot be used.
    OpticsError : the lens cannot exist.
    ExitanceError : J_n is missing, negative or not finite.
    BackendError : no working LLVM or CUDA.
    """
    scene = loaded(scene)
    backend.ensure_variant()
    sensor = whole("render: 'sensor'", sensor, SceneError, "0")
    deadline = Deadline(max_time := required_time("render", max_time, SceneError))
    lens: Any = sensor_of(scene, sensor)
    accuracy: dict[str, Any] = {"rtol": rtol, "domain": domain, "pixel": pixel, "max_nodes": max_nodes}
    accuracy |= {"max_specular": max_specular, "shortcuts_off": None if shortcuts else frozenset(SHORTCUTS)}
    integrator = _integrator(scene, lens, method, accuracy, {"spp": spp, "seed": seed}, max_depth)
    with reported(progress) as report:
        power, error, coverage, how = _timed(scene, lens, integrator, accuracy, (spp, seed), report, deadline)
    how |= ({} if max_time is None else {"max_time": max_time}) | _warned(how, power, scene, lens, integrator)
    origin, numbers = origin_of(scene, lens), _lens_numbers(lens)
    return Image(power, error, coverage, {**origin, "sensor": sensor, **how, **numbers, **_versions()})


def _lens_numbers(lens: mi.Sensor) -> dict[str, float | int | str]:
    """Numbers of the lens and its film for the metadata, with the radius of the Airy disc."""
    from ..camera.of_sensor import camera_of

    camera = camera_of(lens)
    return {**camera.numbers(), "airy_radius": camera.airy_radius}


def _timed(
    scene: mi.Scene,
    lens: mi.Sensor,
    integrator: mi.Integrator,
    accuracy: dict,
    sampling: tuple[int | None, int | None],
    progress: Progress,
    deadline: Deadline,
) -> tuple:
    """Power, error [W] and coverage, shape (h, w), by an integrator, and metadata with the time that it took [s]."""
    start = time.perf_counter()
    if is_integral(integrator):
        *planes, how = _integrate(scene, lens, integrator, accuracy, progress, deadline)
    else:
        spp, seed = (default if given is None else given for given, default in zip(sampling, (256, 0), strict=True))
        *planes, how = _sample(scene, lens, integrator, spp, seed, progress, deadline)
    how |= {"wall_time": time.perf_counter() - start}
    return *planes, how | ({"stopped_after": how["wall_time"]} if deadline.cut else {})


def _warned(
    how: dict, power: NDArray[np.float64], scene: mi.Scene, lens: mi.Sensor, integrator: mi.Integrator
) -> dict[str, str]:
    """The warnings of metadata `how`, that the picture is dark, and those about the scene."""
    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_warnings import scene_warnings

    dark = None if power.any() else DARK
    warnings = [
        text for text in (how.get("warnings"), dark, *scene_warnings(scene, camera_of(lens), integrator)) if text
    ]
    return {"warnings": "; ".join(warnings)} if warnings else {}


def warnings_of(scene: mi.Scene, sensor: int = 0) -> list[str]:
    """What is odd about a scene, or not treated by the integral: one line each, as in the metadata of its image."""
    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_warnings import scene_warnings

    return scene_warnings(scene, camera_of(sensor_of(scene, sensor)), integrator_of(scene, "integral"))


def _integrator(
    scene: mi.Scene, lens: mi.Sensor, method: str | None, accuracy: dict, sampling: dict, max_depth: int | None
) -> mi.Integrator:
    """Integrator of a method; SceneError for a method or a setting that does not exist or does not belong to it."""
    if method in monte_carlo.METHODS:
        integrator = monte_carlo.tracer(method, scene, lens, max_depth)
    else:
        _refuse({"max_depth": max_depth}, "the integral or the scene's own integrator")
        integrator = integrator_of(scene, method)
    if is_integral(integrator):
        _refuse(sampling, "integral")
    else:
        off = accuracy["shortcuts_off"] is not None
        _refuse(accuracy | {"shortcuts_off": None, "shortcuts": False if off else None}, "Monte Carlo")
    return integrator


def _integrate(
    scene: mi.Scene,
    lens: mi.Sensor,
    integrator: Any,  # an fspt_integral
    accuracy: dict,
    progress: Progress,
    deadline: Deadline,
) -> tuple:
    """Power, error [W] and coverage, shape (h, w), by the deterministic integral, and metadata."""
    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_checks import check_scene, check_surfaces_alone
    from ..integral.lines.specular import longest_course

    with named("fspt_integral"):
        quadrature = replace(integrator.quadrature, **{k: value for k, value in accuracy.items() if value is not None})
    check_scene(scene, camera_of(lens))
    check_surfaces_alone(scene)
    left_out = integrator.light_left_out(scene, lens, quadrature)  # first, as it takes its time in any case
    solution = integrator.solve(scene, lens, quadrature, partial(progress, "integrating"), deadline=deadline)
    how = {"method": "integral", **quadrature.metadata(), "nodes": solution.rays, "levels": "; ".join(solution.levels)}
    how["left_out"] = "; ".join(str(finding) for finding in solution.findings if finding.taken) or "nothing"
    warnings = []
    pixels, largest = solution.beyond(quadrature.rtol)
    if pixels:
        stopped = "stopped by max_time: " if deadline.cut else ""
        unmet = f"rtol {quadrature.rtol:g} not reached on {pixels} pixels (largest error {largest:.1e} of the peak)"
        warnings.append(stopped + unmet)
        if quadrature.max_specular < (surfaces := longest_course(scene)):
            warnings.append(
                f"light that panes reflect twice meets up to {surfaces} specular surfaces, of which 'max_specular' "
                f"follows {quadrature.max_specular}: a larger one may lower the error"
            )
    if left_out is not None:
        how["light_left_out"], how["light_left_out_error"] = left_out.share, left_out.error
        warnings += filter(None, [left_out.warning(quadrature.rtol)])
    if warnings:
        how["warnings"] = "; ".join(warnings)
    return solution.power, solution.error, solution.coverage, how


def _sample(
    scene: mi.Scene,
    lens: mi.Sensor,
    integrator: mi.Integrator,
    spp: int,
    seed: int,
    progress: Progress,
    deadline: Deadline,
) -> tuple:
    """Mean and standard error [W] of Monte Carlo passes and coverage, shape (h, w), in double precision; metadata."""
    from ..camera.of_sensor import camera_of
    from ..emission.of_emitter import probe_beside
    from ..integral.lines.scene_checks import check_scene
    from ..integral.pupil.pupil_form import coverage
    from ..jit.recording import recording

    camera = camera_of(lens)
    check_scene(scene, camera)
    spp = whole("render: 'spp'", spp, SceneError, "256")
    seed = whole("render: 'seed'", seed, SceneError, "1")
    if spp < 2:
        raise SceneError(f"render: 'spp' must be >= 2 for a standard error, got {spp}. Give for example 256.")
    if not 0 <= seed < 1 << 32:
        raise SceneError(f"render: 'seed' must be in 0 … 2^32 - 1, got {seed}. Give for example 1.")
    probe_beside(scene)
    followed = _followed(scene, lens, integrator)  # first, as it takes its time in any case
    pixels = math.prod(camera.film.shape)
    count = max(min(PASSES, spp), math.ceil(spp * pixels / SAMPLES_IN_FLIGHT))
    lens.sampler().set_sample_count(math.ceil(spp / count))
    each = lens.sampler().sample_count()  # some samplers round up, with a warning: here once, not in every pass
    seeds = (int(np.random.SeedSequence((seed, k)).generate_state(1)[0]) for k in range(count))
    total = squares = np.zeros(())
    samples = 0
    progress("sampling", 0.0)
    for k, (power, taken) in enumerate(monte_carlo.passes(scene, lens, integrator, seeds, each), 1):
        total, squares, samples = total + power, squares + power * power, samples + taken
        progress("sampling", k / count)
        if 2 <= k < count and deadline.passed():
            break
    wanted, count = count, k
    mean = total / count
    name = {"PathIntegrator": "path", "ParticleTracerIntegrator": "ptracer", "VolumetricPathIntegrator": "volpath"}
    how: dict[str, Any] = {
        "method": name.get(integrator.class_name(), integrator.class_name()),
        "sampler": lens.sampler().class_name(),
        "spp": samples,
        "passes": count,
        "seed": seed,
    }
    how |= followed
    if count < wanted:
        stopped = f"stopped by max_time after {count} of {wanted} passes"
        how["warnings"] = "; ".join([stopped, *([how["warnings"]] if "warnings" in how else [])])
    error = monte_carlo.standard_error(mean, squares / count, count, samples)
    with recording():
        met = coverage(scene, camera)
    return mean, np.where((mean > 0) | _can_see(scene, camera), error, 0), met, how


def _followed(scene: mi.Scene, lens: mi.Sensor, integrator: mi.Integrator) -> dict[str, object]:
    """Metadata of the paths that a Monte Carlo follows: `max_depth`, and the share of the light that it leaves out."""
    from ..camera.of_sensor import camera_of
    from ..integral.lines.left_out import light_left_out
    from ..integral.lines.scene_warnings import treats_media
    from ..integral.quadrature import Quadrature

    depth = monte_carlo.depth_of(integrator)
    if depth is None:
        return {}
    how: dict[str, object] = {"max_depth": depth}
    if depth < 0 or treats_media(integrator):  # whose light takes other paths
        return how
    own = getattr(scene.integrator(), "quadrature", Quadrature())
    if (left_out := light_left_out(scene, camera_of(lens), own, depth)) is not None:
        how |= {"light_left_out": left_out.share, "light_left_out_error": left_out.error}
        if warning := left_out.warning(own.rtol):
            how["warnings"] = warning
    return how


def _can_see(scene: mi.Scene, camera: Camera) -> NDArray[np.bool_]:
    """True, shape (h, w), on pixels with lines of sight to an emitter (Eq. 4) that no image-plane stop blocks."""
    from ..integral.lines.visible_window import visible_window

    window = visible_window(scene, camera)
    inside, cut = window.field_stop(camera)
    return window.expand((inside | cut).astype(np.float64)) > 0


def sensor_of(scene: mi.Scene, number: int) -> mi.Sensor:
    """Sensor `number` of a scene; SceneError if it does not exist, or `scene` is no scene of the active variant."""
    _check_kind(scene)
    sensors = scene.sensors()
    if not 0 <= number < len(sensors):
        rule = f"Give 0 to {len(sensors) - 1}." if sensors else "Give it an 'fspt_lens'."
        raise SceneError(f"scene: sensor {number} does not exist, the scene has {len(sensors)}. {rule}")
    return sensors[number]


def _check_kind(scene: object) -> None:
    """Raise SceneError unless `scene` is a scene of the active variant."""
    import mitsuba as mi

    if isinstance(scene, mi.Scene):
        return
    home = getattr(scene, "variant_name", None)
    if type(scene).__name__ == "Scene" and home is not None:
        raise SceneError(
            f"scene: loaded in the variant {home()}, which none but that can render; the active one is {mi.variant()}. "
            "Load it again, or set its variant."
        )
    raise SceneError(
        f"scene: must be a Mitsuba scene or the name of a file, got {type(scene).__name__}. Give what `load` returns."
    )


def integrator_of(scene: mi.Scene, method: str | None) -> mi.Integrator:
    """Integrator of the scene's own method (None), or of 'integral': the scene's own, if it fits.

    Raises
    ------
    SceneError : the method is another one, or the scene's own integrator gives no power.
    """
    import mitsuba as mi

    own = scene.integrator()
    if method is None and own is not None:
        # Depth and further output channels (AOVs) are no power.
        if own.class_name() == "DepthIntegrator" or own.aov_names():
            raise SceneError(
                f"scene: integrator {own.class_name()} gives no power. Give the scene an 'fspt_integral' or 'path', or "
                "set 'method'."
            )
        _require_light(scene, own)
        return own
    if method in (None, "integral"):
        return own if is_integral(own) else mi.load_dict({"type": "fspt_integral"})
    raise SceneError(f"render: 'method' must be one of {', '.join(METHODS)}, got '{method}'.")


def _require_light(scene: mi.Scene, integrator: mi.Integrator) -> None:
    """Raise SceneError if a Monte Carlo leaves out light that goes straight to the lens: its image would be dark."""
    if not any(type(emitter).__name__ == "FsptSurface" for emitter in scene.emitters()):
        return
    hidden = "'hide_emitters' = true" if getattr(integrator, "hide_emitters", False) else None
    if hidden is None and re.search(r"\bmax_depth = 0\b", str(integrator)):  # only its description states it
        hidden = "'max_depth' = 0"
    if hidden:
        raise SceneError(
            f"scene: integrator {integrator.class_name()} with {hidden} leaves out what surfaces send straight to the "
            "lens. Leave that parameter out, or set 'method'."
        )


def _refuse(settings: dict[str, object], method: str) -> None:
    """Raise SceneError for a given setting that has no meaning for the method."""
    for name, value in settings.items():
        if value is not None:
            raise SceneError(f"render: '{name}' = {value} has no meaning for {method}. Leave it out or set 'method'.")


def _versions() -> dict[str, str]:
    import mitsuba as mi

    return {
        "variant": str(mi.variant()),
        "versions": ", ".join(f"{name} {number}" for name, number in versions().items()),
    }
