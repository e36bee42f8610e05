"""Error against run time: every method over its own accuracy knob, timed in rounds that go through all settings."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..rendering import render
from ..rendering.scene import loaded
from ..runtime import backend
from ..runtime.errors import FsptError, SceneError
from ..runtime.numbers import number, whole
from .converge_methods import Method, Shot, methods, raw_rate
from .converge_reference import Reference, own_reference, read_reference
from .convergence import Convergence, Measurement

if TYPE_CHECKING:
    import mitsuba as mi

    from ..rendering.render import Progress

BUDGET, ROUNDS = 2.0, 5
REFERENCE_TIME = 15.0  # times the budget
PATIENCE = 4.0  # times the budget: what a coarsest setting may take
BURST = 0.1  # s
WHOLE_CONE = 1 - 1e-4  # of the lines of sight: a sum of float32 weights
MIB = 1 << 20

Plane = NDArray[np.float64]
Mask = NDArray[np.bool_]


def converge(
    scene: mi.Scene | str | os.PathLike[str],
    *,
    sensor: int = 0,
    rounds: int = ROUNDS,
    budget: float = BUDGET,
    reference: str | os.PathLike[str] | None = None,
    kernels: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Convergence:
    """Error against run time of the integral in both its forms, of the paper's sum, and of Mitsuba's Monte Carlo.

        found = fspt.converge("scenes/two_spheres.xml", budget=0.5)
        found.order("integral"), found.time_to("path, multijitter", 1e-3)

    Every setting runs once cold, once more for its memory, once untimed before the first round, and in each round for a
    tenth of a second, at least once, the rounds forwards and backwards through all settings by turns: a slow moment of
    the machine meets them all, and medians count. `converge_sheet` writes the CSV file and the figure,
    `converge_table` the table.

    Cold is the first run of a setting: tracing, compiling, and what an integrator finds out once about a scene. Kernels
    that Dr.Jit has, in memory or on disk, are not compiled again, unless `kernels` lets it forget them.

    Parameters
    ----------
    scene : Mitsuba scene (see `load`) or the name of a scene file
    sensor : number of the sensor, an `fspt_lens`
    rounds : timed rounds, >= 1; in each the median of a setting's runs counts
    budget : longest time of one picture [s], > 0; finer settings are left out. About rounds × 20 × budget in all,
        and some seconds a setting for its first runs.
    reference : EXR file with error.Y, or NPZ file with arrays power and error [W]; None makes one, see `own_reference`
    kernels : DRJIT_CACHE_DIR of this process, if all kernels may be forgotten before every cold run; else None
    progress : called with what is being done and the share done

    Raises
    ------
    SceneError, OpticsError, ExitanceError, ImageError, BackendError : what is wrong and how to mend it.
    """
    sensor = whole("converge: 'sensor'", sensor, SceneError, "0")
    rounds = whole("converge: 'rounds'", rounds, SceneError, str(ROUNDS))
    budget = number("converge: 'budget'", budget, SceneError, str(BUDGET))
    if not (rounds >= 1 and 0 < budget < math.inf):
        raise SceneError(f"converge: 'rounds' must be >= 1 and 'budget' > 0 s and finite, got {rounds} and {budget:g}.")
    scene = loaded(scene)
    backend.ensure_variant()
    lens = render.sensor_of(scene, sensor)
    tell = progress or (lambda what, share: None)
    known = _reference(scene, lens, reference, budget, tell)
    full = render.render(scene, method="integral", sensor=sensor, rtol=1e-3).coverage > WHOLE_CONE
    bench = Bench(Judge(known, full), Path(kernels) if kernels is not None else None, budget)
    skipped = bench.try_all(*methods(scene, lens, known.least_rtol), tell)
    rate = bench.run_rounds(rounds, [raw_rate(scene, lens, together) for together in (False, True)], tell)
    return _convergence(scene, bench, rounds, rate, skipped)


def _reference(
    scene: mi.Scene, lens: mi.Sensor, path: str | os.PathLike[str] | None, budget: float, tell: Progress
) -> Reference:
    """What errors are counted from: the file's picture, or one of our own."""
    width, height = (int(n) for n in _film(scene, lens).crop_size())
    known = read_reference(path, (height, width)) if path is not None else None
    tell("reference", 0.0)
    return known or own_reference(scene, lens, REFERENCE_TIME * budget)


def _convergence(scene: mi.Scene, bench: Bench, rounds: int, rate: float, skipped: dict[str, str]) -> Convergence:
    """What was measured, as plain data."""
    import mitsuba as mi

    known = bench.judge.reference
    height, width = known.power.shape
    return Convergence(
        scene=scene.id(),
        machine=f"{os.cpu_count()} cores, {platform.machine()}, {mi.variant()}; {rounds} rounds",
        shape=(height, width),
        reference=known.name,
        check=known.check,
        stated=known.rms,
        stated_largest=known.largest,
        full=int(bench.judge.full.sum()),
        raw_rate=rate,
        rows=tuple(trial.row() for trial in bench.trials),
        skipped=skipped,
    )


class Judge:
    """Errors of a picture over the reference's brightest pixel: mean square, that of the marked pixels, largest."""

    def __init__(self, reference: Reference, full: Mask) -> None:
        self.reference, self.full = reference, full

    def __call__(self, power: Plane) -> tuple[float, float, float]:
        error = (power - self.reference.power) / self.reference.peak
        square = np.square(error)
        full = float(np.mean(square[self.full])) if self.full.any() else np.nan
        return float(np.mean(square)), full, float(np.abs(error).max())


