"""Error against run time: the reference image, and every method timed for several values of its accuracy parameter.

The accuracy parameter of a method is called its knob. Every timed round runs all settings one after the other, so that
a slow moment of the machine affects all methods alike.
"""

from __future__ import annotations

import logging
import math
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.image import Image, read
from ..integral.quadrature import Quadrature
from ..rendering import render
from ..rendering.scene import loaded
from ..runtime import backend
from ..runtime.errors import FsptError, ImageError, SceneError
from ..runtime.numbers import number, whole
from .converge_methods import Method, RunResult, methods, raw_rate
from .convergence import Convergence, Measurement

if TYPE_CHECKING:
    import mitsuba as mi

    from ..runtime.progress_bar import Progress

LOG = logging.getLogger("mitsuba_fspt")
BUDGET, ROUNDS = 2.0, 5
REFERENCE_TIME = 15.0  # times the budget: run time of the reference image
PATIENCE = 4.0  # times the budget: longest time of a method's coarsest setting
BURST = 0.1  # s: least total time of a setting's repeated runs in one round
WHOLE_CONE = 1 - 1e-4  # least coverage of a pixel whose lines of sight all meet the phantom; float32 sums are rounded
# RMS difference between a given reference and the integral, beyond the integral's error and so many of the reference's,
# which may be standard errors, over the peak, from which on the reference is told to be of another image.
APART, DEVIATIONS = 0.01, 4.0
MIB = 1 << 20
CACHE_VARIABLE = "DRJIT_CACHE_DIR"  # environment variable that names Dr.Jit's folder of compiled kernels
# The reference always takes the first rtol, and a finer one if its expected time is within REFERENCE_TIME.
REFERENCE_RTOL = {"pupil": (1e-4, 1e-5, 1e-6), "surface": (1e-2, 1e-3, 1e-4, 1e-5)}
GROWTH = 8.0  # expected ratio of the times of an rtol and of the one before it
COARSER = 10.0  # times the reference's rtol: least rtol of the same form whose error is measured

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
    """Error against run time of both forms of the integral, of the paper's sum, and of Mitsuba's Monte Carlo.

        found = fspt.converge("scenes/two_spheres.xml", budget=0.5)
        found.order("integral"), found.time_to("path, multijitter", 1e-3)
        print(found.render_text())

    Every setting runs once cold, once more to measure its memory, once untimed before the first round, and in each
    round at least once and for 0.1 s. The rounds go through all settings alternately forwards and backwards, so that a
    slow moment of the machine affects all of them; results are medians. `convergence_report` writes the CSV file and
    the figure.

    The cold run is the first run of a setting. It includes recording, compilation, and whatever an integrator computes
    once per scene. Kernels that Dr.Jit has in memory or on disk are not compiled again, unless `kernels` permits to
    delete them.

    Parameters
    ----------
    scene : Mitsuba scene (see `load`) or the name of a scene file
    sensor : number of the sensor, an `fspt_lens`
    rounds : timed rounds, >= 1; in each the median of a setting's runs counts
    budget : longest time of one image [s], > 0; finer settings are left out. The study takes about rounds × 20 ×
        budget, and some seconds per setting for its first runs.
    reference : EXR file with error.Y, or NPZ file with arrays power and error [W]; None makes one, see `own_reference`
    kernels : DRJIT_CACHE_DIR of this process, if all kernels may be deleted before every cold run; else None
    progress : called with the name of the stage and the share done, 0 … 1

    Raises
    ------
    SceneError, OpticsError, ExitanceError : the scene or an argument cannot be used, or its image is dark.
    ImageError : the reference cannot be used.
    BackendError : no working LLVM or CUDA.
    """
    sensor = whole("converge: 'sensor'", sensor, SceneError, "0")
    rounds = whole("converge: 'rounds'", rounds, SceneError, str(ROUNDS))
    budget = number("converge: 'budget'", budget, SceneError, str(BUDGET))
    if not (rounds >= 1 and 0 < budget < math.inf):
        raise SceneError(f"converge: 'rounds' must be >= 1 and 'budget' > 0 s and finite, got {rounds} and {budget:g}.")
    scene = loaded(scene)
    backend.ensure_variant()
    lens = render.sensor_of(scene, sensor)
    report = progress or (lambda what, share: None)
    measured_from = _reference(scene, lens, reference, budget, report)
    image = render.render(scene, method="integral", sensor=sensor, rtol=1e-3)
    full = np.asarray(image.coverage) > WHOLE_CONE
    if reference is not None:
        measured_from = _checked(measured_from, image)
    benchmark = Benchmark(measured_from, full, Path(kernels) if kernels is not None else None, budget)
    skipped = benchmark.try_all(*methods(scene, lens, measured_from.least_rtol), report)
    rate = benchmark.run_rounds(rounds, [raw_rate(scene, lens, together) for together in (False, True)], report)
    return _convergence(scene, benchmark, rounds, rate, skipped)


