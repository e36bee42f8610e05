"""Mitsuba's Monte Carlo of a scene: independent passes, and the standard error from their scatter."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import SceneError
from ..runtime.numbers import whole

if TYPE_CHECKING:
    import mitsuba as mi

METHODS = ("path", "ptracer")
ALIKE = 3.0  # largest ratio of one missed sample to the scatter of samples that may have missed none
FEW = 20  # events on a pixel, below which its own passes give a poor estimate of the variance
Plane = NDArray[np.float64]


def tracer(method: str, scene: mi.Scene, lens: mi.Sensor, max_depth: int | None = None) -> mi.Integrator:
    """Mitsuba's integrator `path` or `ptracer` that follows light over at most `max_depth` straight segments.

    With one segment light goes straight from the glowing surface to the lens, which is all there is in free space. Each
    further segment begins at a surface that reflects or transmits the light. None: as many as the scene's specular
    surfaces need.

    Raises
    ------
    SceneError : `max_depth` is no whole number >= 1; or `ptracer` cannot show the light of specular surfaces.
    """
    import mitsuba as mi

    from ..camera.of_sensor import camera_of
    from ..integral.lines.specular import Specular
    from ..integral.quadrature import Quadrature

    specular = Specular.of(scene, camera_of(lens))
    if specular and method == "ptracer":
        raise SceneError(
            f"render: method ptracer cannot connect light to the lens through or off the specular shapes "
            f"{', '.join(specular.names)}. Give method path."
        )
    if max_depth is None:
        own = getattr(scene.integrator(), "quadrature", Quadrature())
        max_depth = 1 + own.max_specular if specular else 1
    max_depth = whole("render: 'max_depth'", max_depth, SceneError, "3")
    if max_depth < 1:
        raise SceneError(f"render: 'max_depth' must be >= 1, got {max_depth}. Give 1 for light straight to the lens.")
    return mi.load_dict({"type": method, "max_depth": max_depth})


def depth_of(integrator: mi.Integrator) -> int | None:
    """Segments of light paths that a Monte Carlo follows at most, -1 without a limit; None where it does not say."""
    if integrator.class_name() == "DirectIntegrator":
        return 2
    found = re.search(r"\bmax_depth = (-?\d+)", str(integrator))  # only its description states it
    if found is None:
        return None
    return int(found[1]) if 0 <= int(found[1]) < 1 << 31 else -1  # -1 is stated as 2³² - 1


def passes(
    scene: mi.Scene, lens: mi.Sensor, integrator: mi.Integrator, seeds: Iterable[int], spp: int
) -> Iterator[tuple[Plane, int]]:
    """Power [W], shape (h, w), and samples per pixel of one pass for each seed."""
    import drjit as dr

    from ..jit.recording import recording

    for seed in seeds:
        with dr.suspend_grad(), recording():
            image = integrator.render(scene, lens, seed=seed, spp=spp)  # type: ignore[call-overload]  # seed: int
        yield np.array(image, np.float64)[..., 0], lens.sampler().sample_count()


def standard_error(mean: Plane, mean_square: Plane, count: int, samples: int) -> Plane:
    """Standard error s [W], shape (h, w), of the `mean` ⟨P⟩ of `count` passes with `samples` per pixel in total.

    `mean` [W] and `mean_square` ⟨P²⟩ [W²] have the shape (h, w). s² = (⟨P²⟩ - ⟨P⟩²)/(count - 1) where the passes
    determine it. If light arrives in events of power w each, s² = w ⟨P⟩, and ⟨P⟩²/s² is the number of events. In four
    cases a pixel's own passes do not determine s:

    (a) at most `FEW` events: s² is its mean over such pixels in the 3 × 3 neighbourhood, those without events left out;
    (b) no event: in addition s is at least the largest w in the neighbourhood;
    (c) samples that agree, next to a pixel of another power: one sample more could have met what the neighbour sees. s
        is Δ/samples where that is above `ALIKE` times the scatter, Δ the largest difference of ⟨P⟩ to the 3 × 3
        neighbours. On a slope of ⟨P⟩ the samples themselves scatter by more;
    (d) passes that agree, next to a pixel with s above `ALIKE` times this one: some samples of the neighbour miss the
        light, as in a mask, so that samples of this pixel could miss it too. s is at least the smaller of ⟨P⟩/samples
        and the neighbour's s.
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
    missed = np.maximum(largest_around(mean) - mean, mean + largest_around(-mean)) / samples  # (c)
    near = largest_around(own)
    hidden = np.where(near > ALIKE * own, np.minimum(near, mean / samples), 0)  # (d)
    return np.where(few, counted, np.maximum(np.where(missed > ALIKE * own, missed, own), hidden))
