"""Distortion of a lens by OpenCV's model: where the image of a line of sight lies on the film (Eq. M.44).

With the slopes (x, y) of the line to the centre of the entrance pupil, x to the right and y downwards in the upright
image, and r² = x² + y², the image lies at F (1 + t/P) (x_d, y_d),

    x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2x²)
    y_d = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2y²) + 2 p2 x y

The formulas take numbers, NumPy arrays or Dr.Jit arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..runtime.errors import OpticsError

LENGTHS = (2, 4, 5)  # of OpenCV's tuple that are taken: k1, k2[, p1, p2[, k3]]
ROUNDS = 6  # of Newton's method, quadratic: 20 % of distortion to float32's rounding after four
DIRECTIONS, STEPS = 64, 256  # of lines from the middle, and points on each, where the map is searched for folds
BEYOND = 1.1  # times the slopes of the film's corners: from there on the map is continued linearly
FARTHEST = 4.0  # times the slope of a corner: no lens in use has its preimage beyond


@dataclass(frozen=True)
class Distortion:
    """Coefficients k1, k2, p1, p2 and k3, all without unit, in OpenCV's order."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @classmethod
    def of(cls, values: object) -> Distortion | None:
        """From a text "k1, k2[, p1, p2[, k3]]" or a sequence of numbers; None if all are 0.

        Raises
        ------
        OpticsError : another length, or a coefficient that is no finite number.
        """
        given: Sequence[object]
        if isinstance(values, str):
            given = [part for part in values.replace(",", " ").split()]
        else:
            given = np.ravel(np.asarray(values, object)).tolist()
        try:
            numbers = [float(value) for value in given]  # type: ignore[arg-type]
        except (TypeError, ValueError):
            numbers = [math.nan]
        if not all(map(math.isfinite, numbers)):
            raise OpticsError(
                f"'distortion' must be finite numbers, got {values!r}. Give OpenCV's k1, k2, p1, p2, k3 as a text, for "
                'example "-0.12, 0.03".'
            )
        if len(numbers) not in LENGTHS:
            raise OpticsError(
                f"'distortion' has {len(numbers)} numbers, OpenCV's model takes k1, k2[, p1, p2[, k3]]. Give 2, 4 or 5."
            )
        found = cls(*numbers)
        return found if any(numbers) else None

    def __str__(self) -> str:
        return ", ".join(f"{getattr(self, field.name):.9g}" for field in fields(self))

    @property
    def coefficients(self) -> tuple[float, ...]:
        """k1, k2, p1, p2, k3."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def limit(self, corner: float, scale: float) -> float:
        """Slope up to which the map is used, a little beyond the film's corners; beyond, it is continued linearly.

        corner : distorted slope of the film's corners
        scale : image height [mm] per distorted slope, for the message

        Raises
        ------
        OpticsError : the map folds, or never reaches the corners, inside the film; the message gives the radius.
        """
        angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        radius = corner * FARTHEST * np.arange(STEPS * int(FARTHEST) + 1)[:, None] / (STEPS * FARTHEST)
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        height = np.hypot(*distorted(x, y, self.coefficients))
        a, b, d = slopes(x, y, self.coefficients)
        folded = (a * d - b * b <= 0) | (a + d <= 0)
        reached = np.maximum.accumulate(height, axis=0)
        inside = reached < corner
        if (folded & inside).any() or inside[-1].any():
            bad = (folded & inside) | (np.arange(len(radius))[:, None] == len(radius) - 1) & inside
            least = float(np.where(bad, reached, np.inf).min())
            raise OpticsError(
                f"'distortion' = {self} folds the image at a radius of {scale * least:.4g} mm, inside the film, whose "
                f"corners lie at {scale * corner:.4g} mm. Calibrate with fewer coefficients, or give a smaller film."
            )
        farthest = float(radius[inside.any(axis=1), 0].max()) * (1 + 1 / STEPS)
        for factor in np.linspace(BEYOND, 1.0, 6):
            beyond = radius[:, 0] <= factor * farthest
            if not folded[beyond].any():
                return factor * farthest
        return farthest


def distorted(x: Any, y: Any, coefficients: Sequence[Any]) -> tuple[Any, Any]:
    """Distorted slopes (x_d, y_d) of slopes (x, y) (Eq. M.44)."""
    k1, k2, p1, p2, k3 = coefficients
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def slopes(x: Any, y: Any, coefficients: Sequence[Any]) -> tuple[Any, Any, Any]:
    """∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x and ∂y_d/∂y of Eq. M.44; the matrix is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    growth = k1 + square * (2 * k2 + square * (3 * k3))  # of `radial` by r²
    return (
        radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * growth + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x,
    )


def continued(x: Any, y: Any, coefficients: Sequence[Any], shrink: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Distorted slopes and their derivatives, continued linearly beyond the limit of the map.

    shrink : min(1, limit over the length of (x, y)), of the same kind as x
    """
    u, v = x * shrink, y * shrink
    a, b, d = slopes(u, v, coefficients)
    x_d, y_d = distorted(u, v, coefficients)
    return x_d + a * (x - u) + b * (y - v), y_d + b * (x - u) + d * (y - v), a, b, d


def preimage(
    x_d: Any, y_d: Any, coefficients: Sequence[Any], shrink: Callable[[Any, Any], Any]
) -> tuple[Any, Any, Any]:
    """Slopes (x, y) with the distorted slopes (x_d, y_d), by Newton's method, and dx dy/(dx_d dy_d) there.

    shrink : of x and y, as `continued` takes it
    """
    x, y = x_d, y_d
    for _ in range(ROUNDS):
        found_x, found_y, a, b, d = continued(x, y, coefficients, shrink(x, y))
        u, v, area = x_d - found_x, y_d - found_y, a * d - b * b
        x, y = x + (d * u - b * v) / area, y + (a * v - b * u) / area
    _, _, a, b, d = continued(x, y, coefficients, shrink(x, y))
    return x, y, 1 / (a * d - b * b)


def shrink_in_double(x: Any, y: Any, limit: float) -> Any:
    """`shrink` of `continued` for NumPy arrays."""
    return np.minimum(1.0, limit / np.maximum(np.hypot(x, y), np.finfo(np.float64).tiny))
