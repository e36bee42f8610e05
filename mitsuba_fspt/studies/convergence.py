"""The result of `converge`: errors and times of every setting, quantities derived from them, and text tables."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

# Names of the methods. Monte Carlo from the camera counts as one method per sampler; `PEER` has the best sampler.
INTEGRAL, SURFACE_FORM, DIRECT_SUM, PTRACER = "integral", "integral, surface form", "sum over points", "ptracer"
PATH = "path, "
PEER = PATH + "multijitter"
FLOOR = 3.0  # times the reference's stated error: smaller errors are not used to fit an order
LEAST_CORRELATION = 0.7  # of the logarithms of work and error; no order is fitted below it
TARGETS = (1e-3, 1e-4, 1e-5)  # RMS errors relative to the brightest pixel
# Pixels and RMS errors at which the integral is compared with `path`. 'full': all lines of sight meet the phantom.
PAIRS = (("all", 1e-3), ("all", 1e-4), ("all", 3e-5), ("all", 1e-5), ("full", 1e-4), ("full", 3e-5), ("full", 1e-5))
NONE = "–"  # in the table, for a number that does not exist


@dataclass(frozen=True)
class Measurement:
    """One method at one setting of its `knob`. Errors are relative to the reference's brightest pixel.

    cold : time of the first run [s], including compilation and computations once per scene
    seconds : median run time of each round [s]
    rays : number of lines of sight; for the sum over points, number of pairs of a point and a pixel
    rms, rms_full : RMS error over all pixels, and over those all of whose lines of sight meet the phantom (NaN: none)
    largest : largest error of a pixel; for Monte Carlo the median of it over the rounds, while `rms` is the root of
        the mean square over the rounds
    memory : peak of Dr.Jit's arrays during a run [MiB], without those of the scene; NumPy's and Embree's memory is not
        counted
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
        """Median warm run time [s]."""
        return float(np.median(self.seconds))

    @property
    def rate(self) -> float:
        """Rays per second, warm."""
        return self.rays / self.median


@dataclass(frozen=True)
class Convergence:
    """Error against run time of all methods on one scene.

    Attributes
    ----------
    scene : its name and parameters; machine : the machine and the variant; shape : (h, w)
    reference, check : names of the reference image and of the image that it was checked against, with the result
    stated, stated_largest : RMS and largest error that the reference states of itself, relative to its brightest pixel
    full : number of pixels all of whose lines of sight meet the phantom
    raw_rate : rays per second of Embree or OptiX alone, on pixels that can see a glowing surface; traced in packets or
        one by one, whichever is faster
    rows : method by method, from coarse to fine
    skipped : methods that do not apply and settings that take too long, with the reason
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
        """Names of the methods in the order of the rows."""
        return list(dict.fromkeys(row.method for row in self.rows))

    def of(self, method: str) -> list[Measurement]:
        """The rows of a method."""
        return [row for row in self.rows if row.method == method]

    def order(self, method: str) -> float | None:
        """Fitted p of error ∝ rays^-p, from the settings whose RMS error is above FLOOR × the reference's."""
        rows = [row for row in self.of(method) if row.rms > FLOOR * self.stated]
        return fitted_order([row.rays for row in rows], [row.rms for row in rows])

    def time_to(self, method: str, target: float, full: bool = False, run: int | None = None) -> float | None:
        """Least time [s] in which a method reaches the RMS error `target`.

        full : only pixels all of whose lines of sight meet the phantom
        run : number of the round whose times are used; None: medians over the rounds
        None if no setting reaches the target, or if it is smaller than the stated error of the reference.
        """
        rows = self.of(method)
        errors = [row.rms_full if full else row.rms for row in rows]
        times = [row.median if run is None else row.seconds[run] for row in rows]
        return time_to(times, errors, target) if target >= self.stated else None

    def ratio(self, method: str, peer: str, target: float, full: bool = False) -> tuple[float, float, float] | None:
        """Time of `peer` over time of `method` to an RMS error: median, least and largest over the rounds.

        The two times of a ratio are of the same round, so that a slow machine slows both.
        """
        ratios = []
        for run in range(len(self.rows[0].seconds)):
            own, other = (self.time_to(name, target, full, run) for name in (method, peer))
            if own is None or other is None:
                return None
            ratios.append(other / own)
        return float(np.median(ratios)), min(ratios), max(ratios)

    def to_dict(self) -> dict[str, Any]:
        """All fields as plain data for JSON, with the order and the times to TARGETS of every method."""
        plain = asdict(self)
        for row, fields in zip(self.rows, plain["rows"], strict=True):
            fields |= {"median": row.median, "rate": row.rate, "share_of_raw": row.rate / self.raw_rate}
            fields["rms_full"] = None if math.isnan(row.rms_full) else row.rms_full
        plain["methods"] = {
            method: {"order": self.order(method)}
            | {f"time_to_{target:g}": self.time_to(method, target) for target in TARGETS}
            for method in self.methods
        }
        return plain

    def render_text(self) -> str:
        """Scene, machine and reference in a line each, then two Markdown tables: all methods; integral and `path`."""
        h, w = self.shape
        lines = [
            f"{self.scene}: {w} x {h} pixels, {self.full} of them see the phantom with their whole cone ('full')",
            f"{self.machine}; tracing alone: {self.raw_rate / 1e6:.3g} million rays a second that can meet it ('raw')",
            f"reference: {self.reference}, stated error {self.stated:.1e} RMS, {self.stated_largest:.1e} at the most",
        ]
        lines += [f"checked by: {self.check}"] if self.check else []
        lines += [f"skipped: {method}: {reason}" for method, reason in self.skipped.items()]
        return "\n".join([*lines, "", _table(_method_rows(self)), "", _table(_ratio_rows(self))])