@dataclass
class Trial:
    """One method at one setting: how to run it, and what the runs gave."""

    method: Method
    run: Callable[[], Shot]
    cold: float
    memory: float
    shot: Shot
    seconds: list[float] = field(default_factory=list)
    errors: list[tuple[float, float, float]] = field(default_factory=list)

    def run_timed(self, judge: Judge) -> None:
        """One round: again and again for `BURST`, lest what ran before decides how warm a short one is; its median."""
        if not self.seconds:  # its kernels were forgotten for the sake of others' cold runs
            self.run()
        times: list[float] = []
        while sum(times) < BURST:
            seconds, self.shot = _seconds(self.run)
            times.append(seconds)
        self.seconds.append(float(np.median(times)))
        self.errors.append(judge(self.shot.power))

    def row(self) -> Measurement:
        """Monte Carlo's errors differ from seed to seed: the root of the mean square over the rounds."""
        square, full, _ = np.mean(self.errors, axis=0)
        return Measurement(
            method=self.method.name,
            knob=self.method.knob,
            value=self.shot.knob,
            cold=self.cold,
            seconds=tuple(self.seconds),
            rays=self.shot.rays,
            rms=float(np.sqrt(square)),
            rms_full=float(np.sqrt(full)),
            largest=float(np.median([largest for *_, largest in self.errors])),
            memory=self.memory,
        )


class Bench:
    """The settings that are worth timing, found by their first runs."""

    def __init__(self, judge: Judge, kernels: Path | None, budget: float) -> None:
        self.judge, self.kernels, self.budget = judge, kernels, budget
        self.trials: list[Trial] = []

    def try_all(self, offered: list[Method], skipped: dict[str, str], tell: Progress) -> dict[str, str]:
        """First runs of all methods; returns what is left out, those `skipped` already among it, and why.

        SceneError where nothing is left to time.
        """
        left_out = dict(skipped)
        for k, method in enumerate(offered):
            tell(f"first runs: {method.name}", 0.1 + 0.4 * k / len(offered))
            try:
                left_out |= self.try_ladder(method)
            except FsptError as refusal:
                left_out[method.name] = str(refusal)
        if left_out and not self.trials:
            name, why = next(iter(left_out.items()))
            raise SceneError(
                f"converge: nothing to time; {name}: {why}, 'budget' is {self.budget:g} s. Give a longer one."
            )
        return left_out

    def run_rounds(self, rounds: int, raws: list[Callable[[], int]], tell: Progress) -> float:
        """The timed rounds; returns the rays per second of the faster of the `raws`, see `raw_rate`."""
        rays = [raw() for raw in raws]
        seconds: list[list[float]] = [[] for _ in raws]
        for k in range(rounds):
            for own, raw in zip(seconds, raws, strict=True):
                own.append(_seconds(raw)[0])
            for trial in self.trials[:: -1 if k % 2 else 1]:
                tell(f"round {k + 1}: {trial.method.name}", 0.5 + 0.5 * k / rounds)
                trial.run_timed(self.judge)
        return max(count / float(np.median(own)) for count, own in zip(rays, seconds, strict=True))

    def try_ladder(self, method: Method) -> dict[str, str]:
        """Run a method's settings from coarse to fine until one takes longer than the budget; the first one stays.

        Returns which ones are left out for that, and why.
        """
        for k, value in enumerate(method.ladder):
            self._forget_kernels()
            run = method.prepare(value)
            cold, _ = _seconds(run)
            seconds, memory, shot = _with_memory(run)
            if seconds > self.budget:
                seconds = min(seconds, _seconds(run)[0])  # a slow moment of the machine does not end a ladder
            if seconds > self.budget and (k > 0 or seconds > PATIENCE * self.budget):
                if k == 0:
                    raise SceneError(f"its coarsest setting takes {seconds:.3g} s")
                from_here = f"{method.name}, {method.knob} {value:g} and finer"
                return {from_here: f"{seconds:.3g} s a picture, more than the budget of {self.budget:g} s"}
            self.trials.append(Trial(method, run, cold, memory, shot))
        return {}

    def _forget_kernels(self) -> None:
        if self.kernels is None:
            return
        import drjit as dr

        dr.sync_thread()
        dr.flush_kernel_cache()
        for path in self.kernels.glob("*.bin"):
            path.unlink(missing_ok=True)


def _with_memory(run: Callable[[], Shot]) -> tuple[float, float, Shot]:
    """Seconds, peak of Dr.Jit's arrays beside what lived before [MiB], and the picture."""
    import drjit as dr
    import mitsuba as mi

    device = dr.JitBackend.CUDA if mi.variant().startswith("cuda") else dr.JitBackend.LLVM
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(device)
    seconds, shot = _seconds(run)
    return seconds, (dr.detail.malloc_watermark(device) - before) / MIB, shot


def _seconds(run: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = run()
    return time.perf_counter() - start, result


def _film(scene: mi.Scene, lens: mi.Sensor) -> mi.Film:
    """The film of a scene that was checked."""
    from ..integral.scene_checks import check_scene

    check_scene(scene, lens)
    return lens.film()
