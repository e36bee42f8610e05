"""The effective virtual space (Eq. 4) on the film: the pixels whose lines of sight can meet an emitting surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..jit.from_numpy import from_numpy
from .camera import MOST_RIM, Camera

Box = tuple[float, ...]  # x, y, z of the lowest and of the highest corner [mm]
Boxes = tuple[Box, ...]
Ends = NDArray[np.float64]
Region = tuple[float, float, float, float]  # of the film: x, y of its lowest and of its highest corner [pixels]

SEARCHED_RIM = 0.6  # blur radii around the crop window that are searched for silhouettes, up to `MOST_RIM`
# Of a rectangle whose distorted image is bounded: points along each side, share of its size that is added, and the
# largest rectangle, in sizes of the film beyond it.
SIDE_POINTS, DISTORTED_MARGIN, FAR = 65, 1e-3, 1.0
OPEN = 1e-6  # rounding of the share of the pupil that is open


@dataclass(frozen=True)
class Window:
    """Rectangle of pixels: `top`, `left` of its first one from that of the crop window, `shape` (h, w); `full` (h, w).

    It may include a rim of pixels beyond the crop window, which are computed but not shown: a silhouette there affects
    the estimates of their neighbours inside. `blur`: the largest radius of a blur disc of emitting surfaces [pixels].
    `crop_offset`: place of the crop window on the film [pixels], for blocks of pixels no whole number.
    """

    top: int
    left: int
    shape: tuple[int, int]
    full: tuple[int, int]
    crop_offset: tuple[float, float]
    blur: float

    @property
    def corner(self) -> tuple[float, float]:
        """Film position (x, y) [pixels] of the first pixel's corner."""
        return self.left + self.crop_offset[0], self.top + self.crop_offset[1]

    @property
    def inner(self) -> tuple[slice, slice]:
        """Rows and columns of the crop window in this one; the other pixels are the rim."""
        return self._common()[0]

    @property
    def rim(self) -> int:
        """Pixels around the crop window, or around a tile of it, that are searched for silhouettes."""
        return 1 + math.ceil(min(SEARCHED_RIM * self.blur, MOST_RIM - 1))

    @property
    def count(self) -> int:
        """Pixels of the crop window in this one."""
        return math.prod(side.stop - side.start for side in self.inner)

    def tile(self, rows: range, columns: range) -> Window:
        """These rows and columns of the crop window with the rim that this window has of them, as a window of its own.

        Its crop window is the rows and columns alone.
        """
        (top, bottom), (left, right) = (
            (max(start, side.start - self.rim) - side.start, min(start + size, side.stop + self.rim) - side.start)
            for start, size, side in zip((self.top, self.left), self.shape, (rows, columns), strict=True)
        )
        offset = self.crop_offset[0] + columns.start, self.crop_offset[1] + rows.start
        return Window(top, left, (bottom - top, right - left), (len(rows), len(columns)), offset, self.blur)

    def centres(self, number: mi.UInt32) -> mi.Point2f:
        """Film positions [pixels] of the centres of the window's pixels with this `number`, row by row."""
        width = dr.opaque(mi.UInt32, self.shape[1])
        left, top = (dr.opaque(mi.Float, n + 0.5) for n in self.corner)
        return mi.Point2f(left + mi.Float(number % width), top + mi.Float(number // width))

    def field_stop(self, camera: Camera) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Pixels (h, w) that lie inside the image-plane stop, and those that its border cuts."""
        if math.isinf(camera.lens.seen_field):
            return np.ones(self.shape, bool), np.zeros(self.shape, bool)
        width, height = camera.film.size
        left, top = self.corner
        x = np.abs(left + np.arange(self.shape[1]) + 0.5 - width / 2)
        y = np.abs(top + np.arange(self.shape[0]) + 0.5 - height / 2)[:, None]
        radius = camera.lens.seen_field / camera.virtual_pitch
        inside = np.hypot(x + 0.5, y + 0.5) <= radius
        return inside, ~inside & (np.hypot(np.maximum(x - 0.5, 0), np.maximum(y - 0.5, 0)) < radius)

    def fully_open(self, camera: Camera) -> NDArray[np.bool_]:
        """Pixels (h, w) to which a second border of the lens leaves the whole pupil open."""
        if len(camera.lens.discs) == 1:
            return np.ones(self.shape, bool)
        left, top = self.corner
        y, x = np.divmod(np.arange((self.shape[0] + 1) * (self.shape[1] + 1)), self.shape[1] + 1)
        corners = mi.Point2f(from_numpy(mi.Float, x + left), from_numpy(mi.Float, y + top))
        share = camera.open_pupil(corners, mi.Point2f(0))[1].numpy().reshape(self.shape[0] + 1, -1)
        # The positions with the whole pupil are those of a disc, so that the corners of a pixel suffice.
        whole = share > 1 - OPEN
        return whole[:-1, :-1] & whole[:-1, 1:] & whole[1:, :-1] & whole[1:, 1:]

    def within(self, region: Region) -> NDArray[np.bool_]:
        """Pixels (h, w) of this window in a region of the film, those on its border included."""
        left, top, right, bottom = region
        x, y = (start + np.arange(size) for start, size in zip(self.corner, self.shape[::-1], strict=True))
        return ((y + 1 > top) & (y < bottom))[:, None] & (x + 1 > left) & (x < right)

    def expand(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """The crop window with `image` of this window in its place, 0 around it; a view if nothing is around it."""
        here, there = self._common()
        part = image[here]
        if part.shape == self.full:
            return part
        whole = np.zeros(self.full)
        whole[there] = part
        return whole

    def cut(self, image: NDArray[Any]) -> NDArray[Any]:
        """This window's part of an image of the crop window, 0 beyond it."""
        part = np.zeros(self.shape, image.dtype)
        here, there = self._common()
        part[here] = image[there]
        return part

    def shown(self) -> NDArray[np.bool_]:
        """True (h, w) at pixels of the crop window, False on the rim."""
        return self.cut(np.ones(self.full, bool))

    def brightest(self, image: NDArray[np.float64]) -> float:
        """Largest value of an image (h, w) in the crop window, or on its rim if all those are 0."""
        return float(image[self.inner].max(initial=0.0) or image.max(initial=0.0))

    def _common(self) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
        """Slices of the pixels that both windows share, in this one and in the crop window."""
        ends = [
            (max(start, 0), max(min(start + size, most), max(start, 0)))
            for start, size, most in zip((self.top, self.left), self.shape, self.full, strict=True)
        ]
        here = tuple(slice(a - start, b - start) for (a, b), start in zip(ends, (self.top, self.left), strict=True))
        return here, tuple(slice(a, b) for a, b in ends)


def corners_of(boxes: Sequence[Box]) -> Ends:
    """Corners of boxes, (8 n, 3) [mm]."""
    ends = np.array(boxes, np.float64).reshape(-1, 2, 3)
    return ends[:, (np.arange(8)[:, None] >> np.arange(3)) & 1, range(3)].reshape(-1, 3)


def window_of(boxes: Boxes, camera: Camera, everywhere: bool = False, bending: Boxes = ()) -> Window:
    """Window of the pixels with a line of sight into these boxes or those of `bending` shapes; or `everywhere`."""
    points, far = corners_of((*boxes, *bending)), 0.0
    if bending:  # an image behind a mirror is as far as its light travels in front of it
        far = camera.depths(points).max() + float(np.linalg.norm(np.ptp(points, axis=0)))
    return window_around(points, camera, everywhere, far)


def window_around(points: Ends, camera: Camera, everywhere: bool = False, far: float = 0.0) -> Window:
    """Window of the pixels with a line of sight to what lies between these points (n, 3) [mm]; or `everywhere`.

    Perspective keeps straight lines straight, so that the points bound the blurred image of what lies between them,
    before its distortion. far : depth of images farther away [mm], if there are any
    """
    (height, width), offset = camera.film.shape, camera.film.crop_offset
    discs, radii = camera.ideal_discs(points)
    blur = radii.max(initial=0.0)
    if far:
        blur = max(blur, abs(float(camera.blur_radius(mi.Float64(far))[0])))
    low, high = (discs - radii).min(axis=0, initial=np.inf), (discs + radii).max(axis=0, initial=-np.inf)
    if everywhere or not len(points):
        low, high = np.full(2, -np.inf), np.full(2, np.inf)
    low, high = _distorted_bounds(camera, low, high)
    middle, radius = np.array(camera.film_map.middle), camera.lens.seen_field / camera.virtual_pitch
    low, high = np.maximum(low, middle - radius), np.minimum(high, middle + radius)
    crop = Window(0, 0, (height, width), (height, width), offset, float(blur))
    # One pixel more than needed on each side keeps second differences and rounding inside.
    (left, right), (top, bottom) = (
        (
            int(np.clip(np.floor(low[k]) - offset[k] - 1, -crop.rim, size + crop.rim)),
            int(np.clip(np.ceil(high[k]) - offset[k] + 1, -crop.rim, size + crop.rim)),
        )
        for k, size in enumerate((width, height))
    )
    if left >= width or top >= height or right <= 0 or bottom <= 0:  # visible on the rim alone
        right, bottom = left, top
    return replace(crop, top=top, left=left, shape=(max(0, bottom - top), max(0, right - left)))


def _distorted_bounds(camera: Camera, low: Ends, high: Ends) -> tuple[Ends, Ends]:
    """Bounds (2,) on the film [pixels] of a rectangle of ideal positions: of points along its sides, and a margin."""
    if not camera.film_map.distorted or not (low < high).all():
        return low, high
    size = np.array(camera.film.size, np.float64)
    low, high = np.maximum(low, -FAR * size), np.minimum(high, (1 + FAR) * size)
    along = np.linspace(0, 1, SIDE_POINTS)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    sides = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    found = camera.film_map.from_ideal_in_double(sides)
    margin = DISTORTED_MARGIN * (high - low).max()
    return found.min(axis=0) - margin, found.max(axis=0) + margin
