"""Mitsuba's Monte Carlo of a scene: independent passes, and the standard error from their scatter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

ALIKE = 3.0  # the errors of neighbouring pixels with the same view differ by less than this factor
FEW = 20  # events on a pixel, below which its own passes estimate the variance badly
Plane = NDArray[np.float64]


def tracer(method: str, max_depth: int) -> mi.Integrator:
    """Mitsuba's integrator `path` or `ptracer` that follows light over so many legs.

    One leg goes from the surface straight into the lens, which is all light in free space; each further one takes a
    surface that reflects light or lets it through.
    """
    import mitsuba as mi

    return mi.load_dict({"type": method, "max_depth": max_depth})


def passes(
    scene: mi.Scene, lens: mi.Sensor, integrator: mi.Integrator, seeds: Iterable[int], spp: int
) -> Iterator[tuple[Plane, int]]:
    """Power [W], shape (h, w), and samples per pixel of one pass for each seed."""
    import drjit as dr

    from ..jit.recording import recording

    for seed in seeds:
        with dr.suspend_grad(), recording():
            image = integrator.render(scene, lens, seed=seed, spp=spp)
        yield np.array(image, np.float64)[..., 0], lens.sampler().sample_count()


def standard_error(mean: Plane, mean_square: Plane, count: int, samples: int) -> Plane:
    """Standard error s [W], shape (h, w), of the `mean` ⟨P⟩ of `count` passes with `samples` per pixel in all.

    `mean` [W] and `mean_square` ⟨P²⟩ [W²] have the shape (h, w). s² = (⟨P²⟩ - ⟨P⟩²)/(count - 1) where the passes
    determine it. If light arrives in events of power w each, s² = w ⟨P⟩, and ⟨P⟩²/s² is the number of events. In three
    cases a pixel's own passes do not determine s:

    (a) at most `FEW` events: s² is its mean over such pixels in the 3 × 3 neighbourhood, those without events left out;
    (b) no event: in addition s is at least the largest w in the neighbourhood;
    (c) passes that agree, but a neighbour's s above `ALIKE` times this one: some samples there miss the light, so that
        a sample here could miss it too, and s is at least the smaller of ⟨P⟩/samples and the neighbour's s.
    """
    from ..jit.pixel_grid import Grid

    grid = Grid(mean.shape)

    def largest_around(image: Plane) -> Plane:
        return grid.array(grid.spread_max(grid.flat(image)))

    variance = np.maximum(mean_square - mean * mean, 0) / (count - 1)
    own, met = np.sqrt(variance), mean > 0
    event = np.maximum(np.divide(variance, mean, out=np.zeros_like(mean), where=met), mean / samples)
    few = mean * mean <= FEW * variance
    pooled = np.sqrt(grid.array(grid.mean_where(grid.flat(variance), grid.flat(few & met), 1)))  # (a)
    counted = np.where(met, pooled, np.maximum(pooled, largest_around(event)))  # (b)
    near = largest_around(own)
    missed = np.where(near > ALIKE * own, np.minimum(near, mean / samples), 0)  # (c)
    return np.where(few, counted, np.maximum(own, missed))
