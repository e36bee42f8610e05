"""Variation of J_n finer than nodes are apart, such as dark lines on a bright surface, which all of them may miss.

Nodes of Eq. M.5 that miss it show nothing of it. Points all over a surface are therefore compared with the mean
radiance of squares as large as a pixel, or as the blur radius where that is larger. What is smooth differs from the
plane through nine such means hardly more than these do. At the border of a surface, where squares lie on one side
alone, such a plane may lead astray, and the range of the means counts as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from ...camera.window import Window
from .narrow import COVERED, UNCERTAINTY, Points, most_on_pixels

GRAZING = 0.3  # largest cosine to the lens of a surface whose variation counts as that of a limb
SINGLE = 1.1  # largest share of a square that one surface covers
# Ranges by which the range of means is extended on both ends. Beside a step across squares their range about the plane
# through them is a third of the step, and points lie outside by that.
EXTENDED = 1.5
NEIGHBOURS = 3  # squares around a window whose points count as surroundings
COLLINEAR = 1e-3  # determinant of the spread of squares, over that of an even one, below which they lie on a line

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def fine_variation(points: Points | None, window: Window) -> Array:
    """Largest change of each pixel of a window (h, w) by variation of J_n finer than nodes are apart [W/mm²/sr]; 0
    without points."""
    found = np.zeros(window.shape)
    if points is None or not math.prod(window.shape) or not (points.varied > 0).any():
        return found
    points = points.seen_in(window, NEIGHBOURS)
    level, may = points.level(), points.near(points.blur, window.shape) & (points.apart < 1) & (points.varied > 0)
    for k in np.unique(level[may]):
        for number in np.unique(points.varied[may & (level == k)]):
            near = (points.varied == number) & points.near((NEIGHBOURS + 1) * 2**k, window.shape)
            own = points[near]
            off = np.where((may & (level == k))[near], _beyond(own, 2**k), 0)
            if (fine := off > 0).any():
                found += UNCERTAINTY * most_on_pixels(own[fine], off[fine], window.shape)
    return found


def _beyond(points: Points, side: float) -> Array:
    """Fine variation of the radiance of points (n,) of one surface, 0 of others [W/mm²/sr]: the largest difference from
    means over squares of a `side` [pixels], its own and those around, less their plane.

    It is 0 unless the point lies outside the extended range of these means; smooth J_n and a step from one value to
    another are within. Points do not count where one part of a surface lies before another, nor at the limb of a body,
    as their radiance varies within a square in any case.
    """
    cells = points.cells(side)
    share = np.minimum(points.area / side**2, 1)
    covered, count = cells.sums(share), cells.sums(np.ones_like(share))
    # As points lie in the middles of elements, a square may have more of these than it covers: by twice their side.
    most = SINGLE + 2 * np.sqrt(covered / np.maximum(count, 1))
    several = maximum_filter(covered > most, 3).ravel()[cells.number]
    mean, x, y = (
        np.divide(cells.sums(share * of), covered, out=np.zeros_like(covered), where=covered > 0)
        for of in (points.radiance, points.x, points.y)
    )
    known = (covered > COVERED).astype(np.float64)  # the rest of others belongs to larger elements
    at_border = (_around(known) < 9 - 0.5).ravel()[cells.number]  # not all nine, to rounding
    plane = _Plane.through(x, y, mean, known)
    judged = (points.cosine > GRAZING) & ~several & ~plane.line.ravel()[cells.number]
    found = np.where(judged, np.inf, 0)
    for model, where in ((plane, True), (plane.level(), at_border)):
        low, high = (end.ravel()[cells.number] for end in model.ends(x, y, mean, known))
        its = points.radiance - model.at(points.x, points.y, cells.number)
        off = np.maximum(its - low, high - its)
        outside = (high >= low) & (off > (1 + EXTENDED) * (high - low))
        found = np.where(where, np.minimum(found, np.where(outside, off, 0)), found)
    return found


@dataclass(frozen=True)
class _Plane:
    """Planes of least squares through the values of each square (h, w) and of those around: its `mean` at the middle
    (x, y), and slopes, which are 0 where the squares lie on a `line`, as beside a border of the surface.
    """

    mean: Array
    x: Array
    y: Array
    slopes: tuple[Array, Array]
    line: NDArray[np.bool_]

    @classmethod
    def through(cls, x: Array, y: Array, value: Array, known: Array) -> _Plane:
        """Through the values at places (x, y) [pixels] of squares that are known, 1, in place of 0."""
        number = np.maximum(_around(known), 1)
        middle = [_around(known * of) / number for of in (x, y, value)]

        def common(one: int, other: int) -> Array:
            of = (x, y, value)
            return np.asarray(_around(known * of[one] * of[other]) / number - middle[one] * middle[other])

        xx, xy, yy, xv, yv = (common(*pair) for pair in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
        det = xx * yy - xy**2
        flat = det <= COLLINEAR * (xx + yy) ** 2
        det = np.where(flat, 1, det)
        slopes = (np.where(flat, 0, s / det) for s in (yy * xv - xy * yv, xx * yv - xy * xv))
        return cls(middle[2], middle[0], middle[1], (*slopes,), flat)  # type: ignore[arg-type]  # two

    def level(self) -> _Plane:
        """The same without slopes."""
        return replace(self, slopes=(np.zeros_like(self.mean),) * 2)

    def at(self, x: Array, y: Array, number: Index | None = None) -> Array:
        """Value at places (x, y) of the plane of each square, or of those of this `number`."""
        mean, left, top, right, down = (
            of if number is None else of.ravel()[number] for of in (self.mean, self.x, self.y, *self.slopes)
        )
        return np.asarray(mean + right * (x - left) + down * (y - top))

    def ends(self, x: Array, y: Array, value: Array, known: Array) -> tuple[Array, Array]:
        """Least and largest difference (h, w) of the values around from the plane; inf and -inf if none is known."""
        low, high = (np.full(value.shape, end) for end in (np.inf, -np.inf))
        around = [sliding_window_view(np.pad(of, 1), value.shape) for of in (x, y, value, known)]
        for i, j in np.ndindex(3, 3):
            its_x, its_y, its, there = (of[i, j] for of in around)
            off = its - self.at(its_x, its_y)
            low = np.where(there > 0, np.minimum(low, off), low)
            high = np.where(there > 0, np.maximum(high, off), high)
        return low, high


def _around(image: Array) -> Array:
    """Sum over each square and those around."""
    return np.asarray(9 * uniform_filter(image, 3, mode="constant"))
