"""Shade of narrow bodies, such as wires and dust, darker than what is behind, which all nodes may miss.

As for light (`narrow`), points all over the bodies tell which pixels they may shade: a point blocks the share of the
lines of sight of a pixel (Eq. M.5) that its surroundings cover of the pixel, or of the blur disc where that is larger.
Parts of bodies that cover a third of a ring around them are not narrow, but edges, which transects integrate.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window, corners_of
from ...emission.elements import elements_of
from ...emission.emitting_surface import EmittingSurface
from ...emission.of_emitter import surfaces_of
from ...jit.batches import batch_slices
from ...jit.from_numpy import from_numpy
from ...jit.spectra import scalar
from ..lines.eq9 import View
from ..lines.specular import only_hides
from .narrow import FEWEST_ELEMENTS, Points, most_on_pixels, points_of

# Shapes that are no meshes on which points can be placed by their parameters.
PLACEABLE = ("Sphere", "Cylinder", "Disk", "BSplineCurve")
# Lines of sight on a ring around a point, its radius [pixels, blur radii where these are larger], and the share of them
# that end on the body: a quarter on a wire, a third or more on the outline of a body as wide as the ring.
RING, RING_RADIUS, RING_COVERED = 8, 0.3, 0.3
WIDE_BALL = 4.0  # least width of the box of a ball without narrow parts [pixels, and blur radii]
CELL = 0.25  # side of the cells of whose points one is examined for all, likewise
ROUNDING = 1e-3  # of a radiance

Column = NDArray[np.float64]
Mask = NDArray[np.bool_]
PixelArray = NDArray[np.float64]


def narrow_bodies(view: View, window: Window, pose: Camera | None = None) -> Points | None:
    """Points all over the narrow parts of bodies that do not glow, of radiance 0, and of those that glow, but less than
    another one. None without any.

    window : points far from it are left out
    pose : of the camera, from which it sees them straight on by specular surfaces; None: the view's, and points that
        other bodies hide from the middle of the pupil are left out
    """
    found, surfaces, camera = [], surfaces_of(view.scene), pose or view.camera
    shapes = [shape for shape in view.scene.shapes() if only_hides(shape) and _may_be_narrow(shape, camera)]
    if dark := [_points(shape, camera) for shape in shapes]:
        found.append(_narrow(view, window, Points.joined(dark), 0.0, pose is None))
    most = max((surface.brightest for surface in surfaces), default=0.0)
    for surface in surfaces:
        if 0 < surface.brightest < most and _may_be_narrow(surface.shape, camera):
            dim = _points(surface.shape, camera, surface)
            brightest = (1 + ROUNDING) * float(dim.radiance.max(initial=0.0))
            found.append(_narrow(view, window, dim, brightest, pose is None))
    points = Points.joined(found) if found else None
    return points if points is not None and len(points.x) else None


def placeable(shape: mi.Shape) -> bool:
    """True for a shape on which points can be placed."""
    return shape.is_mesh() or shape.class_name() in PLACEABLE


def _may_be_narrow(shape: mi.Shape, camera: Camera) -> bool:
    """False for a shape on which no points can be placed, and for a sphere whose image measures several pixels, and
    blur radii."""
    if not placeable(shape) or shape.class_name() != "Sphere":
        return placeable(shape)
    box = shape.bbox()
    centre, blur = camera.film_discs(corners_of([(*box.min, *box.max)]))
    return not np.ptp(centre, axis=0).min() > WIDE_BALL * max(float(blur.max()), 1.0)


def _points(shape: mi.Shape, camera: Camera, surface: EmittingSurface | None = None) -> Points:
    """Points all over both sides of a shape, with the radiance of its `surface` if it glows."""

    def radiance(si: mi.SurfaceInteraction3f, to_lens: mi.Vector3f) -> mi.Float:
        return scalar(surface.radiance(si, to_lens, mi.Bool(True))) if surface else dr.zeros(mi.Float, dr.width(si.p))

    points = points_of(elements_of(shape, 1 if shape.is_mesh() else FEWEST_ELEMENTS), camera, radiance)
    towards = points.front * np.sign(points.cosine) > 0  # the middle of the pupil lies on the side of the whole pupil
    return replace(points, cosine=np.abs(points.cosine))[towards & (points.apart < 1) & (points.area > 0)]


def _narrow(view: View, window: Window, points: Points, radiance: float, straight: bool) -> Points:
    """The points around which most of a ring is free of bodies as dark.

    radiance : largest one of these bodies [W/mm²/sr]
    straight : leave out points that other bodies hide
    """
    unit, (left, top) = np.maximum(points.blur, 1), window.corner
    near = replace(points, x=points.x - left, y=points.y - top).near(2 * unit, window.shape)
    points, unit = points[near], unit[near]
    if not len(points.x):
        return points
    cells = np.stack([np.floor(of / (CELL * 2 ** points.level())) for of in (points.x, points.y)] + [points.level()])
    _, first, number = np.unique(cells, axis=1, return_index=True, return_inverse=True)
    x, y, radius = (of[first] for of in (points.x, points.y, RING_RADIUS * unit))
    angle = 2 * math.pi * np.arange(RING)[:, None] / RING
    ring = (np.concatenate([of[None], of + radius * turn(angle)]) for of, turn in ((x, np.cos), (y, np.sin)))
    dark = _end_on_dark(view, *ring, radiance)
    narrow = dark[1:].sum(axis=0) < RING_COVERED * RING
    if straight:
        narrow &= dark[0]
    return points[narrow[number.ravel()]]


def _end_on_dark(view: View, x: Column, y: Column, radiance: float) -> Mask:
    """True where lines of sight from places (lines, cells) on the film [pixels] through the middle of the pupil end on
    a body of no more than this radiance [W/mm²/sr]."""
    most, dark = dr.opaque(mi.Float, radiance), np.zeros(x.shape, bool)
    for some in batch_slices(np.full(x.shape[1], len(x))):
        place = mi.Point2f(*(from_numpy(mi.Float, of[:, some]) for of in (x, y)))
        sight = view.integrand(place, mi.Point2f(0))
        dark[:, some] = (dr.isfinite(sight.depth) & (sight.radiance <= most)).numpy().reshape(len(x), -1)
    return dark


def shade(points: Points | None, window: Window) -> tuple[PixelArray, PixelArray]:
    """Largest share (h, w) of the lines of sight of each pixel that narrow bodies block, and the light of these bodies
    there [W/mm²/sr], to a factor of two."""
    if points is None or not math.prod(window.shape):
        return np.zeros(window.shape), np.zeros(window.shape)
    points = points.seen_in(window)
    share, own = (most_on_pixels(points, of, window.shape) for of in (np.ones_like(points.x), points.radiance))
    return share.clip(max=1), own