@contextmanager
def empty_kernel_cache() -> Iterator[Path | None]:
    """Context manager: an empty folder for Dr.Jit's kernels, deleted at the end; None if Dr.Jit is imported already.

    It is meant for the parameter `kernels` of `converge`: with an empty folder the cold runs compile all kernels.
    """
    if "drjit" in sys.modules:
        yield None
        return
    before = os.environ.get(CACHE_VARIABLE)
    with tempfile.TemporaryDirectory(prefix="fspt-kernels-", ignore_cleanup_errors=True) as folder:
        os.environ[CACHE_VARIABLE] = folder
        try:
            yield Path(folder)
        finally:
            os.environ.pop(CACHE_VARIABLE)
            os.environ.update({CACHE_VARIABLE: before} if before is not None else {})


def _convergence(
    scene: mi.Scene, benchmark: Benchmark, rounds: int, rate: float, skipped: dict[str, str]
) -> Convergence:
    """All measurements as plain data."""
    import mitsuba as mi

    reference = benchmark.reference
    height, width = reference.power.shape
    return Convergence(
        scene=scene.id(),
        machine=f"{os.cpu_count()} cores, {platform.machine()}, {mi.variant()}; {rounds} rounds",
        shape=(height, width),
        reference=reference.name,
        check=reference.check,
        stated=reference.rms,
        stated_largest=reference.largest,
        full=int(benchmark.full.sum()),
        raw_rate=rate,
        rows=tuple(setting.row() for setting in benchmark.settings),
        skipped=skipped,
    )


# ---------------------------------------------------------------------- the reference image


@dataclass(frozen=True, eq=False)
class Reference:
    """The image with which all others are compared.

    power, error : power and its stated absolute error, shape (h, w) [W]
    name : its file, or the method that computed it
    check : result of the comparison with an independent image, '' without one
    least_rtol : finest rtol of the integral's pupil form whose error can be measured. The reference is of that form;
        images of a finer rtol have partly the same error
    """

    power: Plane
    error: Plane
    name: str
    check: str = ""
    least_rtol: float = 0.0

    @property
    def peak(self) -> float:
        """Power on the brightest pixel [W], to which all errors are relative."""
        return float(self.power.max())

    @property
    def rms(self) -> float:
        """Stated RMS error, relative to the brightest pixel."""
        return float(np.sqrt(np.mean(self.error**2)) / self.peak)

    @property
    def largest(self) -> float:
        """Largest stated error of a pixel, relative to the brightest pixel."""
        return float(self.error.max() / self.peak)

    def errors_of(self, power: Plane, full: Mask) -> tuple[float, float, float]:
        """Errors of an image with this `power`, shape (h, w) [W], relative to the reference's brightest pixel.

        Three numbers: the mean square over all pixels, that over the pixels of `full` (NaN if there are none), and the
        largest error.
        """
        error = (power - self.power) / self.peak
        square = np.square(error)
        square_full = float(np.mean(square[full])) if full.any() else np.nan
        return float(np.mean(square)), square_full, float(np.abs(error).max())


