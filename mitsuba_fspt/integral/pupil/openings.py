"""Light through narrow openings of bodies without light, such as pinholes, which all nodes may miss (Eq. M.5).

Lines of sight just beside the borders of such bodies tell what passes them: where the radiance on both sides of a
border differs and no pixel near it has half of the difference, what is open is narrower than the nodes are apart.
Borders are the outlines of meshes and the ends of other shapes; outlines of round shapes are not among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window
from ...emission.elements import elements_of
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import corners_of_faces
from ..lines.eq9 import View
from ..lines.specular import only_hides

# Pixels between a border and the lines of sight beside it, at least `ROUNDED` times what float32 displaces these by;
# narrower openings are not detected. Shortest border [pixels].
BESIDE, ROUNDED, SHORTEST = 2e-3, 4.0, 1e-6
APART = 0.25  # distance of points along a border [pixels, or blur radii where these are larger]
MOST_POINTS = 1 << 12  # on one border
ENDS = 256  # borders along each end of a shape that is no mesh
PUPIL = ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))  # lines of sight of each point, unit disc

Array = NDArray[np.float64]
Openings = tuple[tuple[int, Array], ...]


def openings(view: View, window: Window) -> Openings:
    """Reaches of borders of bodies without light, and for each the largest change of the radiance on film across such
    borders on each pixel of a window (h, w) [W/mm²/sr].

    The reach is the blur radius, or a pixel [pixels]. Borders outside that reach into the window count on the nearest
    pixel.
    """
    camera = view.camera
    ends = _borders(view.scene.shapes(), camera)
    if not len(ends) or not math.prod(window.shape):
        return ()
    centre, blur = camera.film_discs(ends)
    known = np.isfinite(centre).all(axis=(1, 2)) & np.isfinite(blur).all(axis=(1, 2))
    near = _near(centre, blur[..., 0].max(axis=1), window) & known
    ends, centre, blur = ends[near], centre[near], blur[near, :, 0].max(axis=1)
    if not len(ends):
        return ()
    length = np.linalg.norm(centre[:, 1] - centre[:, 0], axis=1)
    counts = np.ceil(length / (APART * np.maximum(blur, 1))).clip(1, MOST_POINTS).astype(np.int64)
    border = np.repeat(np.arange(len(ends)), counts)
    share = (np.arange(len(border)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[border]
    change = _change(view, ends[border], share)
    level = np.round(np.log2(np.maximum(blur, 1))).astype(np.int64)[border]
    place = centre[border, 0] + share[:, None] * (centre[border, 1] - centre[border, 0]) - window.corner
    size, found = np.array(window.shape[::-1]), []
    for k in np.unique(level[change > 0]):
        here = (level == k) & (change > 0)
        reach = max(math.ceil(float(blur[border[here]].max())), 1)
        here &= ((place >= -reach) & (place < size + reach)).all(axis=1)
        x, y = np.clip(place[here], 0, size - 1).astype(np.int64).T
        image = np.zeros(window.shape)
        np.maximum.at(image, (y, x), change[here])
        found.append((reach, image))
    return tuple(found)


def _near(centre: Array, blur: Array, window: Window) -> NDArray[np.bool_]:
    """True for borders whose light may reach a window."""
    low, high = centre.min(axis=1) - window.corner, centre.max(axis=1) - window.corner
    reach = blur[:, None] + 1
    size = np.array(window.shape[::-1])
    return np.asarray(((high > -reach) & (low < size + reach)).all(axis=1))


def _change(view: View, ends: Array, share: Array) -> Array:
    """Largest change of the radiance on film across each border at a share of its length [W/mm²/sr]."""
    camera = view.camera
    points = [mi.Point3f(*(from_numpy(mi.Float, column) for column in at.T)) for at in ends.swapaxes(0, 1)]
    along, beside = from_numpy(mi.Float, share), dr.opaque(mi.Float, max(BESIDE, ROUNDED * float(camera.rounding)))
    most = dr.zeros(mi.Float, len(share))
    for node in PUPIL:
        pupil = mi.Point2f(*(dr.opaque(mi.Float, x) for x in node))
        first, last = (camera.arrival(point, pupil)[0] for point in points)
        middle = camera.arrival(dr.lerp(points[0], points[1], along), pupil)[0]
        way = last - first
        aside = mi.Point2f(-way.y, way.x) * (beside / dr.maximum(dr.norm(way), SHORTEST))
        left, right = (view.integrand(middle + side * aside, pupil).integrand for side in (1, -1))
        most = dr.maximum(most, dr.abs(left - right))
        dr.eval(most)
    return np.nan_to_num(most.numpy().astype(np.float64))


def _borders(shapes: Sequence[mi.Shape], camera: Camera) -> Array:
    """Ends (n, 2, 3) [mm] of the borders of all bodies that send no light."""
    found = [_outlines(shape, camera) if shape.is_mesh() else _ends(shape) for shape in shapes if only_hides(shape)]
    return np.concatenate(found) if found else np.zeros((0, 2, 3))


def _outlines(mesh: mi.Shape, camera: Camera) -> Array:
    """Edges of a mesh between a face that a point of the pupil sees and none, or one that it does not see."""
    corners = corners_of_faces(mesh)
    if not len(corners):
        return np.zeros((0, 2, 3))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    high = np.einsum("fi,fi->f", normal, np.array(camera.centre) - corners[:, 0])
    reach = camera.pupil_reach * np.linalg.norm(normal, axis=1)
    index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edge = np.sort(np.concatenate([index[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    both = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
    number, first, group = _unique(edge)
    front, back = (np.bincount(group, np.tile(side, 3), minlength=number) for side in (high > -reach, high < reach))
    faces = np.bincount(group, minlength=number)
    seen = (faces != 2) | ((front > 0) & (back > 0))
    return np.asarray(both[first[seen]])


def _unique(edge: NDArray[np.int64]) -> tuple[int, NDArray[np.int64], NDArray[np.int64]]:
    """Number of different edges, the first of each, and the number of each one's."""
    key = edge[:, 0] * (edge.max() + 1) + edge[:, 1]
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    return len(first), first, group


def _ends(shape: mi.Shape) -> Array:
    """Borders of a shape that is no mesh: polygons along the ends of its parameters."""
    elements = elements_of(shape, ENDS**2)
    side = elements.count // math.isqrt(elements.count)
    k = np.arange(side)
    found = []
    for cells, start, stop in (
        (k, (0, 0), (1, 0)),
        (k + side * (side - 1), (0, 1), (1, 1)),
        (side * k, (0, 0), (0, 1)),
        (side * k + side - 1, (1, 0), (1, 1)),
    ):
        index = from_numpy(mi.UInt32, cells.astype(np.uint32))
        places = [elements.place(index, mi.Point2f(*at))[0].p for at in (start, stop)]
        found.append(np.stack([np.array(place, np.float64).T for place in places], axis=1))
    return np.concatenate(found)
