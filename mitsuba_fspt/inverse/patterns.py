"""Patterns in the residuals of images that a cause outside the model makes, of unit length in units of the noise.

Of each view: a factor, an additive background, a gradient, a shift, a scale of the image about its centre, and low
cosines over the film times the signal; a shift and a scale that all views have in common; of each source inside:
cosines of the distance from it times its light; of the tissue in each band: relative changes of absorption and
scattering.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, hstack

Array = NDArray[np.float64]
COSINES = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))  # half waves over the film, down and across
POWERS = 4  # of the distance from a source


@dataclass(frozen=True, eq=False)
class Seen:
    """What one view shows: labels in messages, and its pixels.

    name : of the view, such as 'view=90'
    signal : (h, w) fitted signal [W], NaN where masked
    rows : (n,) ascending numbers of the view's pixels that are fitted, in the view
    sigma : (n,) their noise [W]
    """

    name: str
    signal: Array
    rows: NDArray[np.int64]
    sigma: Array


def views_of(names: Sequence[str], signal: Array, rows: NDArray[np.int64], sigma: Array) -> list[Seen]:
    """What each view shows.

    signal : (views, h, w) fitted signal [W], NaN where masked
    rows, sigma : (N,) ascending numbers of the pixels of all views that are fitted, and their noise [W]
    """
    size = signal[0].size
    view = rows // size
    return [
        Seen(name or f"image {k + 1}", signal[k], rows[view == k] - k * size, sigma[view == k])
        for k, name in enumerate(names)
    ]


@dataclass(frozen=True, eq=False)
class Pattern:
    """A cause: its kind, where it is, and the columns that it moves.

    kind : 'factor', 'background', 'gradient', 'shift', 'scale', 'smooth', 'ring', 'absorption' or 'scattering'
    where : name of the view, 'all views', 'source 1', 'the tissue' or 'band red'
    columns : (d,) or (d, k) numbers of columns; each of the d unknowns moves its k columns by the unit of the kind
    """

    kind: str
    where: str
    columns: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Patterns:
    """Columns (N, p) of unit length over all pixels that are fitted, one view after the other.

    lengths : (p,) of the columns in units of the kind: factor 1, background W, gradient 1 from the centre to the edge
        of the film, shift pixels, scale 1, absorption and scattering 1
    """

    columns: csr_array
    lengths: Array
    causes: tuple[Pattern, ...]

    @classmethod
    def of(
        cls,
        views: Sequence[Seen],
        rings: Sequence[tuple[Array, Array]] = (),
        slopes: Sequence[tuple[str, str, Array]] = (),
    ) -> Patterns:
        """Patterns of views, of sources and of the tissue.

        rings : of each source its light over σ and the distance [mm] from it, (N,) each
        slopes : kind, where and (N,) change of the fitted signal over σ by a cause with one size
        """
        blocks, causes, first, ends = [], list[Pattern](), 0, np.cumsum([0, *(len(one.rows) for one in views)])
        total = int(ends[-1])
        for view, start in zip(views, ends, strict=False):
            if not len(view.rows):
                continue
            block, kinds = _of_view(view)
            rows = np.repeat(np.arange(len(view.rows)) + start, block.shape[1])
            entries = np.tile(np.arange(block.shape[1]), len(view.rows))
            blocks.append(csr_array((block.ravel(), (rows, entries)), shape=(total, block.shape[1])))
            causes += [Pattern(kind, view.name, np.array(where) + first) for kind, where in kinds.items()]
            first += block.shape[1]
        if len(views) > 1:
            shifts, scales = (np.array([c.columns for c in causes if c.kind == kind]) for kind in ("shift", "scale"))
            causes += [Pattern("shift", "all views", shifts.T), Pattern("scale", "all views", scales.T)]
        for number, (light, distance) in enumerate(rings, start=1):
            near, far = distance[light > 0].min(initial=np.inf), distance[light > 0].max(initial=0.0)
            along = (distance - near) / max(far - near, 1e-300)
            ring = light[:, None] * np.cos(np.pi * along[:, None] * np.arange(1, POWERS + 1))
            blocks.append(csr_array(ring))
            causes.append(Pattern("ring", f"source {number}", np.arange(POWERS) + first))
            first += POWERS
        for kind, where, slope in slopes:
            blocks.append(csr_array(slope[:, None]))
            causes.append(Pattern(kind, where, np.array([first])))
            first += 1
        columns = csr_array(hstack(blocks, format="csr"))
        lengths = np.sqrt(np.asarray(columns.multiply(columns).sum(axis=0)).ravel())
        scaled = columns.multiply(1 / np.where(lengths > 0, lengths, 1.0)[None])
        return cls(csr_array(scaled), lengths, tuple(causes))


def _of_view(view: Seen) -> tuple[Array, dict[str, list[int]]]:
    """(n, p) columns of a view, over σ, and their numbers by kind."""
    height, width = view.signal.shape
    signal = np.nan_to_num(view.signal)
    down, across = np.divmod(view.rows, width)
    y, x = (2 * down + 1) / height - 1, (2 * across + 1) / width - 1
    light = signal[down, across]
    slope_y, slope_x = (_slope(view.signal, axis)[down, across] for axis in (0, 1))
    found = [light, np.ones_like(light), light * x, light * y, slope_x, slope_y]
    found.append((down - (height - 1) / 2) * slope_y + (across - (width - 1) / 2) * slope_x)
    v, u = ((one - one.min()) / max(float(np.ptp(one)), 1.0) for one in (down, across))
    found += [light * np.cos(np.pi * j * v) * np.cos(np.pi * i * u) for j, i in COSINES]
    kinds = {"factor": [0], "background": [1], "gradient": [2, 3], "shift": [4, 5], "scale": [6]}
    return np.column_stack(found) / view.sigma[:, None], kinds | {"smooth": [7 + k for k in range(len(COSINES))]}


def _slope(signal: Array, axis: int) -> Array:
    """(h, w) change of the signal [W] per pixel; 0 beside masked pixels, and on a film of one pixel."""
    if signal.shape[axis] < 2:
        return np.zeros_like(signal)
    return np.nan_to_num(np.gradient(signal, axis=axis))
