"""Analytic bodies for the reference integral: where a line first meets them, their normal, their area.

World coordinates in mm, float64. Every body has the same three methods:

    meet(origin, direction) -> (n,)   s > 0 of the first point origin + s·direction on it, inf for none
    outward(points) -> (n, 3)         unit normal at points of its surface
    surface(square) -> points, area   area-preserving map of the unit square onto it, but for scale; its area [mm²]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Shape(Protocol):
    """Methods of a body that the reference calls."""

    def meet(self, origin: Array, direction: Array) -> Array: ...

    def outward(self, points: Array) -> Array: ...

    def surface(self, square: Array) -> tuple[Array, float]: ...


@dataclass(frozen=True)
class Sphere:
    """Sphere of `radius` [mm] about `centre`; emits outwards."""

    centre: ArrayLike
    radius: float

    def meet(self, origin: Array, direction: Array) -> Array:
        return _first(*_ball(origin - np.asarray(self.centre), direction, self.radius))

    def outward(self, points: Array) -> Array:
        return (points - np.asarray(self.centre)) / self.radius

    def surface(self, square: Array) -> tuple[Array, float]:
        # Archimedes: equal steps along the axis are equal areas.
        height, angle = 2 * square[:, 0] - 1, 2 * np.pi * square[:, 1]
        ring = np.sqrt(1 - height**2)
        unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
        return np.asarray(self.centre) + self.radius * unit, 4 * np.pi * self.radius**2


@dataclass(frozen=True)
class Disc:
    """Flat disc of `radius` [mm] about `centre`; emits on the side of `normal`, its back is dark."""

    centre: ArrayLike
    normal: ArrayLike
    radius: float

    def meet(self, origin: Array, direction: Array) -> Array:
        centre, normal = np.asarray(self.centre), _unit(self.normal)
        s = _plane(origin - centre, direction, normal)
        miss = ~np.isfinite(s)
        hit = origin + np.where(miss, 0.0, s)[:, None] * direction - centre
        return np.where(miss | (dot(hit, hit) > self.radius**2), np.inf, s)

    def outward(self, points: Array) -> Array:
        return np.broadcast_to(_unit(self.normal), points.shape)

    def surface(self, square: Array) -> tuple[Array, float]:
        points = np.asarray(self.centre) + self.radius * unit_disc(square) @ _across(_unit(self.normal))
        return points, np.pi * self.radius**2


@dataclass(frozen=True)
class Rectangle:
    """centre ± `half_width` ± `half_height` (orthogonal, mm); emits along half_width × half_height."""

    centre: ArrayLike
    half_width: ArrayLike
    half_height: ArrayLike

    def meet(self, origin: Array, direction: Array) -> Array:
        across = np.stack([np.asarray(self.half_width), np.asarray(self.half_height)])
        s = _plane(origin - np.asarray(self.centre), direction, self._normal())
        miss = ~np.isfinite(s)
        hit = origin + np.where(miss, 0.0, s)[:, None] * direction - np.asarray(self.centre)
        inside = np.all(np.abs(hit @ across.T) <= dot(across, across), axis=1)
        return np.where(miss | ~inside, np.inf, s)

    def outward(self, points: Array) -> Array:
        return np.broadcast_to(self._normal(), points.shape)

    def surface(self, square: Array) -> tuple[Array, float]:
        across = np.stack([np.asarray(self.half_width), np.asarray(self.half_height)])
        area = 4 * float(np.prod(np.linalg.norm(across, axis=1)))
        return np.asarray(self.centre) + (2 * square - 1) @ across, area

    def _normal(self) -> Array:
        return _unit(np.cross(np.asarray(self.half_width), np.asarray(self.half_height)))


@dataclass(frozen=True)
class Cylinder:
    """Closed circular cylinder about `centre`, `height` [mm] along `axis`; emits outwards, caps too."""

    centre: ArrayLike
    axis: ArrayLike
    radius: float
    height: float

    def meet(self, origin: Array, direction: Array) -> Array:
        axis = _unit(self.axis)
        start = origin - np.asarray(self.centre)
        along, slope = start @ axis, direction @ axis
        sides = _ball(start - along[:, None] * axis, direction - slope[:, None] * axis, self.radius)
        with np.errstate(divide="ignore", invalid="ignore"):
            faces = np.sort((np.array([[-0.5], [0.5]]) * self.height - along) / slope, axis=0)
        # A line parallel to the caps lies between them along its whole length or not at all.
        between = np.where(np.abs(along) <= self.height / 2, np.inf, -np.inf)
        enter = np.where(slope == 0, -between, faces[0])
        leave = np.where(slope == 0, between, faces[1])
        return _first(np.maximum(sides[0], enter), np.minimum(sides[1], leave))

    def outward(self, points: Array) -> Array:
        axis = _unit(self.axis)
        along = (points - np.asarray(self.centre)) @ axis
        side = points - np.asarray(self.centre) - along[:, None] * axis
        distance = np.linalg.norm(side, axis=1)
        # On the surface one of the two is zero and the other negative.
        cap = np.abs(along) - self.height / 2 > distance - self.radius
        radial = np.divide(side, distance[:, None], out=np.zeros_like(side), where=~cap[:, None])
        return np.where(cap[:, None], np.sign(along)[:, None] * axis, radial)

    def surface(self, square: Array) -> tuple[Array, float]:
        axis, centre = _unit(self.axis), np.asarray(self.centre)
        cap, side = np.pi * self.radius**2, 2 * np.pi * self.radius * self.height
        part = square[:, 0] * (2 * cap + side)
        angle = 2 * np.pi * square[:, 1]
        # The first coordinate runs, in proportion to area, over the lower cap, the side and the upper cap.
        distance = self.radius * np.sqrt(np.clip(np.minimum(part, 2 * cap + side - part) / cap, 0, 1))
        along = self.height * np.clip((part - cap) / side - 0.5, -0.5, 0.5)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ _across(axis)
        return centre + along[:, None] * axis + distance[:, None] * ring, 2 * cap + side


def dot(a: Array, b: Array) -> Array:
    """Scalar products along the last axis, component by component: five times faster than NumPy's sum over three."""
    return np.einsum("...k,...k->...", a, b)


