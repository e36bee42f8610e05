"""Mitsuba's Monte Carlo of a scene: independent passes, and what scatters between them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

ALIKE = 3.0  # by less than this factor do the errors of neighbours differ that see the same
FEW = 20  # events on a pixel; fewer say too little of their variance
Plane = NDArray[np.float64]


def tracer(method: str) -> mi.Integrator:
    """Mitsuba's `path` or `ptracer`, one ray a sample."""
    import mitsuba as mi

    # Depth 1 is the light that leaves the surface straight into the lens, all there is in free space.
    return mi.load_dict({"type": method, "max_depth": 1})


def passes(
    scene: mi.Scene, lens: mi.Sensor, integrator: mi.Integrator, seeds: Iterable[int], spp: int
) -> Iterator[tuple[Plane, int]]:
    """Power [W], shape (h, w), and samples a pixel of one pass for each seed."""
    import drjit as dr

    from ..jit.recording import recording

    for seed in seeds:
        with dr.suspend_grad(), recording():
            image = integrator.render(scene, lens, seed=seed, spp=spp)
        yield np.array(image, np.float64)[..., 0], lens.sampler().sample_count()


def standard_error(mean: Plane, mean_square: Plane, count: int, samples: int) -> Plane:
    """Standard error s [W], shape (h, w), of the `mean` ⟨P⟩ of `count` passes with so many `samples` a pixel in all.

    s² = (⟨P²⟩ - ⟨P⟩²)/(count - 1) where the passes tell. Where light comes in events that bring w each, s² = w ⟨P⟩, so
    that ⟨P⟩²/s² of them were counted. Three cases in which a pixel's own passes tell too little:

    (a) events are `FEW`: s² is its mean over such pixels in the 3 × 3 around, those without events left out;
    (b) no event: besides, s is at least the largest w there;
    (c) all passes alike, but a neighbour's s above `ALIKE` times this one: some sample may have missed what next to it
        some missed, and s is at least ⟨P⟩/samples, if not the neighbour's.
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
