"""The shortcuts that the integral takes in a scene, with reasons and the share of the work that each saves; and where
the work goes: lines of sight and seconds of each step, and the pixels that take most lines of sight."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..integral.shortcuts import SHORTCUTS, Finding
from ..integral.work_log import WorkLog
from ..rendering.render import integrator_of, sensor_of
from ..rendering.scene import loaded
from ..runtime import backend
from ..runtime.errors import named
from ..runtime.extras import EXTRAS

if TYPE_CHECKING:
    from collections.abc import Callable

    import mitsuba as mi

    from ..integral.lines.left_out import LeftOut
    from ..integral.quadrature import Quadrature
    from ..integral.solution import Solution
    from ..runtime.progress_bar import Progress

ROUNDS = 3  # timed pairs of runs, of which the median counts; only one where a run takes longer than LONG [s]
LONG = 5.0
NO_GAIN = "no gain"  # printed if the saved time does not exceed the noise of its measurement
WHAT_WIDTH = 1 + max(len(what) for what in SHORTCUTS.values())


@dataclass(frozen=True)
class Explanation:
    """One row of the table: a computation that the integral may leave out.

    what : its name
    left_out : True if it is left out in this scene
    why : the reason
    lines_saved, time_saved : measured saving, as a share of the lines of sight and of the time without the shortcut, at
        most 1; None where it is not taken or cannot be switched off
    time_spread : half the difference between the largest and the smallest share of the time saved in any round; a
        median that does not exceed it is noise. 0 after a single round
    """

    what: str
    left_out: bool
    why: str
    lines_saved: float | None = None
    time_saved: float | None = None
    time_spread: float = 0.0

    @property
    def gains_time(self) -> bool:
        """True if the time saved is above 0 and above the noise of its measurement."""
        return self.time_saved is not None and self.time_saved > self.time_spread

    def render_text(self) -> str:
        """The row as text: what, left out or kept, lines of sight and time saved, why."""
        verdict = "left out" if self.left_out else "kept"
        lines, seconds = ("" if s is None else f"{100 * s:.0f} %" for s in (self.lines_saved, self.time_saved))
        if self.time_saved is not None and not self.gains_time:
            seconds = NO_GAIN
        return f"{self.what:<{WHAT_WIDTH}} {verdict:<9} {lines:>6} {seconds:>{len(NO_GAIN)}}  {self.why}"

    def to_dict(self) -> dict[str, str | bool | float | None]:
        """The row as plain data for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Work:
    """One row about the work: a step of the integration, or one of the pixels that take most lines of sight.

    what : name of the step; "pixel x, y" with column and row on the film
    pixels, lines : that took the step; lines of sight of all of them together
    seconds : of the step; None for a pixel
    """

    what: str
    pixels: int
    lines: int
    seconds: float | None = None

    def render_text(self) -> str:
        """The row as text: what, pixels, lines of sight, seconds."""
        seconds = "" if self.seconds is None else f"{self.seconds:.2f} s"
        return f"{self.what:<{WHAT_WIDTH}} {self.pixels:>9} {self.lines:>12} {seconds:>10}"

    def to_dict(self) -> dict[str, str | int | float | None]:
        """The row as plain data for JSON."""
        return asdict(self)


DEAREST = 10  # pixels that are listed
WORK_HEADER = f"{'':<{WHAT_WIDTH}} {'pixels':>9} {'lines':>12} {'time':>10}"
HEADER = f"{'':<{WHAT_WIDTH}} {'':<9} {'lines':>6} {'time':>{len(NO_GAIN)}}  (saved)"


def explain(
    scene: mi.Scene | str | os.PathLike[str],
    *,
    sensor: int = 0,
    rtol: float | None = None,
    domain: str | None = None,
    progress: Progress | None = None,
) -> list[Explanation]:
    """One row for every computation that the integral may leave out in a scene.

    Each shortcut that is taken is switched off in turn, to measure how many lines of sight and how much time it saves:
    three to seven images for each. Parameters and errors are those of `render`.
    """
    report = progress or (lambda what, share: None)
    scene = loaded(scene)
    variant = backend.ensure_variant()
    lens, integrator, quadrature = _parts(scene, sensor, rtol, domain)

    def solve(quadrature: Quadrature) -> tuple[Solution, float]:
        start = time.perf_counter()
        solution = integrator.solve(scene, lens, quadrature)
        return solution, time.perf_counter() - start

    solution, _ = solve(quadrature)
    rows = []
    for k, finding in enumerate(solution.findings):
        report(f"timing without a shortcut: {SHORTCUTS[finding.name]}", (1 + k) / (1 + len(solution.findings)))
        without = replace(quadrature, shortcuts_off=quadrature.shortcuts_off | {finding.name})
        saved = _saved(solve, quadrature, without) if finding.taken else ()
        rows.append(_row(finding, *saved))
    if (left_out := integrator.light_left_out(scene, lens, quadrature)) is not None:
        rows.append(_scattered(left_out))
    return [*rows, *_real_lens(lens), _diffraction(lens), *_never_done(scene, variant)]


