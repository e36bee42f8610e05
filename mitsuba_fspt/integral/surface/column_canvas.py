"""Windows of pixels on which the light of each column of the transport matrix (Eq. M.20) is accumulated.

The rectangle of pixels that a column (the hat function of a vertex, or a face) lights is computed beforehand. All
rectangles lie one after the other in one flat buffer. As in `footprint`, edges of polygons add the light to their
right, and cumulative sums along the rows complete it; here the density of light varies linearly over a polygon, and
another sum contains the part that grows with the pixel's column. All sums are of integers: their order has no effect,
and the light is exactly 0 outside a polygon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...jit.from_numpy import from_numpy
from .footprint import along_edges
from .pixel_sums import PixelSums

PLACE = 8  # numbers of a `_Place` in the table, a power of two
QUANTUM = 2.0**-46  # of the light on a pixel, over that of a pixel filled by 1 W/mm²/sr
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Plane:
    """Density of light on the film that is linear in the position: `at` + `x`·x + `y`·y, in light a pixel [pixels]."""

    at: mi.Float64
    x: mi.Float64
    y: mi.Float64


@dataclass(frozen=True)
class Windows:
    """A rectangle of pixels for each column: `left`, `top`, `width`, `height` (n,), empty for one without light."""

    left: Index
    top: Index
    width: Index
    height: Index

    @classmethod
    def around(cls, low: NDArray[np.float64], high: NDArray[np.float64], shape: tuple[int, int]) -> Windows:
        """Pixels of a film (h, w) that rectangles `low` … `high` (n, 2) in x, y touch; empty where low > high."""
        size = np.array(shape[::-1])
        first = np.clip(np.floor(np.where(low <= high, low, 0)), 0, size).astype(np.int64)
        last = np.clip(np.ceil(np.where(low <= high, high, 0)), 0, size).astype(np.int64)
        width, height = np.maximum(last - first, 0).T
        none = (width == 0) | (height == 0)
        return cls(first[:, 0], first[:, 1], np.where(none, 0, width), np.where(none, 0, height))

    @property
    def pixels(self) -> int:
        """Pixels of all windows together, more than can have light."""
        return int((self.width * self.height).sum())

    @property
    def areas(self) -> Index:
        """Pixels of each window (n,), and one more a row, which takes the light to the right of the window."""
        return (self.width + 1) * self.height * (self.width > 0)

    def columns(self) -> Index:
        """The column of each entry of the flat buffer."""
        return np.repeat(np.arange(len(self.left)), self.areas)

    def columns_of_film(self) -> Index:
        """The column of the film of each entry of the flat buffer; one beyond the window at the end of a row."""
        wide = np.repeat(self.width + 1, self.areas)
        starts = np.cumsum(self.areas) - self.areas
        return (np.arange(len(wide)) - np.repeat(starts, self.areas)) % wide + np.repeat(self.left, self.areas)

    def rows_of_film(self) -> Index:
        """The row of the film of each entry of the flat buffer."""
        wide = np.repeat(self.width + 1, self.areas)
        starts = np.cumsum(self.areas) - self.areas
        return (np.arange(len(wide)) - np.repeat(starts, self.areas)) // wide + np.repeat(self.top, self.areas)

    def inside(self) -> NDArray[np.bool_]:
        """False for the entry at the end of each row, which takes the light to the right of the window."""
        return self.columns_of_film() < np.repeat(self.left + self.width, self.areas)

    def of(self, columns: NDArray[np.bool_]) -> Windows:
        """The same windows with those of other columns left empty."""
        return Windows(self.left, self.top, self.width * columns, self.height * columns)


@dataclass(frozen=True)
class _Place:
    """Window of one column: `left`, `top`, `width`, `height` on the film [pixels], and its `start` in the buffer."""

    left: mi.Int32
    top: mi.Int32
    width: mi.Int32
    height: mi.Int32
    start: mi.UInt32


class ColumnCanvas:
    """The film of `shape` (h, w) once for every column, but only its `windows`."""

    def __init__(self, shape: tuple[int, int], windows: Windows) -> None:
        self.shape, self.windows = shape, windows
        self._starts = np.concatenate([[0], np.cumsum(windows.areas)])
        # Of every pixel: the light that it and all pixels to its right get, the light that only those get, and the
        # increase of the first from pixel to pixel.
        self._sums = PixelSums(int(self._starts[-1]))
        # The `_Place` of each column, and last of a column without window.
        table = np.zeros((len(windows.left) + 1, PLACE), np.uint32)
        table[:-1, :5] = np.stack([windows.left, windows.top, windows.width, windows.height, self._starts[:-1]], -1)
        self._table = from_numpy(mi.UInt32, table)
        self.none = dr.opaque(mi.UInt32, len(windows.left))
        self._size = tuple(dr.opaque(mi.Float64, side) for side in shape[::-1])
        self._sums.evaluate(self._table)

    def light(self) -> NDArray[np.float64]:
        """The light accumulated so far, one window after the other as `Windows.pixels` numbers them."""
        own, after, slope, _ = self._sums.array().T
        level = own.copy()
        level[1:] += after[:-1]
        level, slope = np.cumsum(level), np.cumsum(slope)
        slope *= self.windows.columns_of_film()
        level += slope
        return level * QUANTUM

    def evaluate(self, *others: object) -> None:
        """Run all kernels begun so far to their end, with those that compute `others`: the arrays of waiting ones would
        fill the memory."""
        self._sums.evaluate(*others)
        dr.sync_thread()

    def lay(
        self,
        columns: Sequence[mi.UInt32],
        planes: Sequence[Plane],
        ring: Sequence[mi.Point2d],
        count: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        """Lay light of linear density within a polygon of four corners [pixels] on the windows of several columns.

        `count`: its edges, 3 for a triangle, whose last corner is its first. Light beside a column's window is dropped;
        a column without window gets none.
        """
        turn = _cross(ring[2] - ring[0], ring[3] - ring[1])  # of a triangle, too, twice its area
        # A path all around adds up minus the area, or its opposite.
        way = dr.select(turn > 0, -1 / QUANTUM, 1 / QUANTUM)
        low_y = dr.minimum(dr.minimum(ring[0].y, ring[1].y), dr.minimum(ring[2].y, ring[3].y))
        high_y = dr.maximum(dr.maximum(ring[0].y, ring[1].y), dr.maximum(ring[2].y, ring[3].y))
        low_x = dr.minimum(dr.minimum(ring[0].x, ring[1].x), dr.minimum(ring[2].x, ring[3].x))
        active &= (low_x < self._size[0]) & (low_y < self._size[1]) & (high_y > 0)
        places = [self._place(column, active) for column in columns]
        mode = self._sums.mode(dr.width(turn))
        scaled = [Plane(way * plane.at, way * plane.x, way * plane.y) for plane in planes]

        def add(a: mi.Point2d, b: mi.Point2d, _crosses: mi.Bool) -> None:
            column, row = (dr.floor(dr.minimum(a[n], b[n])) for n in (0, 1))
            (xa, ya), (xb, yb) = ((p.x - column, p.y - row) for p in (a, b))
            x, y = mi.Int32(dr.clip(column, -1, self._size[0])), mi.Int32(dr.clip(row, -1, self._size[1]))
            for place, plane in zip(places, scaled, strict=True):
                self._add(place, plane, (column, row), (xa, ya, xb, yb), (x, y), mode)

        along_edges(ring, active, self._size, add, count)

    def _place(self, column: mi.UInt32, active: mi.Bool) -> _Place:
        """Where a column lies, from the table."""
        fields, first = mi.Int32(self._table), PLACE * column
        window = (dr.gather(mi.Int32, fields, first + k, active) for k in range(4))
        return _Place(*window, start=dr.gather(mi.UInt32, self._table, first + 4, active))

    def _add(self, place: _Place, plane: Plane, pixel: tuple, ends: tuple, at: tuple, mode: dr.ReduceMode) -> None:
        """Add the light to the right of a part ab of an edge: to its pixel and to all beyond in its row.

        pixel : column and row; ends : xa, ya, xb, yb in that pixel; at : the same pixel as whole numbers
        """
        (column, row), (xa, ya, xb, yb) = pixel, ends
        rise = yb - ya
        # ∫ dy of the density over a whole pixel at column 0, up to each end: a function of one point, so that the
        # differences of the rounded values cancel around a polygon.
        base = plane.at + 0.5 * plane.x + plane.y * row
        level = dr.round(yb * (base + 0.5 * plane.y * yb)) - dr.round(ya * (base + 0.5 * plane.y * ya))
        slope = dr.round(plane.x * yb) - dr.round(plane.x * ya)
        # ∫ dy ∫ dx of the density from the pixel's left side to the edge.
        corner = plane.at + plane.x * column + plane.y * row
        squares = xa * xa + xa * xb + xb * xb
        mixed = ya * (2 * xa + xb) + yb * (xa + 2 * xb)
        beside = dr.round(rise * (0.5 * corner * (xa + xb) + plane.x * squares / 6 + plane.y * mixed / 6))
        x, y = at[0] - place.left, at[1] - place.top
        on = (y >= 0) & (y < place.height) & (place.width > 0)
        line = place.start + mi.UInt32(y) * mi.UInt32(place.width + 1)
        # Outside the window both are added to the same entry.
        outside = (x < 0) | (x >= place.width)
        level, beside = mi.Int64(level - beside), mi.Int64(beside)
        amounts = level + dr.select(outside, beside, 0), dr.select(outside, 0, beside), mi.Int64(slope)
        self._sums.add(line + mi.UInt32(dr.clip(x, 0, place.width)), amounts, on, mode)


def _cross(a: mi.Vector2d, b: mi.Vector2d) -> mi.Float64:
    return a.x * b.y - a.y * b.x
