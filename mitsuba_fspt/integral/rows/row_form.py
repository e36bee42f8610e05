"""Rows of the transport matrix: Eq. 9 in its pupil form for single pixels, by lines of sight through pixel and pupil.

For the few pixels on which the surface form misplaces light: those that an image-plane stop cuts, and those where an
occluder in focus crosses a face. Each line of sight counts for the vertices of the face that it meets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...emission.elements import Elements, elements_of
from ...emission.emitting_surface import EmittingSurface
from ...jit.batches import batches
from ...jit.from_numpy import from_numpy
from ...jit.mesh_buffers import box_of
from ...runtime.errors import SceneError
from ..lines.courses import follow
from ..lines.eq9 import eq9, etendue_from_pixel
from ..lines.specular import Specular
from ..surface.pupil_cells import STEPS, STRIDE

MOST_HITS = 4  # surfaces that a line meets on average at the most, directly and by way of specular surfaces
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Row:
    """Lines of sight that meet one mesh: the `place` of the pixel in the list that was given, the number of the line,
    the face, the weights of its three corners, and the light over that of a pixel whose pupil is filled."""

    place: Index
    line: Index
    face: Index
    corners: NDArray[np.float64]
    light: NDArray[np.float64]


def rows_of(
    scene: mi.Scene,
    camera: Camera,
    surfaces: Sequence[EmittingSurface],
    pixels: Index,
    lines: int,
    specular: Specular | None = None,
) -> list[Row]:
    """Faces that `lines` lines of sight of each of these pixels of the crop window meet, for each emitting mesh.

    The light is that of J_n = 1 W/mm²; its sum over the lines of a pixel, over their number, is the row's sum. Lines go
    on through and off `specular` shapes; those that meet several surfaces have a row for each.
    """
    elements = [elements_of(surface.shape, minimum=1) for surface in surfaces]
    found: list[list[tuple]] = [[] for _ in surfaces]
    width, offset = camera.film.crop_size[0], camera.film.crop_offset
    numbers = from_numpy(mi.UInt32, pixels)
    start = dr.opaque(mi.Float, camera.clear_depth(box_of(scene.shapes())))
    for part in batches(dr.arange(mi.UInt32, len(pixels)), lines):
        place, line = dr.repeat(part, lines), dr.tile(dr.arange(mi.UInt32, lines), dr.width(part))
        pixel = dr.gather(mi.UInt32, numbers, place)
        x = [mi.Float((line * step + pixel * STRIDE * (2 * k + 1)) >> 8) * 2.0**-24 for k, step in enumerate(STEPS)]
        position = mi.Point2f(mi.Float(pixel % width) + x[0], mi.Float(pixel // width) + x[1]) + mi.Vector2f(*offset)
        pupil, open_share = camera.open_pupil(
            position, mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[2], x[3]))
        )
        ray, cos_theta, passes = camera.line_of_sight(position, pupil, start)
        etendue = etendue_from_pixel(cos_theta, passes, open_share * camera.film_map.area_share(position))
        most = MOST_HITS if specular and len(specular.lobes) > 1 else 1
        hits = _Hits(surfaces, elements, dr.width(place), most)
        if specular:
            follow(scene, specular, ray, cos_theta, start, passes, _nothing, _never, hits.note)
        else:
            pi = scene.ray_intersect_preliminary(ray, active=passes)
            hits.note(pi, ray, mi.Float(1), pi.is_valid())
        for k, (entry, face, weights, radiance) in enumerate(hits.stored()):
            own = (dr.gather(mi.UInt32, column, entry) for column in (place, line))
            light = eq9(radiance, dr.gather(mi.Float, etendue, entry))
            found[k].append(tuple(column.numpy() for column in (*own, face, *weights, light)))
    rows = []
    for some in found:
        place, line, face, a, b, c, light = (np.concatenate(column) for column in zip(*some, strict=True))
        corners = np.clip(np.stack([a, b, c], -1).astype(np.float64), 0, 1)
        corners /= corners.sum(axis=1, keepdims=True)
        rows.append(Row(place.astype(np.int64), line.astype(np.int64), face.astype(np.int64), corners, light))
    return rows


class _Hits:
    """Hits of a number of lines of sight on emitting meshes; one line may meet several."""

    def __init__(
        self, surfaces: Sequence[EmittingSurface], elements: Sequence[Elements], count: int, most: int
    ) -> None:
        self._meshes = list(zip(surfaces, elements, strict=True))
        self._entry, self._most = dr.arange(mi.UInt32, count), most * count
        self._counts = [dr.zeros(mi.UInt32) for _ in surfaces]
        kinds = {"entry": mi.UInt32, "face": mi.UInt32} | dict.fromkeys(("a", "b", "c", "radiance"), mi.Float)
        self._stored = [{name: dr.zeros(kind, self._most) for name, kind in kinds.items()} for _ in surfaces]

    def note(self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, weight: mi.Float, met: mi.Bool) -> None:
        """Store the intersections that lie on the outward side of an emitting mesh."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active=met)
        outward, index = met & (dr.dot(si.n, ray.d) < 0), mi.UInt32(si.prim_index)
        for (surface, own), count, stored in zip(self._meshes, self._counts, self._stored, strict=True):
            mine = outward & (si.shape == mi.ShapePtr(surface.shape))
            si.prim_index = dr.select(mine, index, 0)  # another mesh may have more faces than this one
            radiance = weight * surface.law.profile(si, -ray.d, mine)
            face, (a, b, c) = own.weigh(si)
            kept = mine & (radiance > 0)
            slot = dr.scatter_inc(count, mi.UInt32(0), kept)
            hits = {"entry": self._entry, "face": face, "a": a, "b": b, "c": c, "radiance": radiance}
            for name, array in stored.items():
                dr.scatter(array, hits[name], slot, kept & (slot < self._most))

    def stored(self) -> Iterator[tuple[mi.UInt32, mi.UInt32, list[mi.Float], mi.Float]]:
        """For each mesh the line, face, weights of its corners and radiance of every hit, in a reproducible order.

        Threads store them in any order. Raises SceneError where lines meet more surfaces than there is room for.
        """
        dr.eval(self._stored, self._counts)
        for count, stored in zip(self._counts, self._stored, strict=True):
            number = int(count[0])
            if number > self._most:
                raise SceneError(
                    f"transport: {dr.width(self._entry)} lines of sight meet glowing surfaces {number} times by way of "
                    f"specular shapes, at most {MOST_HITS} each are kept. Give a larger rtol."
                )
            keys = [stored[name].numpy()[:number] for name in ("radiance", "face", "entry")]
            order = from_numpy(mi.UInt32, np.lexsort(keys))
            hits = {name: dr.gather(type(array), array, order) for name, array in stored.items()}
            yield hits["entry"], hits["face"], [hits[corner] for corner in "abc"], hits["radiance"]


def _nothing(pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.Float:
    return mi.Float(0)


def _never(number: mi.UInt32) -> mi.Bool:
    return mi.Bool(False)