def _reference(
    scene: mi.Scene, lens: mi.Sensor, path: str | os.PathLike[str] | None, budget: float, report: Progress
) -> Reference:
    """The reference: that of the file, or the integral at a fine rtol if no file is given."""
    shape = _shape(scene, lens)
    from_file = read_reference(path, shape) if path is not None else None
    report("reference", 0.0)
    return from_file or own_reference(scene, lens, REFERENCE_TIME * budget)


def _checked(reference: Reference, image: Image) -> Reference:
    """The reference of a file; if the integral's image is another one, `check` and a line on stderr say so."""
    known = np.asarray(image.error) + DEVIATIONS * reference.error
    apart = np.maximum(np.abs(image.power - reference.power) - known, 0)
    rms = float(np.sqrt(np.mean(apart**2)) / reference.peak)
    if rms <= APART:
        return reference
    check = (
        f"the integral's image differs from it by {rms:.1e} of the peak (root mean square of what both errors do not "
        f"explain), its power is {image.total_power / reference.power.sum():.4g} times the reference's"
    )
    LOG.warning(
        "fspt: converge: reference '%s': %s. Give one of the same parameters and power of the source.",
        reference.name,
        check,
    )
    return replace(reference, check=check)


def _shape(scene: mi.Scene, lens: mi.Sensor) -> tuple[int, int]:
    """Shape (h, w) of the image; raises as `check_scene` does."""
    from ..camera.of_sensor import camera_of
    from ..integral.lines.scene_checks import check_scene

    check_scene(scene, camera := camera_of(lens))
    return camera.film.shape


def read_reference(path: str | os.PathLike[str], shape: tuple[int, int]) -> Reference:
    """Reference from an EXR file with channels Y and error.Y, or an NPZ file with arrays power and error [W].

    Raises
    ------
    ImageError : no such file, not such a file, no error in it, another size than `shape` (h, w), or a dark image.
    """
    path = Path(path)
    power: NDArray[np.floating]
    error: NDArray[np.floating] | None
    if path.suffix == ".npz":
        power, error = _arrays(path)
    else:
        image = read(path)
        power, error = image.power, image.error
    if error is None:
        raise ImageError(f"reference '{path}' has no channel 'error.Y'. Give a picture that states its own error.")
    for plane in (power, error):
        if plane.shape != shape:
            sizes = " and ".join(f"{w} x {h}" for h, w in (plane.shape[:2], shape))
            raise ImageError(f"reference '{path}' and the scene's film differ: {sizes} pixels. Give one of its size.")
    if not (np.isfinite(power).all() and np.isfinite(error).all() and error.min() >= 0 and power.max() > 0):
        raise ImageError(
            f"reference '{path}': power and error must be finite, error >= 0, one pixel bright. Make it anew."
        )
    return Reference(power.astype(np.float64), error.astype(np.float64), str(path))