def unit_disc(square: Array) -> Array:
    """Points of the unit disc, shape (n, 2), from points of the unit square, areas kept [Shirley & Chiu,
    "A low distortion map between disk and square", J. Graphics Tools 2(3), 1997].
    """
    a, b = 2 * square[:, 0] - 1, 2 * square[:, 1] - 1
    wide = np.abs(a) > np.abs(b)
    radius = np.where(wide, a, b)
    other = np.where(wide, b, a)
    turn = np.pi / 4 * np.divide(other, radius, out=np.zeros_like(a), where=radius != 0)
    angle = np.where(wide, turn, np.pi / 2 - turn)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _unit(vector: ArrayLike) -> Array:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)


def _across(axis: Array) -> Array:
    """Two unit vectors orthogonal to `axis` and to each other, shape (2, 3)."""
    first = _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    return np.stack([first, np.cross(axis, first)])


def _plane(start: Array, direction: Array, normal: Array) -> Array:
    """Positive parameter at which lines cross the plane through 0, inf for none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        s = -(start @ normal) / (direction @ normal)
    return np.where(s > 0, s, np.inf)


def _ball(start: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    """Parameters between which lines are within `radius` of 0: (inf, -inf) for never."""
    a = dot(direction, direction)
    half = dot(start, direction)
    c = dot(start, start) - radius**2
    # a·c cancels against half² for a far lens; the distance of the line from 0 does not.
    nearest = start - np.divide(half, a, out=np.zeros_like(a), where=a > 0)[:, None] * direction
    discriminant = a * (radius**2 - dot(nearest, nearest))
    root = np.sqrt(np.maximum(discriminant, 0))
    # The root that adds like signs is free of cancellation, the other follows from their product c/a.
    q = -(half + np.copysign(root, half))
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([q / a, c / q]), axis=0)
    always = (a == 0) & (c <= 0)
    miss = (discriminant <= 0) & ~always
    enter = np.where(always, -np.inf, np.where(miss, np.inf, ends[0]))
    return enter, np.where(always, np.inf, np.where(miss, -np.inf, ends[1]))


def _first(enter: Array, leave: Array) -> Array:
    """First positive parameter at which lines meet a convex body that they enter and leave at these; inf for none."""
    s = np.where(enter > 0, enter, leave)
    return np.where((enter <= leave) & (s > 0), s, np.inf)
