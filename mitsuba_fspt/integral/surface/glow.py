"""Glowing shapes of the surface form (Eq. M.9): their elements, pieces of these, and the pixels that they can light."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Window
from ...emission.elements import Elements, elements_of
from ...emission.exitance import function_on
from ...emission.of_emitter import surface_of
from ...jit.batches import BATCH, batch_slices, numbered
from ...jit.from_numpy import from_numpy
from ...runtime.errors import SceneError

CELLS = 2.5  # cells along the pupil over ⁴√lines: errors of cells and of pieces are then about equal for any blur
PIXELS_PER_ELEMENT, FEWEST_ELEMENTS, MOST_ELEMENTS = 4, 1 << 10, 1 << 20
# Over rtol: elements of a shape that is no mesh. Below a pixel none is cut, so that no level shows the error of the
# midpoint rule on n elements, times n in MIDPOINT: on a disk around its centre, where elements are triangles.
FLAT, CURVED = 8.0, 24.0
MIDPOINT = {"Sphere": 0.8, "Cylinder": 0.8, "Disk": 6.0}
BULGE = 0.1  # how far a curved element may reach beyond its corners, in units of their distance
MISPLACED = 1 / 8  # of a step in J_n along an element, times its side squared [pixels], it misplaces
UNBOUNDED = 4.0  # side [pixels] counted for an element that reaches through the lens plane and has no image
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))  # of an element, once around

Plane = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Batch:
    """Lines of sight of one launch: from `cuts`² pieces of each element through `cells`² cells of the pupil."""

    glow: Glow
    index: Index
    cuts: Index
    cells: int

    @property
    def lines(self) -> Index:
        return (self.cuts * self.cells) ** 2

    def lanes(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Of every line of sight the element, its cuts and the line's number within the element."""
        row, number = numbered(self.lines)
        row = from_numpy(mi.UInt32, row)
        index, cuts = (dr.gather(mi.UInt32, from_numpy(mi.UInt32, of), row) for of in (self.index, self.cuts))
        # Entries beyond the last one gather 0, and an integer division by 0 ends the process.
        return index, dr.maximum(cuts, 1), from_numpy(mi.UInt32, number)


