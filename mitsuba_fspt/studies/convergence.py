"""What `converge` finds: errors and times of every setting, and what follows from them. Pure NumPy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

# Names of the methods. Monte Carlo from the camera is one with every sampler; `PEER` has Mitsuba's best.
INTEGRAL, SURFACE_FORM, DIRECT_SUM, PTRACER = "integral", "integral, surface form", "sum over points", "ptracer"
PATH = "path, "
PEER = PATH + "multijitter"
FLOOR = 3.0  # times the reference's stated error: errors below it say little about a method
LEAST_CORRELATION = 0.7  # of the logarithms of work and error, for a power law to say something
TARGETS = (1e-3, 1e-4, 1e-5)  # RMS errors over the brightest pixel


@dataclass(frozen=True)
class Measurement:
    """One method at one setting of its `knob`. Errors are relative to the reference's brightest pixel.

    cold : first run [s], with the compiling and what is found out once about a scene
    seconds : median of the runs of each round [s]
    rays : lines of sight; for the sum over points, pairs of a point and a pixel
    rms, rms_full : RMS error over all pixels and over those whose whole cone sees the phantom (NaN: there are none)
    largest : largest error of a pixel; of Monte Carlo the median over the runs, whose squares `rms` averages
    memory : peak of the arrays that Dr.Jit held for it [MiB], beside the scene; NumPy's and Embree's are not counted
    """

    method: str
    knob: str
    value: float
    cold: float
    seconds: tuple[float, ...]
    rays: int
    rms: float
    rms_full: float
    largest: float
    memory: float

    @property
    def median(self) -> float:
        """Median time, warm [s]."""
        return float(np.median(self.seconds))

    @property
    def rate(self) -> float:
        """Rays per second, warm."""
        return self.rays / self.median


@dataclass(frozen=True)
class Convergence:
    """Error against run time of all methods on one scene.

    scene : its name and parameters; machine : what it was measured on; shape : (h, w)
    reference, check : what errors are counted from, and what an independent picture said of it
    stated, stated_largest : its own RMS and largest error over its brightest pixel
    full : number of pixels whose whole cone sees the phantom
    raw_rate : rays per second of Embree or OptiX alone, on pixels that can see what glows; in packets or one by one,
        whichever is faster
    rows : method by method, from coarse to fine
    skipped : methods that do not apply and settings that take too long, and why
    """

    scene: str
    machine: str
    shape: tuple[int, int]
    reference: str
    check: str
    stated: float
    stated_largest: float
    full: int
    raw_rate: float
    rows: tuple[Measurement, ...]
    skipped: dict[str, str]

    @property
    def methods(self) -> list[str]:
        """Names in the order of the rows."""
        return list(dict.fromkeys(row.method for row in self.rows))

    def of(self, method: str) -> list[Measurement]:
        """The rows of a method."""
        return [row for row in self.rows if row.method == method]

    def order(self, method: str) -> float | None:
        """Fitted p of error ∝ rays^-p, from the settings whose RMS error is above FLOOR × the reference's."""
        rows = [row for row in self.of(method) if row.rms > FLOOR * self.stated]
        return fitted_order([row.rays for row in rows], [row.rms for row in rows])

    def time_to(self, method: str, target: float, full: bool = False, run: int | None = None) -> float | None:
        """Least time [s] to an RMS error, by the medians or in one run of the rounds.

        None where no setting gets there, or where the target is below what the reference says of its own error.
        """
        rows = self.of(method)
        errors = [row.rms_full if full else row.rms for row in rows]
        times = [row.median if run is None else row.seconds[run] for row in rows]
        return time_to(times, errors, target) if target >= self.stated else None

    def ratio(self, method: str, peer: str, target: float, full: bool = False) -> tuple[float, float, float] | None:
        """How many times longer a peer takes to an error: median, least and largest over the rounds.

        Times are paired round by round, so that a slow moment of the machine meets both.
        """
        ratios = []
        for run in range(len(self.rows[0].seconds)):
            own, other = (self.time_to(name, target, full, run) for name in (method, peer))
            if own is None or other is None:
                return None
            ratios.append(other / own)
        return float(np.median(ratios)), min(ratios), max(ratios)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data for JSON, with the order and the times to TARGETS of every method."""
        told = asdict(self)
        for row, plain in zip(self.rows, told["rows"], strict=True):
            plain |= {"median": row.median, "rate": row.rate, "share_of_raw": row.rate / self.raw_rate}
            plain["rms_full"] = None if math.isnan(row.rms_full) else row.rms_full
        told["methods"] = {
            method: {"order": self.order(method)}
            | {f"time_to_{target:g}": self.time_to(method, target) for target in TARGETS}
            for method in self.methods
        }
        return told


def fitted_order(work: Sequence[float], errors: Sequence[float]) -> float | None:
    """p of error ∝ work^-p by least squares in the logarithms.

    None without two settings of different work, and where the errors do not fall like any power of it.
    """
    points = [(w, e) for w, e in zip(work, errors, strict=True) if w > 0 and e > 0]
    if len({w for w, _ in points}) < 2:
        return None
    x, y = np.log(np.array(points, float)).T
    spread = math.sqrt(np.var(x) * np.var(y))
    if spread == 0 or np.mean((x - x.mean()) * (y - y.mean())) > -LEAST_CORRELATION * spread:
        return None
    return float(-np.polyfit(x, y, 1)[0])


def time_to(times: Sequence[float], errors: Sequence[float], target: float) -> float | None:
    """Least time in which an error is reached; None where none of the settings reaches it.

    Between a setting that does not and the next one in time that does, the power law through both is followed.
    """
    points = sorted((t, e) for t, e in zip(times, errors, strict=True) if not math.isnan(e))
    reached = [t for t, e in points if e <= target]
    for (t0, e0), (t1, e1) in itertools.pairwise(points):
        if e1 <= target < e0:
            share = math.log(e0 / target) / math.log(e0 / e1) if e1 > 0 else 1.0
            reached.append(t0 * (t1 / t0) ** share)
    return min(reached, default=None)