def fitted_order(work: Sequence[float], errors: Sequence[float]) -> float | None:
    """p of error ∝ work^-p by least squares in the logarithms.

    None if there are fewer than two different values of `work`, or if the errors follow no power of it.
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
    """Least time in which the error `target` is reached; None if no setting reaches it.

    The time is interpolated, by a power law, between a setting that does not reach the target and the next slower one
    that does.
    """
    points = sorted((t, e) for t, e in zip(times, errors, strict=True) if not math.isnan(e))
    reached = [t for t, e in points if e <= target]
    for (t0, e0), (t1, e1) in itertools.pairwise(points):
        if e1 <= target < e0:
            share = math.log(e0 / target) / math.log(e0 / e1) if e1 > 0 else 1.0
            reached.append(t0 * (t1 / t0) ** share)
    return min(reached, default=None)


# ---------------------------------------------------------------------- the text tables


def _table(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns of equal width; the first row is the head."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["| " + " | ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "|".join("-" * (w + 2) for w in widths) + "|", *lines[1:]])


def _method_rows(found: Convergence) -> list[list[str]]:
    """One row per method: rates of its finest setting, its largest memory, first run of its coarsest setting."""
    head = ["method", "order", *(f"to {target:g}" for target in TARGETS), "cold start", "Mrays/s", "of raw", "Dr.Jit"]
    rows = [head]
    for method in found.methods:
        of = found.of(method)
        order, fine = found.order(method), of[-1]
        rows.append(
            [
                method,
                NONE if order is None else f"{order:.2f}",
                *(_time(found.time_to(method, target)) for target in TARGETS),
                _time(of[0].cold),
                f"{fine.rate / 1e6:.3g}" if fine.rays else NONE,
                f"{fine.rate / found.raw_rate:.0%}" if fine.rays else NONE,
                f"{max(row.memory for row in of):.2g} MiB",
            ]
        )
    return rows


def _ratio_rows(found: Convergence) -> list[list[str]]:
    """One row per error: times of the integral and of `PEER`, their ratio, and the fastest other sampler of `path`."""
    rows = [["pixels", "RMS error", INTEGRAL, PEER, "ratio (over the rounds)", "best other sampler"]]
    others = [method for method in found.methods if method.startswith(PATH) and method != PEER]
    for pixels, target in PAIRS:
        full = pixels == "full"
        if (full and found.full == 0) or target < found.stated:
            continue
        ratio = found.ratio(INTEGRAL, PEER, target, full)
        times = {method: found.time_to(method, target, full) for method in others}
        best = min(((t, method.removeprefix(PATH)) for method, t in times.items() if t is not None), default=None)
        rows.append(
            [
                pixels,
                f"{target:g}",
                *(_time(found.time_to(method, target, full)) for method in (INTEGRAL, PEER)),
                NONE if ratio is None else "{:.2g} ({:.2g} to {:.2g})".format(*ratio),
                NONE if best is None else f"{best[1]}, {_time(best[0])}",
            ]
        )
    return rows


def _time(seconds: float | None) -> str:
    if seconds is None:
        return NONE
    return f"{seconds:.3g} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"
