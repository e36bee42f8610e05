"""Eq. 9 as the paper sums it: over surface points, at the middle of every pixel.

A point r adds L cosθ_s dS · A_vd cosθ_d/|r_vd − r|² to each pixel whose middle r_vd lies in the blur disc of r, so that
the line through r and r_vd passes the diaphragm (β = 1), if nothing hides r along this line (α = 1). The blur disc
vanishes on the virtual detector plane: the power of a point whose blur disc contains no pixel's middle is lost. This
module serves to measure that error.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera.camera import Camera
from ..emission.elements import Elements, elements_of
from ..integral.lines.eq9 import eq9
from ..integral.lines.occlusion import hidden
from ..integral.lines.scene_checks import check_scene
from ..jit.batches import batch_slices, numbered
from ..jit.from_numpy import from_numpy
from ..jit.recording import recording
from ..jit.spectra import scalar

Plane = NDArray[np.float64]
Index = NDArray[np.int64]


def points_of(scene: mi.Scene, minimum: int) -> int:
    """Number of points that `solve` sums over: faces, each divided into k² equal parts, or cells of (u, v)."""
    return sum(elements_of(emitter.get_shape(), minimum).count for emitter in scene.emitters())


def solve(scene: mi.Scene, camera: Camera, minimum: int = 1) -> tuple[Plane, int]:
    """Power on the pixels of the crop window, shape (h, w) [W], and the number of pairs of a point and a pixel.

    Every glowing shape has at least `minimum` points; with 1 those of a mesh are the centres of its faces. Raises
    SceneError or ExitanceError as in `check_scene`.
    """
    check_scene(scene, camera)
    width, height = camera.film.crop_size
    power, pairs = dr.zeros(mi.Float64, width * height), 0
    with recording(), dr.suspend_grad():
        for emitter in scene.emitters():
            elements = elements_of(emitter.get_shape(), minimum)
            for index, pixel in _pairs(elements, camera):
                pairs += len(index)
                _add(power, scene, camera, emitter, elements, index, pixel)
                dr.eval(power)
    shares = 1.0 if camera.shares is None else camera.shares
    return camera.filters.transmittance * shares * power.numpy().reshape(height, width), pairs


def _pairs(elements: Elements, camera: Camera) -> Iterator[tuple[Index, Index]]:
    """Pairs of an element and the number of a pixel near its blur disc, about `BATCH` pairs at a time."""
    si, _ = elements.place(dr.arange(mi.UInt32, elements.count), mi.Point2f(*elements.middle))
    centre, radius = camera.film_discs(si.p.numpy().T.astype(np.float64))
    size, offset = np.array(camera.film.crop_size), np.array(camera.film.crop_offset)
    # Integers k with |k + ½ - centre| <= radius, plus the rounding error of float32.
    reach = np.where(np.isfinite(radius), radius * (1 + 1e-4) + 1e-3, np.inf)
    first = np.clip(np.ceil(centre - reach - 0.5 - offset), 0, size).astype(np.int64)
    last = np.clip(np.floor(centre + reach - 0.5 - offset), -1, size - 1).astype(np.int64)
    columns, rows = np.maximum(last - first + 1, 0).T
    count = columns * rows
    for run in batch_slices(count):
        index, number = numbered(count[run])
        index += run.start
        row, column = number // columns[index] + first[index, 1], number % columns[index] + first[index, 0]
        if len(index):
            yield index, row * size[0] + column


def _add(
    power: mi.Float64,
    scene: mi.Scene,
    camera: Camera,
    emitter: mi.Emitter,
    elements: Elements,
    index: Index,
    pixel: Index,
) -> None:
    """Add the contributions of the pairs to their pixels, one array entry per pair, in one kernel."""
    number = from_numpy(mi.UInt32, pixel)
    width = dr.opaque(mi.UInt32, camera.film.crop_size[0])
    corner = mi.Point2f(*(dr.opaque(mi.Float, n + 0.5) for n in camera.film.crop_offset))
    position = corner + mi.Vector2f(mi.Float(number % width), mi.Float(number // width))

    si, area = elements.place(from_numpy(mi.UInt32, index), mi.Point2f(*elements.middle))
    centre, radius, _ = camera.blur_disc(si.p)
    pupil = mi.Point2f((camera.film_map.to_ideal(position) - centre) / radius)
    _, lens_point, passes, cos_d = camera.arrival(si.p, pupil)
    to_lens = lens_point - si.p
    distance = dr.norm(to_lens)
    to_lens /= distance
    cos_s = dr.dot(si.n, to_lens)
    lit = (dr.squared_norm(pupil) <= 1) & (passes > 0) & (cos_s > 0)
    lit &= ~hidden(scene, si.p, si.n, lens_point, lit)
    si.initialize_sh_frame()
    si.wi = si.to_local(to_lens)
    radiance = dr.select(lit, scalar(emitter.eval(si, lit)), 0)
    # |r_vd - r| = |u - z|/cosθ_d. A_vd is multiplied last, so that no intermediate value exceeds float32.
    defocus = dr.opaque(mi.Float, camera.lens.focus_distance) - distance * cos_d
    area_share = camera.film_map.area_share(position)
    solid_angle = area_share * cos_d * dr.square(cos_d * dr.opaque(mi.Float, camera.virtual_pitch) / defocus)
    added = eq9(mi.Float64(radiance), mi.Float64(cos_s) * mi.Float64(area) * mi.Float64(solid_angle))
    dr.scatter_add(power, dr.select(lit, added, 0), number, lit)