@dataclass(frozen=True)
class Glow:
    """A glowing shape and, for each of its elements, where its light can arrive [pixels of the window].

    sides, blur (count,): longer side of its image, radius of its blur disc; low, high (count, 2): bounds of its
    light in x and y, empty where it faces away from the lens or is one of those left out because they are `dark`.
    small: a blur disc is larger than all that shines. steps (count,): by how much the radiance differs between the
    corners [W/mm²/sr].
    """

    emitter: mi.Emitter
    elements: Elements
    sides: Plane
    blur: Plane
    low: Plane
    high: Plane
    steps: Plane
    dark: int
    small: bool

    @property
    def count(self) -> int:
        return self.elements.count

    @property
    def unseen(self) -> float:
        """Error that the number of elements leaves in any case, over the brightest pixel."""
        return MIDPOINT.get(self.elements.shape.class_name(), 0.0) / self.count

    def batches(self, lines: int, mark: NDArray[np.bool_]) -> Iterator[Batch]:
        """The lines of sight of all elements with light on a marked pixel, some `BATCH` at a time."""
        index = np.flatnonzero(touching(self.low, self.high, mark))
        cells = cells_of(lines)
        cuts = np.round(self.sides[index] * math.sqrt(lines) / cells).astype(np.int64)
        cuts = cuts.clip(1, max(math.isqrt(BATCH) // cells, 1))
        for run in batch_slices((cuts * cells) ** 2):
            yield Batch(self, index[run], cuts[run], cells)

    def finer(self, tolerance: float) -> Glow:
        """With elements below a pixel cut like larger ones where they misplace more than `tolerance` [W/mm²/sr]."""
        # Along a pixel's side the elements of a row misplace light alike, 1/side of them; in a blur disc they do so
        # along a line through it, by its density 1/(π r²).
        misplaced = MISPLACED * self.sides**2 * self.steps / (self.sides + math.pi / 2 * self.blur**2)
        return replace(self, sides=np.where(misplaced > tolerance, np.maximum(self.sides, 1), self.sides))

    @classmethod
    def seen(cls, emitter: mi.Emitter, camera: Camera, window: Window, rtol: float, skip_dark: bool) -> Glow:
        """The shape of an emitter, imaged by `camera` in `window`; SceneError where the emitter has no surface."""
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            raise SceneError(
                f"fspt_integral: domain 'surface' needs surfaces, but emitter {emitter.class_name()} has none. Set "
                "domain to 'pupil'."
            )
        elements = _elements(emitter.get_shape(), camera, rtol)
        count = elements.count
        low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        least, most = np.full(count, np.inf), np.full(count, -np.inf)
        axes, blur = np.zeros((2, count, 2)), np.zeros(count)
        centres, levels = [], []
        exitance = _exitance(emitter)
        for corner in CORNERS:
            # Opaque: one kernel for all corners.
            si, _ = elements.place(dr.arange(mi.UInt32, count), mi.Point2f(*(dr.opaque(mi.Float, n) for n in corner)))
            front = _front(si, camera)
            level = exitance(si) / dr.pi
            dr.eval(si.p, front, level)
            centre, radius = camera.film_discs(si.p.numpy().T.astype(np.float64))
            low, high = np.minimum(low, centre - radius), np.maximum(high, centre + radius)
            least, most = np.minimum(least, front.numpy()), np.maximum(most, front.numpy())
            axes += (np.array(corner) - 0.5)[:, None, None] * centre
            centres.append(centre)
            levels.append(np.broadcast_to(level.numpy(), count).astype(np.float64))
            blur = np.maximum(blur, radius[:, 0])
        sides = np.where(np.isfinite(blur), np.hypot(*axes.transpose(2, 0, 1)).max(axis=0), UNBOUNDED)
        margin = BULGE * sides[:, None]
        low, high = low - margin - window.corner, high + margin - window.corner
        # A curved element may turn towards the lens between its corners, by as much again as these differ.
        away = 2 * most - least <= 0
        dark = _dark(emitter, np.max(levels, axis=0)) if skip_dark else np.zeros(count, bool)
        low[away | dark], high[away | dark] = np.inf, -np.inf
        lit = ~(away | dark)
        area, extent = _area(*centres)[lit].sum(), _extent(np.concatenate([corner[lit] for corner in centres]))
        small = area < math.pi * blur.min(initial=np.inf) ** 2
        # An element smaller than a pixel would stay in one piece at the first levels, which would agree. A
        # piece of side s misplaces about s²/8 of a step in J_n, less where a thick body is blurred. Where that is below
        # the tolerance it stays in one piece, unless `finer` finds the image dim beside the step.
        thickness = max(1, area / extent) if small and extent > 0 else 1
        sides = np.where(sides > math.sqrt(rtol * thickness / MISPLACED), np.maximum(sides, 1), sides)
        return cls(
            emitter,
            elements,
            sides,
            np.minimum(blur, math.hypot(*window.shape)),
            low,
            high,
            np.ptp(levels, axis=0),
            int(dark.sum()),
            bool(small),
        )


def touching(low: Plane, high: Plane, mark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True for bounds `low` … `high` (n, 2) [pixels] with a marked pixel in them.

    By the sums over all rectangles that begin at pixel (0, 0).
    """
    total = np.zeros((mark.shape[0] + 1, mark.shape[1] + 1), np.int64)
    total[1:, 1:] = mark.cumsum(0).cumsum(1)
    size = np.array(mark.shape[::-1])
    empty = ~(low <= high).all(axis=1, keepdims=True)
    left, top = np.clip(np.floor(np.where(empty, 0, low)), 0, size).astype(np.int64).T
    right, bottom = np.clip(np.floor(np.where(empty, -1, high)) + 1, 0, size).astype(np.int64).T
    marked = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
    return (marked > 0) & (right > left) & (bottom > top)


def _area(a: Plane, b: Plane, c: Plane, d: Plane) -> Plane:
    """Areas of quadrangles (count,), from their corners (count, 2) once around."""
    across, along = c - a, d - b
    return 0.5 * np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0])


def _extent(points: Plane) -> float:
    """Longer side of the box around points (count, 2)."""
    return float((points.max(axis=0) - points.min(axis=0)).max()) if len(points) else 0.0


def cells_of(lines: int) -> int:
    """Cells M along the pupil, 2ᵏ or 3·2ᵏ, where a pixel of the image gets so many lines of sight: M ∝ ⁴√lines.

    At least 4, and no more than leave pieces of a pixel.
    """
    ideal = min(max(CELLS * lines**0.25, 4), math.sqrt(lines))
    octave = 2 ** int(math.log2(ideal))
    return octave if ideal < 1.5 * octave else 3 * octave // 2


def _elements(shape: mi.Shape, camera: Camera, rtol: float) -> Elements:
    """Elements of a few pixels each, so that the refinement of one pixel affects few others."""
    pixel = float(camera.blur_disc(mi.Point3f(shape.bbox().center()))[2][0])
    ideal = float(shape.surface_area()[0]) / (PIXELS_PER_ELEMENT * pixel**2)
    curved = shape.class_name() in ("Sphere", "Cylinder")
    fewest = FEWEST_ELEMENTS if shape.is_mesh() else max(FEWEST_ELEMENTS, (CURVED if curved else FLAT) / rtol)
    return elements_of(shape, int(min(max(ideal, fewest), MOST_ELEMENTS)))


def _dark(emitter: mi.Emitter, brightest: Plane) -> NDArray[np.bool_]:
    """True of elements whose `brightest` corner is dark and J_n, a mesh attribute, linear between the corners."""
    surface = surface_of(emitter)
    return (brightest == 0) & bool(surface and surface.is_linear())


def _exitance(emitter: mi.Emitter) -> Callable[[mi.SurfaceInteraction3f], mi.Float]:
    """J_n [W/mm²] at surface points; of other emitters than `fspt_surface` 0."""
    surface = surface_of(emitter)
    return function_on(surface.shape, surface.exitance) if surface else lambda si: mi.Float(0)


def _front(si: mi.SurfaceInteraction3f, camera: Camera) -> mi.Float:
    """n·(a − r) at the most for any point a of the pupil [mm]: positive where the pupil can see the surface point."""
    _, middle, _, _ = camera.arrival(si.p, mi.Point2f(0))
    _, rim, _, _ = camera.arrival(si.p, mi.Point2f(1, 0))
    return dr.dot(si.n, middle - si.p) + dr.norm(rim - middle)