def work(
    scene: mi.Scene | str | os.PathLike[str],
    *,
    sensor: int = 0,
    rtol: float | None = None,
    domain: str | None = None,
    progress: Progress | None = None,
) -> list[Work]:
    """One row for every step of the integration, in order, then the `DEAREST` pixels; parameters as of `explain`.

    The image is computed twice: kernels may be compiled first.
    """
    scene = loaded(scene)
    backend.ensure_variant()
    lens, integrator, quadrature = _parts(scene, sensor, rtol, domain)
    from ..camera.of_sensor import camera_of

    report = progress or (lambda what, share: None)
    report("timing steps", 0.0)
    integrator.solve(scene, lens, quadrature)
    report("timing steps", 0.5)
    log = WorkLog(camera_of(lens).pixel_pitch)
    integrator.solve(scene, lens, quadrature, log=log)
    steps = [Work(name, *numbers) for name, numbers in log.steps.items()]
    return [*steps, *(Work(f"pixel {x}, {y}", 1, lines) for x, y, lines in log.dearest(DEAREST))]


def _parts(scene: mi.Scene, sensor: int, rtol: float | None, domain: str | None) -> tuple[Any, Any, Quadrature]:
    """The sensor, the integrator and its accuracy, with these parameters in place of its own."""
    integrator: Any = integrator_of(scene, "integral")
    wanted = {name: value for name, value in (("rtol", rtol), ("domain", domain)) if value is not None}
    with named("fspt_integral"):
        quadrature = replace(integrator.quadrature, **wanted)
    return sensor_of(scene, sensor), integrator, quadrature


def _saved(
    solve: Callable[[Quadrature], tuple[Solution, float]], quadrature: Quadrature, without: Quadrature
) -> tuple[float, float, float]:
    """Shares of the lines of sight and of the time that a shortcut saves, from pairs of runs with and without it.

    The third number is `time_spread` of `Explanation`. A first run without the shortcut compiles the kernels and is not
    timed.
    """
    long, seconds = solve(without)
    rounds = ROUNDS if seconds < LONG else 1
    pairs = [(solve(quadrature), solve(without)) for _ in range(rounds)]
    short = pairs[0][0][0]
    times = [1 - on[1] / off[1] for on, off in pairs]
    return 1 - short.rays / max(1, long.rays), float(np.median(times)), float(np.ptp(times)) / 2


def _row(finding: Finding, *saved: float) -> Explanation:
    return Explanation(SHORTCUTS[finding.name], finding.taken, finding.why, *saved)


def _scattered(left_out: LeftOut) -> Explanation:
    """Row for the light that Eq. 9 has no term for."""
    share, error = 100 * left_out.share, 100 * left_out.error
    why = f"about {share:.2g} % (± {error:.1g} %) of the power, from {', '.join(left_out.bodies) or 'points and beams'}"
    return Explanation("light after a scattering reflection", True, why)


def _real_lens(lens: mi.Sensor) -> list[Explanation]:
    """Rows for what a real lens adds to a thin one; a lens without it has no such work."""
    from ..camera.of_sensor import camera_of

    camera = camera_of(lens)
    magnified, bent, darker = camera.lens.pupil_magnification, camera.lens.distortion, camera.vignetting
    return [
        Explanation("pupil magnification", magnified == 1, f"P = {magnified:g}"),
        Explanation("distortion", bent is None, "the lens has none" if bent is None else f"by {bent}"),
        Explanation("measured vignetting", darker is None, darker.file if darker else "the lens has none"),
    ]


def _diffraction(lens: mi.Sensor) -> Explanation:
    """Row for the diffraction at the diaphragm."""
    from ..camera.of_sensor import camera_of

    camera = camera_of(lens)
    radius, nm = camera.airy_radius, camera.airy_wavelength_nm
    why = f"Airy radius {radius:.2g} mm on the film, {radius / camera.pixel_pitch:.2g} pixels, at {nm:g} nm"
    return Explanation("diffraction", True, why)


def _never_done(scene: mi.Scene, variant: str) -> list[Explanation]:
    """Rows for work that is not started unless it is needed, so that there is no cost to measure."""
    from ..emission.of_emitter import surface_of

    loaded = [one.module for one in EXTRAS if one.module in sys.modules]
    surfaces = map(surface_of, scene.emitters())
    uniform = [surface is not None and surface.is_uniform() for surface in surfaces]
    return [
        Explanation("J_n look-ups", all(uniform), f"{sum(uniform)} of {len(uniform)} surfaces glow alike everywhere"),
        Explanation("gradients", True, "an image needs none"),
        Explanation("optional packages", not loaded, f"imported: {', '.join(loaded) or 'none'}"),
        Explanation("further variants", True, f"{variant} alone is set"),
    ]
