"""Light through narrow openings of bodies without light, such as pinholes, which all nodes may miss (Eq. M.5).

Lines of sight just beside the borders of such bodies tell what passes them: where the radiance on both sides of a
border differs and no pixel near it has half of the difference, what is open is narrower than the nodes are apart.
Borders are the outlines of meshes and the ends of other shapes; outlines of round shapes are not among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window
from ...emission.elements import elements_of
from ...jit.batches import batch_slices
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import triangles
from ..lines.eq9 import View
from ..lines.specular import only_hides
from .shade import placeable

# Pixels between a border and the lines of sight beside it, at least `ROUNDED` times what float32 displaces these by;
# narrower openings are not detected. Shortest border [pixels].
BESIDE, ROUNDED, SHORTEST = 2e-3, 4.0, 1e-6
APART = 0.25  # distance of points along a border [pixels, or blur radii where these are larger]
MOST_POINTS = 1 << 12  # on one border
MIXERS = tuple(np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9))  # odd, of a hash
ENDS = 256  # borders along each end of a shape that is no mesh
MISPLACED, STEPS = 0.5, 32  # pixels by which a border may be off its place in another pose, and lines on that way

Array = NDArray[np.float64]
Openings = tuple[tuple[int, Array], ...]


@dataclass(frozen=True)
class _Lines:
    """Lines of sight near each point of a border: points of the `pupil`, unit disc; how far `aside` [pixels]."""

    pupil: tuple[tuple[float, float], ...]
    aside: tuple[float, ...]


_STRAIGHT = _Lines(((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7)), (-BESIDE, BESIDE))
_POSED = _Lines(((0.0, 0.0),), tuple(MISPLACED * (2 * k / STEPS - 1) for k in range(STEPS + 1)))


def openings(view: View, window: Window, pose: Camera | None = None) -> Openings:
    """Reaches of borders of bodies without light, and for each the largest change of the radiance on film across such
    borders on each pixel of a window (h, w) [W/mm²/sr].

    The reach is the blur radius, or a pixel [pixels]. Borders outside that reach into the window count on the nearest
    pixel. `pose`: as of `shade.narrow_bodies`; it may be half a pixel off.
    """
    camera = pose or view.camera
    ends = _borders(view.scene.shapes(), camera, window)
    if not len(ends):
        return ()
    centre, blur = camera.film_discs(ends)
    known = np.isfinite(centre).all(axis=(1, 2)) & np.isfinite(blur).all(axis=(1, 2))
    near = _near(centre, blur, window) & known
    ends, centre, blur = ends[near], centre[near], blur[near, :, 0].max(axis=1, initial=0.0)
    if not len(ends):
        return ()
    length = np.linalg.norm(centre[:, 1] - centre[:, 0], axis=1)
    counts = np.ceil(length / (APART * np.maximum(blur, 1))).clip(1, MOST_POINTS).astype(np.int64)
    border = np.repeat(np.arange(len(ends)), counts)
    share = (np.arange(len(border)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[border]
    change = _change(view, camera, ends[border], share, _POSED if pose else _STRAIGHT)
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
    """True for edges, or faces, whose light may reach a window; blur discs (n, k, 2) and (n, k, 1) of their k ends."""
    low, high, reach = centre.min(axis=1), centre.max(axis=1), blur.max(axis=1) + 1
    size, corner = np.array(window.shape[::-1]), np.array(window.corner)
    outside = (high < corner - reach) | (low > corner + size + reach)  # of discs that are not known none is
    return np.asarray(~outside.any(axis=1))


def _change(view: View, camera: Camera, ends: Array, share: Array, lines: _Lines) -> Array:
    """Largest change of the radiance on film across each border, as a `camera` sees it straight on, at a share of its
    length [W/mm²/sr]."""
    nodes, steps = len(lines.pupil), len(lines.aside)
    least = ROUNDED * float(camera.rounding)
    u, v = (from_numpy(mi.Float, np.repeat(of, steps)) for of in np.transpose(lines.pupil))
    aside = [math.copysign(max(abs(step), least), step) for step in lines.aside]
    across = from_numpy(mi.Float, np.tile(np.array(aside), nodes))
    several, change = dr.opaque(mi.UInt32, nodes * steps), np.zeros(len(share))
    for some in batch_slices(np.full(len(share), nodes * steps)):
        points = [mi.Point3f(*(from_numpy(mi.Float, of) for of in at.T)) for at in ends[some].swapaxes(0, 1)]
        along = from_numpy(mi.Float, share[some])
        lane = dr.arange(mi.UInt32, len(share[some]) * nodes * steps)
        point, line = lane // several, lane % several
        start, end = (dr.gather(mi.Point3f, at, point) for at in points)
        pupil = mi.Point2f(dr.gather(mi.Float, u, line), dr.gather(mi.Float, v, line))
        first, last = (camera.arrival(at, pupil)[0] for at in (start, end))
        middle = camera.arrival(dr.lerp(start, end, dr.gather(mi.Float, along, point)), pupil)[0]
        way = last - first
        normal = mi.Point2f(-way.y, way.x) / dr.maximum(dr.norm(way), SHORTEST)
        light = view.integrand(middle + dr.gather(mi.Float, across, line) * normal, pupil).integrand.numpy()
        change[some] = np.ptp(np.nan_to_num(light.astype(np.float64)).reshape(-1, nodes, steps), axis=2).max(axis=1)
    return change


def _borders(shapes: Sequence[mi.Shape], camera: Camera, window: Window) -> Array:
    """Ends (n, 2, 3) [mm] of the borders of all bodies that do not glow."""
    dark = [shape for shape in shapes if only_hides(shape) and placeable(shape)]
    found = [_outlines(shape, camera, window) if shape.is_mesh() else _ends(shape) for shape in dark]
    return np.concatenate([np.zeros((0, 2, 3)), *found])


def _outlines(mesh: mi.Shape, camera: Camera, window: Window) -> Array:
    """Edges of a mesh near a window that may be its outline: of a single face, or of one that some point of the pupil
    sees from outside and one that some point does not.
    """
    positions, faces = (buffer.numpy().reshape(-1, 3) for buffer in triangles(mesh))
    vertices = positions.astype(np.float64)
    centre, blur = camera.film_discs(vertices)
    faces = faces[_near(centre[faces], blur[faces], window)].astype(np.int64)
    if not len(faces):
        return np.zeros((0, 2, 3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    height = np.einsum("fi,fi->f", normal, np.array(camera.centre) - a)  # of the lens over the face, times its normal
    pupil = camera.pupil_reach * np.linalg.norm(normal, axis=1)
    number = _merged(positions)[faces]
    edge = np.sort(np.concatenate([number[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    key = edge[:, 0] * (number.max() + 1) + edge[:, 1]
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    front, back = (np.bincount(group, np.tile(side, 3)) for side in (height > -pupil, height < pupil))
    some = first[(count != 2) | ((front > 0) & (back > 0))]
    ends = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])[some]
    return np.asarray(vertices[ends])


def _merged(positions: NDArray[np.float32]) -> NDArray[np.int64]:
    """Numbers (V,) of vertices, the same for those at the same place."""
    bits = (positions + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    mixed = bits[:, 0] * MIXERS[0] + bits[:, 1] * MIXERS[1] + bits[:, 2] * MIXERS[2]  # modulo 2⁶⁴
    return np.unique(mixed, return_inverse=True)[1].astype(np.int64)


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
