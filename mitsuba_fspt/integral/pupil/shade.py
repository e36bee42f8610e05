"""Shade of narrow bodies that send no light, such as wires and dust, which all nodes of a pixel may miss (Eq. M.5).

As for light (`narrow`), points all over the bodies tell which pixels they may shade: a point blocks the share of the
lines of sight of a pixel that its surroundings cover of the pixel, or of the blur disc where that is larger. Only parts
of bodies that leave half of every square around them free are narrow; others are edges, which transects integrate.
"""

from __future__ import annotations

import math
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from ...camera.window import Window
from ...emission.elements import elements_of
from ...jit.from_numpy import from_numpy
from ...jit.pixel_grid import Grid
from ..lines.eq9 import View
from ..lines.specular import only_hides
from .narrow import COVERED, FEWEST_ELEMENTS, Points, in_sight, points_of, spread

RING = 8  # lines of sight around a point
SHARP = 0.5  # blur radius [pixels] below which a point shades its own pixel and those beside it

Column = NDArray[np.float64]
PixelArray = NDArray[np.float64]


def narrow_bodies(view: View) -> Points | None:
    """Points all over the narrow parts of bodies that send no light and that others do not hide, of radiance 1; None
    without any."""
    scene, camera = view.scene, view.camera
    visible = partial(in_sight, scene, camera, view.specular)
    parts = [
        points_of(elements_of(shape, 1 if shape.is_mesh() else FEWEST_ELEMENTS), camera, _one, visible)
        for shape in scene.shapes()
        if only_hides(shape)
    ]
    points = _narrow(view, Points.joined(parts)) if parts else None
    return points if points is not None and len(points.x) else None


def _one(si: mi.SurfaceInteraction3f, to_lens: mi.Vector3f) -> mi.Float:
    """Radiance of points whose light is the share of a pixel that they cover."""
    return dr.full(mi.Float, 1, dr.width(si.p))


def _narrow(view: View, points: Points) -> Points:
    """The points of parts that leave half of every square around them free, and half of a ring around them; square and
    ring measure one pixel, or the blur radius where that is larger. Squares are blind to elements larger than them.
    """
    points = points[(points.area > 0) & (points.cosine > 0)]
    if not len(points.x):
        return points
    level, narrow = points.level(), (points.apart < 1) & (points.radiance > 0)
    for k in np.unique(level[narrow]):
        here = level == k
        cells = points[here].cells(2**k)
        grid = Grid(cells.shape)
        covered = cells.sums(np.minimum(points.area[here] / 4**k, 1))
        around = grid.array(grid.spread_max(grid.flat(covered))).ravel()[cells.number]
        narrow[here] &= around < COVERED
    points = points[narrow]
    return points[_dark_around(view, points) < COVERED] if len(points.x) else points


def _dark_around(view: View, points: Points) -> Column:
    """Share of lines of sight through the middle of the pupil, on a ring around each point, that end on dark bodies."""
    unit = np.maximum(points.blur, 1)
    x, y, radius = (from_numpy(mi.Float, column) for column in (points.x, points.y, unit))
    dark = dr.zeros(mi.Float, len(unit))
    for k in range(RING):
        sine, cosine = dr.sincos(dr.opaque(mi.Float, 2 * math.pi * k / RING))
        sight = view.integrand(mi.Point2f(x + radius * cosine, y + radius * sine), mi.Point2f(0))
        dark += dr.select(dr.isfinite(sight.depth) & (sight.radiance <= 0), mi.Float(1), 0)
        dr.eval(dark)
    return dark.numpy().astype(np.float64) / RING


def shade(points: Points | None, window: Window) -> PixelArray:
    """Largest share (h, w) of the lines of sight of each pixel that narrow bodies block, to a factor of two."""
    share = np.zeros(window.shape)
    if points is None or not math.prod(window.shape):
        return share
    points = points.seen_in(window)
    sharp = points.blur < SHARP
    share += maximum_filter(points[sharp].on_pixels(points[sharp].area, window.shape), 3)
    blurred = points[~sharp]
    covered, level = blurred.light(), blurred.level()
    for k in np.unique(level):
        here = level == k
        reach = max(math.ceil(blurred.blur[here].max()), 1)
        share += spread(covered[here], blurred[here], reach, window.shape)
    return share.clip(max=1)
