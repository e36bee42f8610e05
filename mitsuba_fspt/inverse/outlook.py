"""A first fit on few unknowns, in seconds: whether the images can be those of this surface at all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .measurement import LOG
from .surface import Surface

if TYPE_CHECKING:
    from ..runtime.progress_bar import Progress
    from .invert import Fit, Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hopeless:
    """When a first fit counts as hopeless: all of the first three hold, or the first and the three from `alone` on.

    chi2 : least Σ (residual/σ)² over free pixels
    share : least residual, root of the sum of squares, over that of the image: pose and order of views leave tenths of
        it, errors of the model with many electrons a few hundredths
    gain : least χ² with some times as many unknowns, over that with few: where the unknowns are too coarse for J_n, χ²
        falls by the fourth power of their distance, to a fourth or less
    alone : largest residual of the four neighbours, on average, over that of a pixel by itself: cosmic rays and hot
        pixels, where light is spread over neighbours by the lens and by the size of the unknowns
    rest, few : most of χ² that is left without those pixels, and the largest share of them among all
    rounds : most rounds of variances and weight of the fit that follows, which no accuracy would help
    """

    chi2: float = 5.0
    share: float = 0.1
    gain: float = 0.5
    alone: float = 0.25
    rest: float = 0.5
    few: float = 0.01
    rounds: int = 10


def is_hopeless(problem: Problem, levels: list[Surface], bounds: Hopeless, report: Progress) -> bool:
    """True where more unknowns do not explain the images either, or single pixels hold most of χ²; told on stderr.

    levels : the surface and coarser ones, as from `Surface.coarser`; without a coarser one the result is False
    """
    if len(levels) < 2:
        return False
    part, fit, residual, chi2 = _first(problem, levels[-1], report)
    if chi2 < bounds.chi2:
        return False
    if count := _alone(part, residual, bounds):
        cause = f"{count} pixels differ from all around them and hold most of it: mask cosmic rays and hot pixels"
    else:
        if _share(part, fit, residual) < bounds.share:
            return False
        fine, fit, off, less = _first(problem, levels[-2], report)
        exact = fit.determined > 0.5 * len(off)  # as many unknowns as pixels fit any image
        if not exact and (less < max(bounds.gain * chi2, bounds.chi2) or _share(fine, fit, off) < bounds.share):
            return False
        cause = "check pose, order of the views, unit of the mesh, background and the detector's numbers"
    LOG.warning("fspt: invert: a first fit is hopeless, chi2 %.3g; %s. It goes on with few unknowns.", chi2, cause)
    return True


def _alone(problem: Problem, residual: Array, bounds: Hopeless) -> int:
    """Number of pixels that are brighter than all around them, where they are few and hold most of Σ (residual/σ)²."""
    views, height, width = problem.matrix.image_shape
    image = np.zeros(views * height * width)
    image[problem.rows] = residual
    padded = np.pad(np.abs(image).reshape(views, height, width), ((0, 0), (1, 1), (1, 1)))
    around = (padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]) / 4
    own = padded[:, 1:-1, 1:-1]
    bright = image.reshape(own.shape) > np.sqrt(bounds.chi2 * np.mean(residual**2))
    alone = bright & (around < bounds.alone * own)
    most = (own[~alone] ** 2).sum() < bounds.rest * (own**2).sum()
    return int(alone.sum()) if most and alone.sum() <= bounds.few * len(residual) else 0


def _share(problem: Problem, fit: Fit, residual: Array) -> float:
    """Residual over the image, each the root of its sum of squares."""
    power = problem.measurement.power[problem.rows]
    return float(np.linalg.norm(residual * fit.sigma) / np.linalg.norm(power))


def _first(problem: Problem, surface: Surface, report: Progress) -> tuple[Problem, Fit, Array, float]:
    """A first fit on the unknowns of a surface, without bounds: problem, fit, residual over σ (N,), and χ²."""
    part = problem.free_on(surface)
    fit = part.fit(None, report, rough=True)
    residual = (part.measurement.power[part.rows] - part.signal(fit.x)) / fit.sigma
    return part, fit, residual, float(residual @ residual) / max(len(residual) - fit.determined, 1.0)
