"""Discs of the lens plane that lines of sight have to pass, and the blur that a disc gives to points out of focus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Disc:
    """Disc of the lens plane open to a virtual point at (x, y, u): centre `shift`·(x, y), radius `radius` [mm].

    `shift` is 0 for a border that lies in the lens plane and 1 for a cone that moves along with the virtual point.
    """

    shift: float
    radius: float


def defocus(depth: Any, focus_distance: Any, shift: Any) -> tuple[Any, Any]:
    """How far out of focus a point at `depth` z [mm] is, (u - z)/u, and its scale on the virtual detector plane.

    The line of sight from the lens point a = shift·x + ρ through the virtual point x meets the plane at depth z in
    r = x + (a - x)(u - z)/u. Solved for x, light that leaves r for the point ρ of the disc arrives at

        x = r/scale - ρ · ((u - z)/u)/scale,   scale = 1 - (1 - shift)(u - z)/u        (Eq. M.7 of docs/model.md),

    so that the blur disc of r has its centre at r/scale and the radius R·|u - z|/u/scale, R the disc's own. A point
    with `scale` <= 0 counts as one without a bounded blur disc. Floats, NumPy arrays or Dr.Jit arrays; no unit.
    """
    back = (focus_distance - depth) / focus_distance
    return back, 1 - (1 - shift) * back
