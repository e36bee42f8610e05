"""Discs of the lens plane through which lines of sight pass, and the blur disc of a point out of focus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Disc:
    """Disc of the lens plane through which the virtual point (x, y, u) is seen (Eq. M.7 of docs/model.md).

    shift : κ, the centre is at κ (x, y): 0 for a border in the lens plane, 1 for a cone that moves with the point
    radius : R [mm]
    """

    shift: float
    radius: float


def defocus(depth: Any, focus_distance: Any, shift: Any) -> tuple[Any, Any]:
    """Defocus b = (u - z)/u and scale m of a point at `depth` z [mm], both without unit (Eq. M.7 of docs/model.md).

    The line of sight from the lens point a = κx + ρ, κ = `shift`, through the virtual point x is at depth z at
    r = x + (a - x) b. This equation, solved for x, gives the point of the virtual detector plane at which light from r
    towards the point ρ of the disc arrives:

        x = r/m - ρ b/m,   m = 1 - (1 - κ) b

    The blur disc of r therefore has its centre at r/m and the radius R |b|/m, with the radius R of the disc. For m <= 0
    the blur disc is not bounded. Arguments are floats, NumPy arrays or Dr.Jit arrays, and the results likewise.
    """
    back = (focus_distance - depth) / focus_distance
    return back, 1 - (1 - shift) * back