def _arrays(path: Path) -> tuple[Plane, Plane]:
    """Power and error, shape (h, w) [W], of an NPZ file."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            power, error = np.asarray(stored["power"]), np.asarray(stored["error"])
    except OSError as cause:
        raise ImageError(f"reference '{path}' cannot be read: {cause.strerror or cause}. Check the name.") from cause
    except Exception as cause:  # whatever a damaged archive makes NumPy and zipfile raise
        raise ImageError(f"reference '{path}' is no NPZ file. Give arrays 'power', 'error' [W].") from cause
    if power.ndim != 2 or {power.dtype.kind, error.dtype.kind} - set("fiu"):
        raise ImageError(f"reference '{path}': 'power' and 'error' must be numbers of shape (h, w), in W.")
    return power, error


def own_reference(scene: mi.Scene, lens: mi.Sensor, seconds: float) -> Reference:
    """The integral's pupil form at the finest rtol that takes about `seconds`, checked by the surface form.

    The surface form is a different algorithm on the same ray tracer. The stated error of a pixel is the larger of two:
    the pupil form's own estimate, and the difference between the forms less the surface form's estimate.

    Raises
    ------
    SceneError : the image is dark.
    """
    fine, rtol = _finest(scene, lens, "pupil", seconds)
    if not fine.power.max() > 0:
        raise SceneError("converge: the picture is dark, errors relative to its peak are undefined. Turn the camera.")
    name = f"fspt_integral, pupil form, rtol {rtol:g}"
    try:
        other, other_rtol = _finest(scene, lens, "surface", seconds)
    except FsptError as refusal:
        return Reference(fine.power, fine.error, name, f"not checked by the surface form: {refusal}", COARSER * rtol)
    apart = np.abs(other.power - fine.power)
    unexplained = np.maximum(apart - other.error, 0)
    peak = fine.power.max()
    rms, largest = np.sqrt(np.mean(apart**2)) / peak, apart.max() / peak
    own = np.sqrt(np.mean(other.error**2)) / peak
    check = (
        f"surface form, rtol {other_rtol:g}: RMS difference {rms:.1e}, largest {largest:.1e}; it states {own:.1e} RMS, "
        f"which leaves {np.sqrt(np.mean(unexplained**2)) / peak:.1e} unexplained"
    )
    return Reference(fine.power, np.maximum(fine.error, unexplained), name, check, COARSER * rtol)


def _finest(scene: mi.Scene, lens: mi.Sensor, domain: str, seconds: float) -> tuple:
    """The finest solution of a form that takes about `seconds`, and its rtol."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "fspt_integral"})
    values = REFERENCE_RTOL[domain]
    for rtol in values:
        start = time.perf_counter()
        solution = integrator.solve(scene, lens, Quadrature(rtol=rtol, domain=domain))
        if rtol == values[-1] or (time.perf_counter() - start) * GROWTH > seconds:
            break
    return solution, rtol


# ---------------------------------------------------------------------- the measurements


@dataclass
class TimedSetting:
    """One method at one setting: a function that runs it, and the results of its runs.

    cold : time of the first run [s]
    memory : peak of Dr.Jit's arrays [MiB]
    result : of the last run
    seconds : median run time of each round [s]
    errors : of each round, see `Reference.errors_of`
    """

    method: Method
    run: Callable[[], RunResult]
    cold: float
    memory: float
    result: RunResult
    seconds: list[float] = field(default_factory=list)
    errors: list[tuple[float, float, float]] = field(default_factory=list)

    def run_timed(self, reference: Reference, full: Mask) -> None:
        """One round: repeated runs for `BURST` seconds, whose median time is stored.

        A single short run would depend on the contents of the caches after the setting before it.
        """
        if not self.seconds:  # its kernels were deleted before the cold runs of the settings after it
            self.run()
        times: list[float] = []
        while sum(times) < BURST:
            seconds, self.result = _seconds(self.run)
            times.append(seconds)
        self.seconds.append(float(np.median(times)))
        self.errors.append(reference.errors_of(self.result.power, full))

    def row(self) -> Measurement:
        """The measurement. Its RMS error is a mean over the rounds, since that of Monte Carlo varies with the seed."""
        square, full, _ = np.mean(self.errors, axis=0)
        return Measurement(
            method=self.method.name,
            knob=self.method.knob,
            value=self.result.knob,
            cold=self.cold,
            seconds=tuple(self.seconds),
            rays=self.result.rays,
            rms=float(np.sqrt(square)),
            rms_full=float(np.sqrt(full)),
            largest=float(np.median([largest for *_, largest in self.errors])),
            memory=self.memory,
        )


