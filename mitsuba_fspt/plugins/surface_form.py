"""Eq. 9 in its surface form: P = ∫ L |cosθ_s| dS dΩ over the surface and over the pupil as a surface point sees it.

The surface is cut into pieces, the pupil into M × M cells of equal area. What a piece sends through a cell is found
along one line of sight and laid on the film where the piece's image through the middle of the cell is: a polygon,
shared out exactly among the pixels. All pieces share the cells' middles, so that their images tile the film without
gap or overlap, and every piece's power lands once: none of the stiffness that makes the form sparse when pixels look
for surface points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import pixels
from ..errors import SceneError
from ..quadrature import Quadrature, Solution
from .elements import Elements, elements_of, scalar
from .footprint import Canvas
from .window import Window, visible_window

FIRST_LINES, GROWTH = 16, 4  # lines of sight a pixel of the image at the first level; times this each level
MIN_ELEMENTS, MOST_ELEMENTS, PIXELS_PER_ELEMENT = 1 << 10, 1 << 20, 4
UNBOUNDED_SIDE = 4.0  # what an element counts for that reaches through the lens plane [pixels]: its image has no size
LANES = 1 << 22  # lines of sight in flight: bounds the memory, not the picture
SAFETY = 2.0  # the last change of a pixel and of its neighbours, times this, bounds what is left
FLOAT32_FLOOR = 2e-7  # share of the brightest pixel that float32 lines of sight cannot resolve
# No pixel is brighter than the brightest piece: so much above it and so small a share of it fit in 62 bits.
HEADROOM, RESOLUTION = 2.0**5, 2.0**-57
COVERAGE_QUANTUM = 2.0**-50
# Steps of a Kronecker sequence in four dimensions, 1/g … 1/g⁴ with g⁵ = g + 1, and from element to element (golden
# ratio), in units of 2⁻³²: whole numbers, so that the sequence stays exact however long it gets.
STEPS, STRIDE = (3679390609, 3152041523, 2700274807, 2313257605), 2654435769
CELLS = 2.0
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))

Image = NDArray[np.float64]


def solve(scene: mi.Scene, lens: mi.Sensor, quadrature: Quadrature) -> Solution:
    """Power [W], error [W] and coverage on every pixel of the crop window; see `Quadrature` for what is promised.

    `max_nodes` bounds the lines of sight a pixel of the image takes on average; two levels are run in any case.
    Coverage counts lines of sight that meet a glowing surface. Raises SceneError where an emitter has no surface.
    """
    with dr.suspend_grad():
        return _Refinement(scene, lens, quadrature).run()


class _Refinement:
    """The picture while it is refined: mean radiance on film, its error and coverage, shape (h, w)."""

    def __init__(self, scene: mi.Scene, lens: mi.Sensor, quadrature: Quadrature) -> None:
        self.scene, self.lens, self.quadrature = scene, lens, quadrature
        self.window = visible_window(scene, lens)
        self.glows = [_glow(emitter, lens, self.window, quadrature.rtol) for emitter in scene.emitters()]
        self.value, self.error, self.hits = (np.zeros(self.window.shape) for _ in range(3))
        self.peak = float(np.finfo(np.float32).tiny)
        self.rays = 0
        self.last = np.zeros(self.window.shape)
        self.levels: list[str] = []

    def run(self) -> Solution:
        mark = np.ones(self.window.shape, bool)
        if mark.size:
            self.value, self.hits = self._level(FIRST_LINES, mark)
        lines = FIRST_LINES * GROWTH
        while mark.any() and lines <= max(self.quadrature.max_nodes, FIRST_LINES * GROWTH):
            value, hits = self._level(lines, mark)
            change = np.where(mark, np.abs(value - self.value), 0)
            now = SAFETY * pixels.spread_max(change)
            self.error[mark] = np.maximum(now, 0.5 * self.last)[mark]
            self.last = now
            # All elements with light on a marked pixel were refined: there, and only there, the new picture is whole.
            self.value[mark], self.hits[mark] = value[mark], hits[mark]
            mark = self.error > self.quadrature.rtol * self.value.max()
            lines *= GROWTH
        error = np.maximum(self.error, FLOAT32_FLOOR * self.value.max(initial=0.0))
        error[self.hits == 0] = self.error[self.hits == 0]
        power, error = (self.window.expand(image) * self.lens.etendue for image in (self.value, error))
        coverage = self.window.expand(np.clip(self.hits, 0, 1))
        return Solution(power, error, coverage, self.rays, tuple(self.levels))

    def _level(self, lines: int, mark: NDArray[np.bool_]) -> list[Image]:
        """Value and hits from all elements with light on a marked pixel, at so many lines of sight a pixel."""
        while True:
            quanta = (self.peak * RESOLUTION, COVERAGE_QUANTUM)
            canvas = Canvas(self.window.shape, quanta, self.quadrature.pixel == "centre")
            batches = [batch for glow in self.glows for batch in glow.batches(lines, mark)]
            peak = max((self._lay(canvas, batch) for batch in batches), default=0.0)
            if peak <= HEADROOM * self.peak:
                break
            self.peak = peak  # brighter than foreseen: once more in coarser steps
        rays = sum(int(batch.lines.sum()) for batch in batches)
        self.rays += rays
        self.levels.append(f"{lines} lines a pixel: {np.count_nonzero(mark)} pixels, {rays} lines")
        return canvas.pictures()

    def _lay(self, canvas: Canvas, batch: _Batch) -> float:
        """Lay the light of a batch on the canvas, one line of sight a lane; the largest radiance that was met."""
        elements, lens, window = batch.glow.elements, self.lens, self.window
        index, cut, m, number = batch.lanes()
        part, i, j = number // (m * m), number % m, number // m % m
        spot, aim = _strata(i, j, m, index * STRIDE + part)

        si, area = elements.place(index, spot, cut, part)
        _, lens_point, weight, cos_theta = lens.arrival(si.p, mi.warp.square_to_uniform_disk_concentric(aim))
        to_lens = dr.normalize(lens_point - si.p)
        cos_s = dr.dot(si.n, to_lens)
        active = (cos_s > 0) & (weight > 0)
        active &= ~self.scene.ray_test(si.spawn_ray_to(lens_point), active)
        si.initialize_sh_frame()
        si.wi = si.to_local(to_lens)
        radiance = dr.select(active, scalar(batch.glow.emitter.eval(si, active)), 0)
        virtual_pixel = dr.opaque(mi.Float, self.lens.virtual_pitch**2)
        etendue = dr.select(active, cos_s * weight * area / (dr.square(mi.Float(m)) * virtual_pixel), 0)

        origin = (window.left + window.crop_offset[0], window.top + window.crop_offset[1])
        origin = mi.Vector2f(*(dr.opaque(mi.Float, n) for n in origin))
        discs = [lens.blur_disc(elements.place(index, mi.Point2f(*corner), cut, part)[0].p) for corner in CORNERS]
        middle = _middle(i, j, m)
        polygon = [centre - origin + radius * middle for centre, radius, _ in discs]
        for _, _, scale in discs:  # a piece that reaches through the lens plane has no image
            active &= scale * discs[0][2] > 0
        lights = (mi.Float64(radiance) * mi.Float64(etendue), mi.Float64(etendue / dr.square(dr.square(cos_theta))))
        canvas.lay(lights, polygon, active)
        dr.eval(radiance, canvas.layers)
        return float(dr.max(radiance)[0])


def _strata(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32, number: mi.UInt32) -> tuple[mi.Point2f, mi.Point2f]:
    """Points of a piece and of the pupil, both in [0, 1]², for the line of sight through the pupil's cell (i, j).

    The lines of a piece take each of its M × M parts and each cell of the pupil once: part = (turn + √-1) × cell
    modulo M, as complex numbers, a lattice without short vectors in all four dimensions. They lie off the middles,
    differently for every piece `number`; opposite ways by turns, so that what is linear is integrated exactly.
    """
    turn = 2 * mi.UInt32(dr.round(0.5 * dr.sqrt(mi.Float(m))))  # even: 1 + turn² has no divisor in common with M = 2ⁿ
    one_way = dr.select((i + j) % 2 == 0, 1.0, -1.0)
    off = [one_way * (mi.Float(number * step) * 2.0**-32 - 0.5) for step in STEPS]
    strata = ((turn * i + (m - 1) * j) % m, (i + turn * j) % m, i, j)
    x = [(mi.Float(stratum) + 0.5 + o) / mi.Float(m) for stratum, o in zip(strata, off, strict=True)]
    return mi.Point2f(x[0], x[1]), mi.Point2f(x[2], x[3])


def _middle(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32) -> mi.Point2f:
    """Middle of the pupil's cell (i, j) in the unit disc, moved out so that all have the disc's second moments."""
    square = mi.Point2f(mi.Float(i) + 0.5, mi.Float(j) + 0.5) / mi.Float(m)
    # Σ (2k + 1 − M)² over the square rings: the mean of r² falls short of ½ by 1/M².
    return mi.warp.square_to_uniform_disk_concentric(square) * dr.rsqrt(1 - 2 / dr.square(mi.Float(m)))


@dataclass(frozen=True)
class _Batch:
    """Lines of sight of one launch: through `cells`² cells of the pupil from every piece of the elements `index`."""

    glow: _Glow
    index: NDArray[np.int64]
    cuts: NDArray[np.int64]
    cells: NDArray[np.int64]

    @property
    def lines(self) -> NDArray[np.int64]:
        return (self.cuts * self.cells) ** 2

    def lanes(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.UInt32]:
        """Element, number of cuts and number within the element of every line of sight."""
        ends = np.cumsum(self.lines)
        number = np.arange(ends[-1]) - np.repeat(ends - self.lines, self.lines)
        row = mi.UInt32(np.repeat(np.arange(len(self.index)), self.lines).astype(np.uint32))
        columns = [mi.UInt32(column.astype(np.uint32)) for column in (self.index, self.cuts, self.cells)]
        index, cuts, cells = (dr.gather(mi.UInt32, column, row) for column in columns)
        # Lanes beyond the last gather 0, and whole numbers divided by 0 end the process.
        return index, dr.maximum(cuts, 1), dr.maximum(cells, 1), mi.UInt32(number.astype(np.uint32))


@dataclass(frozen=True)
class _Glow:
    """A glowing shape: its elements, the size of each one's image and the bounds of its light [pixels].

    sides (count,); low, high (count, 2) (x, y) in the window, empty where an element faces away; `blur`: largest
    radius of a blur disc in the picture.
    """

    emitter: mi.Emitter
    elements: Elements
    sides: Image
    low: Image
    high: Image
    blur: Image

    def batches(self, lines: int, mark: NDArray[np.bool_]) -> Iterator[_Batch]:
        """The lines of sight of all elements with light on a marked pixel, `LANES` at a time."""
        index = self._touching(mark)
        cells = _cells(lines, self.blur[index])
        cuts = np.ceil(self.sides[index] * (math.sqrt(lines) / cells)).clip(
            1, np.maximum(1, math.isqrt(LANES) // cells)
        )
        cuts = cuts.astype(np.int64)
        ends = np.cumsum((cuts * cells) ** 2)
        first = 0
        while first < len(index):
            done = ends[first - 1] if first else 0
            last = max(first + 1, int(np.searchsorted(ends, done + LANES, side="right")))
            yield _Batch(self, index[first:last], cuts[first:last], cells[first:last])
            first = last

    def _touching(self, mark: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Elements whose bounds hold a marked pixel, from sums over all rectangles with a corner in the first pixel."""
        total = np.zeros((mark.shape[0] + 1, mark.shape[1] + 1), np.int64)
        total[1:, 1:] = mark.cumsum(0).cumsum(1)
        size = np.array(mark.shape[::-1])
        left, top = np.clip(np.floor(self.low), 0, size).astype(np.int64).T
        right, bottom = np.clip(np.floor(self.high) + 1, 0, size).astype(np.int64).T
        marked = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
        return np.flatnonzero((marked > 0) & (right > left) & (bottom > top))


