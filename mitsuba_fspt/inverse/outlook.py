"""A first fit on few unknowns, in seconds: whether the images can be those of this surface at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.progress_bar import Progress
from .fit_settings import Hopeless
from .measurement import LOG
from .problem import Fit, Problem
from .surface import Surface

Array = NDArray[np.float64]


def is_hopeless(problem: Problem, levels: list[Surface], bounds: Hopeless, report: Progress) -> bool:
    """True if more unknowns do not explain the images either, or most of χ² is on few pixels; reported on stderr.

    levels : the surface and coarser ones, as from `Surface.coarser`; without a coarser one the result is False
    """
    if len(levels) < 2:
        return False
    part, fit, residual, chi2 = _first(problem, levels[-1], report)
    if chi2 < bounds.chi2:
        return False
    if count := _alone(part, residual, bounds):
        cause = f"about {count} pixels differ from all around them and hold most of it: mask cosmic rays and hot pixels"
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
    """Number of pixels that are brighter than all around them, where they are few and hold most of Σ (residual/σ)².

    The fit bends towards them, so that a pixel beside one may count, too, and one of little light may not.
    """
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