class Benchmark:
    """The settings that are timed: for each method, from coarse to fine, those that take at most `budget` seconds."""

    def __init__(self, reference: Reference, full: Mask, kernels: Path | None, budget: float) -> None:
        """`full`: mask (h, w) of pixels all of whose lines of sight meet the phantom; `kernels` as of `converge`."""
        self.reference, self.full = reference, full
        self.kernels, self.budget = kernels, budget
        self.settings: list[TimedSetting] = []

    def try_all(self, offered: list[Method], skipped: dict[str, str], report: Progress) -> dict[str, str]:
        """Run all methods for the first time; return `skipped` plus the settings that take too long, with reasons.

        Raises
        ------
        SceneError : no setting is left to time.
        """
        left_out = dict(skipped)
        for k, method in enumerate(offered):
            report(f"first runs: {method.name}", 0.1 + 0.4 * k / len(offered))
            try:
                left_out |= self.try_values(method)
            except FsptError as refusal:
                left_out[method.name] = str(refusal)
        if left_out and not self.settings:
            name, why = next(iter(left_out.items()))
            raise SceneError(
                f"converge: nothing to time; {name}: {why}, 'budget' is {self.budget:g} s. Give a longer one."
            )
        return left_out

    def run_rounds(self, rounds: int, raws: list[Callable[[], int]], report: Progress) -> float:
        """The timed rounds; returns the rays per second of the faster of the `raws`, see `raw_rate`."""
        rays = [raw() for raw in raws]
        seconds: list[list[float]] = [[] for _ in raws]
        for k in range(rounds):
            for own, raw in zip(seconds, raws, strict=True):
                own.append(_seconds(raw)[0])
            for setting in self.settings[:: -1 if k % 2 else 1]:
                report(f"round {k + 1}: {setting.method.name}", 0.5 + 0.5 * k / rounds)
                setting.run_timed(self.reference, self.full)
        return max(count / float(np.median(own)) for count, own in zip(rays, seconds, strict=True))

    def try_values(self, method: Method) -> dict[str, str]:
        """Run a method's settings from coarse to fine until one takes longer than the budget; the first is always kept.

        Returns the settings that are left out for that, with the reason; raises SceneError if the first one takes
        longer than PATIENCE × the budget.
        """
        for k, value in enumerate(method.values):
            self._delete_kernels()
            run = method.prepare(value)
            cold, _ = _seconds(run)
            seconds, memory, result = _with_memory(run)
            if seconds > self.budget:
                seconds = min(seconds, _seconds(run)[0])  # a second run, in case the machine was slow for a moment
            if seconds > self.budget and (k > 0 or seconds > PATIENCE * self.budget):
                if k == 0:
                    raise SceneError(f"its coarsest setting takes {seconds:.3g} s")
                from_here = f"{method.name}, {method.knob} {value:g} and finer"
                return {from_here: f"{seconds:.3g} s a picture, more than the budget of {self.budget:g} s"}
            self.settings.append(TimedSetting(method, run, cold, memory, result))
        return {}

    def _delete_kernels(self) -> None:
        """Delete Dr.Jit's compiled kernels in memory and on disk, where the caller allows it."""
        if self.kernels is None:
            return
        import drjit as dr

        dr.sync_thread()
        dr.flush_kernel_cache()
        for path in self.kernels.glob("*.bin"):
            path.unlink(missing_ok=True)


def _with_memory(run: Callable[[], RunResult]) -> tuple[float, float, RunResult]:
    """Run time [s], peak of Dr.Jit's arrays above what was allocated before the run [MiB], and the result."""
    import drjit as dr
    import mitsuba as mi

    device = dr.JitBackend.CUDA if str(mi.variant()).startswith("cuda") else dr.JitBackend.LLVM
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(device)
    seconds, result = _seconds(run)
    return seconds, (dr.detail.malloc_watermark(device) - before) / MIB, result


def _seconds(run: Callable[[], Any]) -> tuple[float, Any]:
    """Run time [s] and the result of a function."""
    start = time.perf_counter()
    result = run()
    return time.perf_counter() - start, result
