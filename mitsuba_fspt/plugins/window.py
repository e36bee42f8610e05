"""The effective virtual space (Eq. 4) on the film: the pixels whose lines of sight can meet the phantom at all."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Window:
    """Rectangle of the crop window: `top`, `left` of its first pixel and `shape` (h, w), inside `full` (h, w)."""

    top: int
    left: int
    shape: tuple[int, int]
    full: tuple[int, int]
    crop_offset: tuple[int, int]

    def centres(self, index: NDArray[np.uint32]) -> mi.Point2f:
        """Film positions [pixels] of the centres of the window's pixels with flat number `index`."""
        number = mi.UInt32(index)
        width = dr.opaque(mi.UInt32, self.shape[1])
        left = dr.opaque(mi.Float, self.left + self.crop_offset[0] + 0.5)
        top = dr.opaque(mi.Float, self.top + self.crop_offset[1] + 0.5)
        return mi.Point2f(left + mi.Float(number % width), top + mi.Float(number // width))

    def expand(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """`image` of the window within the crop window, 0 around it."""
        whole = np.zeros(self.full)
        whole[self.top : self.top + self.shape[0], self.left : self.left + self.shape[1]] = image
        return whole


def visible_window(scene: mi.Scene, lens: mi.Sensor) -> Window:
    """Window of the pixels with a line of sight into the bounding box of what glows; all if it surrounds the lens.

    Light of other emitters than `fspt_surface` can come from any surface of the scene. Perspective keeps straight
    lines straight, so that the box's corners bound its blurred image.
    """
    film = lens.film()
    width, height = (int(n) for n in film.crop_size())
    offset = (int(film.crop_offset()[0]), int(film.crop_offset()[1]))
    emitters = scene.emitters()
    direct = all(type(emitter).__name__ == "FsptSurface" for emitter in emitters)
    corners = [
        np.array([bbox.min, bbox.max])[list(pick), range(3)]
        for bbox in ([emitter.bbox() for emitter in emitters] if direct else [scene.bbox()])
        for pick in itertools.product((0, 1), repeat=3)
    ]
    low, high = lens.film_bounds(np.array(corners).reshape(-1, 3))
    # One pixel more than needed on each side keeps second differences and rounding inside.
    left, top = (int(np.clip(np.floor(low[k]) - offset[k] - 1, 0, (width, height)[k])) for k in (0, 1))
    right, bottom = (int(np.clip(np.ceil(high[k]) - offset[k] + 1, 0, (width, height)[k])) for k in (0, 1))
    shape = (max(0, bottom - top), max(0, right - left))
    return Window(top, left, shape, (height, width), offset)
