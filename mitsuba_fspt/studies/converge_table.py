"""The short table of `converge`, as Markdown that also reads well on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from .convergence import INTEGRAL, PATH, PEER, TARGETS, Convergence

# Pixels ('full': those whose whole cone sees the phantom) and RMS errors at which the integral is set against `path`.
PAIRS = (("all", 1e-3), ("all", 1e-4), ("all", 3e-5), ("all", 1e-5), ("full", 1e-4), ("full", 3e-5), ("full", 1e-5))
NONE = "–"


def render_text(found: Convergence) -> str:
    """What was measured on what, the methods, and the integral beside `path`, as text with two Markdown tables."""
    h, w = found.shape
    lines = [
        f"{found.scene}: {w} x {h} pixels, {found.full} of them see the phantom with their whole cone ('full')",
        f"{found.machine}; tracing alone: {found.raw_rate / 1e6:.3g} million rays a second that can meet it ('raw')",
        f"reference: {found.reference}, stated error {found.stated:.1e} RMS, {found.stated_largest:.1e} at the most",
    ]
    lines += [f"checked by: {found.check}"] if found.check else []
    lines += [f"skipped: {method}: {reason}" for method, reason in found.skipped.items()]
    return "\n".join([*lines, "", table(_methods(found)), "", table(_beside_path(found))])


def table(rows: Sequence[Sequence[str]]) -> str:
    """Markdown, the first row the head, columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["| " + " | ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "|".join("-" * (w + 2) for w in widths) + "|", *lines[1:]])


def _methods(found: Convergence) -> list[list[str]]:
    """A row a method: rates of the finest setting, the largest memory, the coarsest setting's first run."""
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


def _beside_path(found: Convergence) -> list[list[str]]:
    """Times to an error, how many times longer `path` with Mitsuba's best sampler takes, and its other samplers."""
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
