"""Footprints: polygons of light of Eq. M.9 on the film, distributed exactly over the pixels that they overlap.

Each edge adds the area to its right to every pixel that it crosses; cumulative sums along the rows turn the edges of a
polygon into its overlap with every pixel, whatever its size. All sums are of integers: the result does not depend on
the order in which threads add, and is exactly 0 outside a polygon.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .pixel_sums import PACKET, PixelSums

GRID = 2.0**-20  # corners lie on a grid this fine [pixels], where differences of coordinates are exact
SPECK = 2.0**-4  # half the side [pixels] of the square that stands for a polygon folded over
DENSEST = 2.0**57  # largest density of a polygon [quanta a pixel]

Part = tuple["mi.Float64", "mi.Float64", list["mi.Float64"]]  # column, row, and the amounts of `Canvas._add`


class Canvas:
    """Film of `shape` (h, w) that accumulates one quantity or two, each in integer multiples of its quantum.

    `centres` False: a pixel gets the light on its area; True: the density at its centre times that area. A pixel
    has up to 2⁶² quanta, a polygon `DENSEST` quanta a pixel.
    """

    def __init__(self, shape: tuple[int, int], quanta: Sequence[float], centres: bool) -> None:
        self.shape, self.quanta, self.centres = shape, quanta, centres
        # Of every pixel and quantity: what it and all pixels to its right get, and what only those get.
        self.sums = PixelSums(shape[0] * shape[1])
        # Opaque numbers: another film is the same kernel.
        self._scales = [dr.opaque(mi.Float64, 1 / quantum) for quantum in quanta]
        self._height, self._width = (dr.opaque(mi.Float64, side) for side in shape)

    def images(self) -> list[NDArray[np.float64]]:
        """Each quantity accumulated so far, shape (h, w)."""
        sums = self.sums.array().reshape(*self.shape, PACKET)
        images = []
        for k, quantum in enumerate(self.quanta):
            step, after = sums[..., 2 * k].copy(), sums[..., 2 * k + 1]
            step[:, 1:] += after[:, :-1]
            images.append(np.cumsum(step, axis=1) * quantum)
        return images

    def lay(self, lights: Sequence[mi.Float64], polygon: Sequence[mi.Point2f], active: mi.Bool) -> None:
        """Distribute `lights` evenly over a polygon of four corners [pixels]; the part beside the canvas is dropped.

        A polygon that is not convex, or too small for its light, is replaced by a small square about its middle.
        """
        lights = [light * scale for light, scale in zip(lights, self._scales, strict=True)]
        ring, active = _sound(polygon, lights), mi.Bool(active)
        if self.centres:  # at whole numbers from here on, and half a grid step off, so that no corner is level with one
            ring = [corner - mi.Point2d(0.5, 0.5 + GRID / 2) for corner in ring]
        area = 0.5 * _cross(ring[2] - ring[0], ring[3] - ring[1])
        # A path all around adds up Σ dy (w - x) = -area.
        densities = [-light / area for light in lights]
        low, high = _bound(dr.minimum, ring), _bound(dr.maximum, ring)
        # False also where a corner is not finite.
        active &= (low.x < self._width) & (low.y < self._height) & (high.y > 0) & (low.x > -dr.inf) & (high.x < dr.inf)
        amounts, mode = _crossing if self.centres else _area, self.sums.mode(dr.width(area))

        def add(a: mi.Point2d, b: mi.Point2d, crosses: mi.Bool) -> None:
            self._add(*amounts(densities, a, b, crosses), mode)

        along_edges(ring, active, (self._width, self._height), add)

    def _add(self, column: mi.Float64, row: mi.Float64, amounts: Sequence[mi.Float64], mode: dr.ReduceMode) -> None:
        """Add, of each quantity, the first amount to all pixels of a row from a column on, the second from the next."""
        on = (column < self._width) & (row >= 0) & (row < self._height)
        at = mi.UInt32(dr.select(on, row * self._width + dr.maximum(column, 0), 0))
        packet = []
        for first, after in zip(map(mi.Int64, amounts[::2]), map(mi.Int64, amounts[1::2]), strict=True):
            # Left of the canvas both are added to its first column.
            packet += [first + dr.select(column < 0, after, 0), dr.select(column < 0, 0, after)]
        self.sums.add(at, packet, on, mode)


def _area(densities: Sequence[mi.Float64], a: mi.Point2d, b: mi.Point2d, crosses: mi.Bool) -> Part:
    """The area to the right of ab, within one pixel, in this pixel and in all beyond in its row."""
    column, row = (dr.floor(dr.minimum(a[n], b[n])) for n in (0, 1))
    beyond = 0.5 * (a.x + b.x) - column
    amounts = []
    for density in densities:
        # A difference of two rounded heights, each a function of one point: around a polygon they cancel.
        rise = dr.round(density * (b.y - row)) - dr.round(density * (a.y - row))
        after = dr.round(density * (b.y - a.y) * beyond)
        amounts += [rise - after, after]
    return column, row, amounts


def _crossing(densities: Sequence[mi.Float64], a: mi.Point2d, b: mi.Point2d, crosses: mi.Bool) -> Part:
    """Where ab ends on a line of centres, the density at all centres to the right."""
    amounts = []
    for density in densities:
        rise = dr.round(dr.select(b.y > a.y, density, -density))
        amounts += [dr.select(crosses, rise, 0), mi.Float64(0)]
    return dr.ceil(b.x), b.y, amounts


def along_edges(
    ring: Sequence[mi.Point2d],
    active: mi.Bool,
    size: tuple[mi.Float64, mi.Float64],
    add: Callable[[mi.Point2d, mi.Point2d, mi.Bool], None],
    count: mi.UInt32 | int = 4,
) -> None:
    """Call `add(a, b, crosses)` for every part, within one pixel, of the edges of a polygon of four corners [pixels].

    `crosses`: b lies on a line between rows. Edges beyond a film of `size` (w, h) are not divided. `count`: 3 for a
    triangle, whose last corner is its first.
    """
    border = mi.Point2d(*size)

    def step(k: mi.UInt32, edge: mi.UInt32, a: mi.Point2d, q: mi.Point2d, *rest: mi.Point2d) -> tuple:
        """From a towards the corner q as far as the next line between pixels."""
        d = q - a
        line = dr.clip(dr.select(d > 0, dr.floor(a) + 1, dr.ceil(a) - 1), 0, border)
        until = dr.select((line - a) * d > 0, (line - a) / d, dr.inf)
        t = dr.minimum(until.x, until.y)
        b = a + t * d
        b = dr.select(until < dr.inf, dr.select(d > 0, dr.minimum(b, line), dr.maximum(b, line)), b)
        b = dr.select(until <= t, line, b)
        arrived = ~(t < 1)
        b = dr.select(arrived, q, b)
        add(a, b, ~arrived & (until.y <= t))
        rest = [dr.select(arrived, new, old) for new, old in zip((*rest, q), (q, *rest), strict=True)]
        return k + 1, edge + dr.select(arrived, 1, 0), b, *rest

    edges = dr.select(active, mi.UInt32(count), 0)
    most = mi.UInt32(4 * (border.x + border.y + 8))
    start = (mi.UInt32(0), mi.UInt32(0), ring[0], *ring[1:], ring[0])
    dr.while_loop(start, lambda k, edge, *_: (edge < edges) & (k < most), step)


def _sound(polygon: Sequence[mi.Point2f], lights: Sequence[mi.Float64]) -> list[mi.Point2d]:
    """The corners on the grid, or those of a speck."""
    ring = [mi.Point2d(dr.round(mi.Point2d(corner) / GRID) * GRID) for corner in polygon]
    turns = [_cross(ring[k - 1] - ring[k - 2], ring[k] - ring[k - 1]) for k in range(4)]
    sound = (_bound(dr.minimum, turns) >= 0) | (_bound(dr.maximum, turns) <= 0)
    area = 0.5 * dr.abs(_cross(ring[2] - ring[0], ring[3] - ring[1]))
    for light in lights:
        sound &= (area > GRID) & (light < DENSEST * area)
    middle = mi.Point2d(dr.round(0.25 * (ring[0] + ring[1] + ring[2] + ring[3]) / GRID) * GRID)
    speck = [middle + SPECK * mi.Vector2d(x, y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [dr.select(sound, own, other) for own, other in zip(ring, speck, strict=True)]


def _cross(a: mi.Vector2d, b: mi.Vector2d) -> mi.Float64:
    return a.x * b.y - a.y * b.x


def _bound(pick: Callable[..., Any], values: Sequence[Any]) -> Any:
    """Least or largest of four, component by component."""
    return pick(pick(values[0], values[1]), pick(values[2], values[3]))
