"""Eq. 9 in float64 NumPy, exact along the rows of the film: the reference at silhouettes of spheres and disks.

For one point of the pupil and one height y on the virtual detector plane, the lines of sight that meet a sphere or a
disk are those between two known x. So the silhouettes are exact along x; the three other coordinates, two of the pupil
and y, are sampled, and what is left is continuous in them: it converges much faster than samples of all four. It shares
no code with the integral. Camera frame and units as in `sampled`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import ReferenceCamera
from .sampled import lattice
from .shapes import unit_disc

Array = NDArray[np.float64]
LINES = 1 << 15  # lines of sight at a time: what fits into the cache
GAUSS = 0.5 + np.array([-1, 0, 1]) * np.sqrt(0.15), np.array([5, 8, 5]) / 18  # nodes and weights on [0, 1]


@dataclass(frozen=True)
class Sphere:
    """Sphere about `centre` [mm]; `exitance`: J_n [W/mm²], or a function of points (…, 3) on it, camera frame."""

    centre: Sequence[float]
    radius: float
    exitance: float | Callable[[Array], Array] = 1.0

    def row(self, ax: Array, ay: Array, y: Array, focus: float) -> tuple[Array, Array]:
        """Ends of the stretch of X = x - ax in which lines from (ax, ay, 0) to (x, y, focus) meet it, nan for none."""
        cx, cy, cz = self.centre[0] - ax, self.centre[1] - ay, self.centre[2]
        # (c·d)² ≥ (c² - r²) d² with d = (X, y - ay, focus): a quadratic in X.
        height, tangent = y - ay, cx**2 + cy**2 + cz**2 - self.radius**2
        along = cy * height + cz * focus
        a, b, c = tangent - cx**2, cx * along, along**2 - tangent * (height**2 + focus**2)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b**2 + a * c)
        return (b - root) / a, (b + root) / a

    def light(self, ax: Array, ay: Array, *line: Array | float) -> Array | float:
        """J_n at the first point of lines from (ax, ay, 0) along `line` (x, y, z), which meet it."""
        if not callable(self.exitance):
            return self.exitance
        start, along = (np.stack(np.broadcast_arrays(*parts), axis=-1) for parts in ((ax, ay, 0.0), line))
        away = start - np.asarray(self.centre)
        a, b, c = (np.sum(n, axis=-1) for n in (along**2, away * along, away**2))
        s = -(b + np.sqrt(np.maximum(b**2 - a * (c - self.radius**2), 0))) / a
        return self.exitance(start + s[..., None] * along)


@dataclass(frozen=True)
class Disk:
    """Disk about `centre` [mm] that faces the lens and is parallel to it; `exitance`: J_n [W/mm²]."""

    centre: Sequence[float]
    radius: float
    exitance: float = 1.0

    def row(self, ax: Array, ay: Array, y: Array, focus: float) -> tuple[Array, Array]:
        """As that of a sphere."""
        share = self.centre[2] / focus
        height = ay + (y - ay) * share - self.centre[1]
        with np.errstate(invalid="ignore"):
            half = np.sqrt(self.radius**2 - height**2)
        return (self.centre[0] - ax - half) / share, (self.centre[0] - ax + half) / share

    def light(self, *line: Array | float) -> float:
        """As that of a sphere."""
        return self.exitance


def truth(
    camera: ReferenceCamera,
    *objects: Sphere | Disk,
    nodes: int = 1 << 13,
    along: int = 16,
    part: tuple[int, int, int, int] | None = None,
    replicas: int = 4,
) -> tuple[Array, Array]:
    """Power on each pixel, integrated over its area, and its standard error [W], (h, w) each.

    objects : one, or two of which the first hides what of the second lies behind it
    nodes : points (pupil, y) of each of `replicas` lattices, whose shifts are unrelated; a power of two
    along : points of a row on each object in each pixel, where J_n is a function
    part : x, y, width and height of the pixels wanted, None for all
    """
    x, y, width, height = part or (0, 0, camera.width, camera.height)
    row, column = np.divmod(np.arange(height * width), width)
    left = (camera.width / 2 - x - column - 1) * camera.pixel_side
    low = (camera.height / 2 - y - row - 1) * camera.pixel_side
    random, step = np.random.default_rng(1), max(LINES // left.size, 1)
    runs = np.zeros((replicas, left.size))
    for run in runs:
        cube = lattice(nodes, random.random(4))
        pupil = camera.pupil_radius * unit_disc(cube[:, :2])
        for k in range(0, nodes, step):
            (ax, ay), (up, off) = pupil[k : k + step].T[..., None], cube[k : k + step, 2:].T[..., None]
            run += _rows(camera, objects, ax, ay, left - ax, low + up * camera.pixel_side, (off, along)).sum(axis=0)
    power = runs * camera.scale / nodes
    mean, error = power.mean(axis=0), power.std(axis=0, ddof=1) / np.sqrt(replicas)
    return mean.reshape(height, width), error.reshape(height, width)


def _rows(camera, objects, ax, ay, start, y, sampling):
    """Mean of J_n cos⁴θ over the stretch of x of every pixel, which begins at x - ax = `start`: (pupil, pixels)."""
    end, seen, before = start + camera.pixel_side, 0.0, None
    for shape in objects:
        ends = shape.row(ax, ay, y, camera.focus_distance)
        first, last = (np.clip(np.where(np.isnan(place), start, place), start, end) for place in ends)
        stretches = [(first, last)]
        if before is not None:  # what is to the left and to the right of the one before it
            one, other = (np.clip(place, first, last) for place in before)
            stretches = [(first, one), (other, last)]
        seen += sum(_stretch(camera, shape, ax, ay, y, *ends, *sampling) for ends in stretches)
        before = first, last
    return seen / camera.pixel_side


def _stretch(camera, shape, ax, ay, y, first, last, off, along):
    """∫ J_n cos⁴θ dx: Gauss nodes for what is smooth, else even points, at every point of the pupil moved by `off`."""
    total = np.zeros(first.shape)
    lit = np.nonzero(last > first)
    ax, ay, y, first, last, off = (np.broadcast_to(part, total.shape)[lit] for part in (ax, ay, y, first, last, off))
    nodes = GAUSS
    if callable(shape.exitance):
        nodes = (np.arange(along)[:, None] + off) / along, np.full(along, 1 / along)
    u, height = camera.focus_distance, y - ay
    for t, w in zip(*nodes, strict=True):
        x = first + t * (last - first)
        cos2 = u**2 / (x**2 + height**2 + u**2)
        total[lit] += w * (last - first) * shape.light(ax, ay, x, height, u) * cos2**2
    return total
