"""Rows of the transport matrix: Eq. 9 in its pupil form for single pixels, by lines of sight through pixel and pupil.

For the few pixels on which the surface form misplaces light: those that an image-plane stop cuts, and those where an
occluder in focus crosses a face. Each line of sight counts for the vertices of the face that it meets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..emission.elements import elements_of
from ..jit.batches import batches
from .eq9 import eq9, etendue_from_pixel

# Steps of a Kronecker sequence in four dimensions, 1/g … 1/g⁴ with g⁵ = g + 1, in units of 2⁻³²: whole numbers, so that
# the sequence stays exact; and the shift from pixel to pixel (golden ratio).
STEPS, STRIDE = (3679390609, 3152041523, 2700274807, 2313257605), 2654435769
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


def rows_of(scene: mi.Scene, lens: mi.Sensor, emitters: Sequence[mi.Emitter], pixels: Index, lines: int) -> list[Row]:
    """What `lines` lines of sight of each of these pixels of the crop window meet, for each emitting mesh.

    The light is that of J_n = 1 W/mm²; its sum over the lines of a pixel, over their number, is the row's sum.
    """
    elements = [elements_of(emitter.get_shape(), minimum=1) for emitter in emitters]
    found: list[list[tuple]] = [[] for _ in emitters]
    width = int(lens.film().crop_size()[0])
    offset = [int(n) for n in lens.film().crop_offset()]
    numbers = mi.UInt32(pixels.astype(np.uint32))
    for part in batches(dr.arange(mi.UInt32, len(pixels)), lines):
        place, line = dr.repeat(part, lines), dr.tile(dr.arange(mi.UInt32, lines), dr.width(part))
        pixel = dr.gather(mi.UInt32, numbers, place)
        x = [mi.Float((line * step + pixel * STRIDE * (2 * k + 1)) >> 8) * 2.0**-24 for k, step in enumerate(STEPS)]
        position = mi.Point2f(mi.Float(pixel % width) + x[0], mi.Float(pixel // width) + x[1]) + mi.Vector2f(*offset)
        pupil, open_share = lens.open_pupil(position, mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[2], x[3])))
        ray, cos_theta, passes = lens.line_of_sight(position, pupil)
        si = scene.ray_intersect(ray, active=passes)
        outward = si.is_valid() & (dr.dot(si.n, ray.d) < 0)
        etendue = etendue_from_pixel(cos_theta, passes, open_share)
        for k, (emitter, own) in enumerate(zip(emitters, elements, strict=True)):
            met = outward & (si.shape == mi.ShapePtr(emitter.get_shape()))
            light = eq9(emitter.law.profile(si, -ray.d, met), etendue)
            face, weights = own.weigh(si)
            kept = dr.compress(met & (light > 0))
            columns = (place, line, face, *weights, light)
            found[k].append(tuple(dr.gather(type(c), c, kept).numpy() for c in columns))
    rows = []
    for some in found:
        place, line, face, a, b, c, light = (np.concatenate(column) for column in zip(*some, strict=True))
        corners = np.clip(np.stack([a, b, c], -1).astype(np.float64), 0, 1)
        corners /= corners.sum(axis=1, keepdims=True)
        rows.append(Row(place.astype(np.int64), line.astype(np.int64), face.astype(np.int64), corners, light))
    return rows
