"""Execution of `fspt stability`: a case is a stiff or extreme scene, its result an error or a refusal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..runtime.errors import FsptError

NAME_WIDTH = 46  # characters of the longest case's name


@dataclass(frozen=True)
class Case:
    """One row of the table.

    name : the stiff or extreme property
    why : the reference that the image is compared with
    run : function that returns the largest relative error, >= 0 (no unit); NaN for an image that is not finite
    tolerance : largest error allowed, > 0; None if float32 cannot give a right result, so that a refusal is expected
    slow : True for a case that is run on request only
    """

    name: str
    why: str
    run: Callable[[], float]
    tolerance: float | None
    slow: bool = False


@dataclass(frozen=True)
class Result:
    """Result of a case: its `error`, or the message of its `refusal`, and its run time [s]."""

    case: Case
    error: float | None
    refusal: str | None
    seconds: float

    @property
    def ok(self) -> bool:
        """True if the error is within the tolerance, or if the case was refused as expected. NaN is never right."""
        if self.case.tolerance is None or self.error is None:
            return self.case.tolerance is None and self.refusal is not None
        return 0 <= self.error <= self.case.tolerance

    def render_text(self) -> str:
        """The row as text: case, tolerance, error or 'refused', ok or FAIL, seconds; last a refusal's message."""
        tolerance = "refuse" if self.case.tolerance is None else f"{self.case.tolerance:.0e}"
        reached = "refused" if self.error is None else f"{self.error:.1e}"
        verdict = "ok" if self.ok else "FAIL"
        row = f"{self.case.name:<{NAME_WIDTH}}  {tolerance:>6}  {reached:>7}  {verdict:<4}  {self.seconds:6.2f} s"
        return f"{row}  {self.refusal}" if self.refusal else row

    def to_dict(self) -> dict[str, str | float | bool | None]:
        """The row as plain data for JSON; the error is None where it is not finite and where the case was refused."""
        error = self.error if self.error is not None and math.isfinite(self.error) else None
        return {
            "case": self.case.name,
            "truth": self.case.why,
            "tolerance": self.case.tolerance,
            "error": error,
            "refusal": self.refusal,
            "ok": self.ok,
            "seconds": round(self.seconds, 3),
        }


def check(case: Case) -> Result:
    """Run a case. An FsptError counts as its refusal; any other exception is an error of the code and is raised."""
    start = time.perf_counter()
    error, refusal = None, None
    try:
        error = float(case.run())
    except FsptError as refused:
        refusal = str(refused)
    return Result(case, error, refusal, time.perf_counter() - start)
