"""Spheres and cylinders that describe light sources and inclusions. Lengths in mm, NumPy float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FluxError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Nodes:
    """Small uniform spheres that together approximate a shape.

    centres : (K, 3) [mm]
    radii : (K,) [mm], 0 for a point
    shares : (K,) of the shape's power, with the sum 1
    """

    centres: Array
    radii: Array
    shares: Array


@dataclass(frozen=True)
class Sphere:
    """Sphere about `centre` (x, y, z) [mm] of `radius` [mm] >= 0; radius 0 is a point.

    Raises
    ------
    FluxError : a coordinate is not finite, the radius negative.
    """

    centre: Vector
    radius: float = 0.0

    def __post_init__(self) -> None:
        _require_finite("centre", self.centre)
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise FluxError(f"sphere: 'radius' must be >= 0 and finite, got {self.radius:g}. Give mm.")

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of `points` (N, 3) [mm] lies in the sphere, its border included; shape (N,)."""
        return np.asarray(np.linalg.norm(points - np.asarray(self.centre), axis=1) <= self.radius)

    def nodes(self, spacing: float) -> Nodes:
        """The sphere itself, whatever the spacing [mm]: its field is known in closed form."""
        return Nodes(np.array([self.centre], dtype=float), np.array([self.radius]), np.ones(1))

    def border(self) -> Array:
        """Points of the border, (M, 3) [mm]; for radius 0 the centre."""
        centre = np.array([self.centre], dtype=float)
        if self.radius == 0:
            return centre
        # A spiral with equal steps in height from pole to pole covers the sphere evenly.
        height = np.linspace(-1, 1, 64)
        angle = math.pi * (1 + math.sqrt(5)) * np.arange(64)
        across = np.sqrt(1 - height**2)
        return centre + self.radius * np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)


@dataclass(frozen=True)
class Cylinder:
    """Solid cylinder about `centre` (x, y, z) [mm], `length` > 0 and `radius` >= 0 [mm], along `axis`.

    Radius 0 is a line segment; the axis may have any length but 0.

    Raises
    ------
    FluxError : a number is not finite, the length not positive, the radius negative, the axis zero.
    """

    centre: Vector
    length: float
    radius: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        _require_finite("centre", self.centre)
        _require_finite("axis", self.axis)
        if not any(self.axis):
            raise FluxError("cylinder: 'axis' must not be (0, 0, 0). Give a direction, for example [0, 0, 1].")
        if not (math.isfinite(self.length) and self.length > 0):
            raise FluxError(f"cylinder: 'length' must be > 0 and finite, got {self.length:g}. Give mm.")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise FluxError(f"cylinder: 'radius' must be >= 0 and finite, got {self.radius:g}. Give mm.")

    @property
    def frame(self) -> Array:
        """Three orthonormal rows, the last one along the axis; shape (3, 3)."""
        along = np.asarray(self.axis, dtype=float)
        along /= np.linalg.norm(along)
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(along, across), along])

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of `points` (N, 3) [mm] lies in the cylinder, its border included; shape (N,)."""
        x, y, z = self.frame @ (points - np.asarray(self.centre)).T
        return np.asarray((np.hypot(x, y) <= self.radius) & (np.abs(z) <= self.length / 2))

    def nodes(self, spacing: float) -> Nodes:
        """Points of a product rule that is uniform over the volume, closer than `spacing` [mm].

        Gauss–Legendre along the axis and in the squared radius, equal steps in angle: outside the cylinder
        its field converges exponentially.
        """
        z, z_weight = _gauss(4 + math.ceil(self.length / spacing))
        rings = 2 + math.ceil(self.radius / spacing) if self.radius > 0 else 0
        square, square_weight = _gauss(rings) if rings else (np.zeros(1), np.ones(1))
        angle = np.linspace(0, 2 * math.pi, max(1, 4 * rings), endpoint=False)
        zz, ss, aa = np.meshgrid((z - 0.5) * self.length, self.radius * np.sqrt(square), angle, indexing="ij")
        local = np.stack([ss * np.cos(aa), ss * np.sin(aa), zz], axis=-1).reshape(-1, 3)
        shares = (z_weight[:, None, None] * square_weight[:, None] / len(angle) * np.ones(len(angle))).ravel()
        return Nodes(local @ self.frame + np.asarray(self.centre), np.zeros(len(shares)), shares)

    def border(self) -> Array:
        """Points of both rims and of the circle half-way between them, and the centres of all three, (M, 3) [mm]."""
        angle = np.arange(32) * (2 * math.pi / 32)
        rim = np.stack([self.radius * np.cos(angle), self.radius * np.sin(angle), 0 * angle], axis=1)
        rim = np.concatenate([rim, np.zeros((1, 3))])
        end = np.array([0, 0, self.length / 2])
        return np.concatenate([rim - end, rim, rim + end]) @ self.frame + np.asarray(self.centre)


Shape = Sphere | Cylinder


def _gauss(count: int) -> tuple[Array, Array]:
    """Gauss–Legendre nodes and weights on [0, 1]."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return (x + 1) / 2, weight / 2


def _require_finite(name: str, vector: Vector) -> None:
    if len(vector) != 3 or not all(math.isfinite(x) for x in vector):
        raise FluxError(f"shape: '{name}' must be three finite numbers [mm], got {vector}.")