def _cells(lines: int, blur: Image) -> NDArray[np.int64]:
    """M"""
    ideal = np.log2(np.maximum(CELLS * lines**0.25 * np.sqrt(blur), 4) / 4)
    return (4 * 2 ** np.minimum(np.ceil(ideal), round(math.log2(lines) / 2) - 2)).astype(np.int64)


def _glow(emitter: mi.Emitter, lens: mi.Sensor, window: Window, rtol) -> _Glow:
    """Elements of an emitter's shape and what of the film their light can reach."""
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
        raise SceneError(
            f"fspt_integral: domain 'surface' needs surfaces, but the emitter {emitter.class_name()} has none. Give "
            "domain = pupil."
        )
    shape = emitter.get_shape()
    pixel = lens.blur_disc(mi.Point3f(shape.bbox().center()))[2][0]
    ideal = float(shape.surface_area()[0]) / (PIXELS_PER_ELEMENT * pixel**2)
    elements = elements_of(shape, int(min(max(ideal, MIN_ELEMENTS), MOST_ELEMENTS)))
    count = elements.count
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    least, most = np.full(count, np.inf), np.full(count, -np.inf)
    axes, blur = np.zeros((2, count, 2)), np.zeros(count)
    for x, y in CORNERS:
        si, _ = elements.place(dr.arange(mi.UInt32, count), mi.Point2f(x, y))
        front = _front(si, lens)
        dr.eval(si.p, front)
        centre, radius = lens.film_discs(si.p.numpy().T.astype(np.float64))
        low, high = np.minimum(low, centre - radius), np.maximum(high, centre + radius)
        least, most = np.minimum(least, front.numpy()), np.maximum(most, front.numpy())
        axes += (np.array([x, y]) - 0.5)[:, None, None] * centre
        blur = np.maximum(blur, radius[:, 0])
    bulge = 0.1 * (high - low)
    low, high = low - bulge, high + bulge
    # Curved elements bulge beyond their corners: there is light unless `front` stays below 0 by as much as it varies.
    dark = 2 * most - least <= 0
    low[dark], high[dark] = np.inf, -np.inf
    origin = (window.left + window.crop_offset[0], window.top + window.crop_offset[1])
    sides = np.where(np.isfinite(blur), np.hypot(*axes.transpose(2, 0, 1)).max(axis=0), UNBOUNDED_SIDE)
    blur = np.minimum(blur, math.hypot(*window.shape))
    small = math.sqrt(8 * rtol)
    sides = np.where(sides > small, np.maximum(sides, 1), sides)
    return _Glow(emitter, elements, sides, low - origin, high - origin, blur)


def _front(si: mi.SurfaceInteraction3f, lens: mi.Sensor) -> mi.Float:
    """n·(a − r) at the most for any point a of the pupil [mm]: > 0 where the pupil can see the surface point."""
    _, middle, _, _ = lens.arrival(si.p, mi.Point2f(0))
    _, rim, _, _ = lens.arrival(si.p, mi.Point2f(1, 0))
    return dr.dot(si.n, middle - si.p) + dr.norm(rim - middle)
