"""Least squares over the positions and powers of point sources: Levenberg and Marquardt, with the diffusion equation.

Positions and powers >= 0 minimise Σ (residual/σ)² with the variances of Eq. M.24; their covariance is that of
Eq. M.26, J the slopes with positions and powers. The powers of given positions follow from linear least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..runtime.errors import FluxError, InversionError
from ..runtime.progress_bar import Progress
from .band_images import BandImages

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocationSettings:
    """Accuracy of the fit.

    chi2 : fall of Σ (residual/σ)² by a step at which the fit ends: 1e-2 leaves parameters within 0.1 of their sd
    step : of the differences for slopes, over the edge of the tetrahedra; the slopes are right to about 0.1 %
    steps : most accepted steps;  damping : first factor of Levenberg and Marquardt
    stuck : factor of damping at which no step is left: the minimum is at the border, or beyond
    apart : least singular value of the slopes with columns of length 1, over the largest; below it sources count as not
        determined separately
    """

    chi2: float = 1e-2
    step: float = 0.01
    steps: int = 40
    damping: float = 1e-3
    stuck: float = 1e8
    apart: float = 1e-3


@dataclass(frozen=True, eq=False)
class PointSources:
    """Point sources and their images: positions (K, 3) [mm] and powers (K,) [W].

    exitance : of each band, (V, K) J_n per watt of each source [1/mm²]
    columns : (N, K) power on the pixels of all bands per watt;  sigma : (N,) their noise [W]
    cost : Σ (residual/σ)²
    """

    positions: Array
    powers: Array
    exitance: tuple[Array, ...]
    columns: Array
    sigma: Array
    cost: float

    @property
    def signal(self) -> Array:
        """(N,) fitted power [W]."""
        return np.asarray(self.columns @ self.powers)

    def sorted(self) -> PointSources:
        """The same, the source of the largest power first."""
        order = np.argsort(-self.powers, kind="stable")
        return replace(
            self,
            positions=self.positions[order],
            powers=self.powers[order],
            exitance=tuple(values[:, order] for values in self.exitance),
            columns=self.columns[:, order],
        )


class SourceFit:
    """Fit of point sources to the images of all bands, their pixels one after the other, (N,)."""

    def __init__(self, bands: Sequence[BandImages], settings: LocationSettings, report: Progress) -> None:
        self.bands, self.settings = bands, settings
        self._report, self._share = report, 0.0  # of the steps that are done
        self.power = np.concatenate([band.power for band in bands])
        self.edge = bands[0].tissue.mesh.edge

    @property
    def gain_error(self) -> float:
        """Relative standard deviation of a factor common to all images."""
        return max(band.measurement.gain_error for band in self.bands)

    def free(self, found: PointSources) -> int:
        """Number of pixels less that of the parameters, at least 1."""
        return max(len(self.power) - 4 * len(found.powers), 1)

    def images(self, values: Array) -> Array | dict[str, Array]:
        """Values (N,) of the pixels as images, (views, height, width); by the names of the bands where they have names.

        NaN on pixels that are masked or do not see the surface.
        """
        parts = np.split(values, np.cumsum([len(band.rows) for band in self.bands])[:-1])
        images = [band.image(part) for band, part in zip(self.bands, parts, strict=True)]
        if self.bands[0].name is None:
            return images[0]
        return {str(band.name): image for band, image in zip(self.bands, images, strict=True)}

    def minimum(self, positions: Array) -> PointSources:
        """Sources of least Σ (residual/σ)² from these first positions (K, 3) [mm], the brightest first.

        σ is that of the last step. Raises InversionError where the fit does not end with sources inside the tissue.
        """
        settings, damping = self.settings, self.settings.damping
        found = self._fitted(positions, np.concatenate([band.flat_sigma() for band in self.bands]))
        for step in range(settings.steps):
            self._share = step / settings.steps
            found = self._weighted(found, self._sigma(found))
            slopes = self._slopes(found)
            residual = (self.power - found.signal) / found.sigma
            normal, right = slopes.T @ slopes, slopes.T @ residual
            if right @ np.linalg.solve(normal, right) < settings.chi2:
                return found.sorted()
            while True:
                damped = normal + damping * np.diag(np.diag(normal))
                moved = np.linalg.solve(damped, right)[: found.positions.size].reshape(-1, 3)
                tried = self._tried(found.positions + moved, found.sigma)
                if tried is not None and tried.cost < found.cost:
                    break
                damping *= 10
                if damping > settings.stuck:
                    raise self._endless(found)
            found, damping = tried, max(damping / 10, 1e-12)
        raise self._endless(found)

    def covariance(self, found: PointSources) -> Array:
        """(4K, 4K) of x, y, z [mm] and power [W] of each source in turn (Eq. M.26).

        Raises InversionError where the images do not determine the sources separately.
        """
        slopes = self._slopes(found)
        lengths = np.linalg.norm(slopes, axis=0)
        singular = np.linalg.svd(slopes / lengths, compute_uv=False)
        count = len(found.powers)
        if singular[-1] < self.settings.apart * singular[0]:
            raise InversionError(
                f"locate: the images do not determine {count} sources separately (condition number "
                f"{singular[0] / max(singular[-1], 1e-300):.3g}). Give fewer."
            )
        # A factor common to all images changes the powers alone.
        factor = np.concatenate([np.zeros(3 * count), self.gain_error * found.powers])
        covariance = np.linalg.inv(slopes.T @ slopes) + np.outer(factor, factor)
        order = np.column_stack([np.arange(3 * count).reshape(count, 3), 3 * count + np.arange(count)]).ravel()
        return np.asarray(covariance[np.ix_(order, order)])

    def _fitted(self, positions: Array, sigma: Array) -> PointSources:
        """Sources at these positions with the powers >= 0 that fit best; raises FluxError as `BandImages.exitance`."""
        exitance, columns = self._images(positions)
        return self._weighted(PointSources(positions, np.zeros(len(positions)), exitance, columns, sigma, 0.0), sigma)

    def _tried(self, positions: Array, sigma: Array) -> PointSources | None:
        """The same; None where the tissue has no solution for these positions."""
        try:
            return self._fitted(positions, sigma)
        except FluxError:
            return None

    def _weighted(self, found: PointSources, sigma: Array) -> PointSources:
        """The same positions with the powers >= 0 that fit best for another noise (N,) [W]."""
        powers, length = nnls(found.columns / sigma[:, None], self.power / sigma)
        return replace(found, powers=powers, sigma=sigma, cost=length**2)

    def _sigma(self, found: PointSources) -> Array:
        """Noise of the pixels (N,) [W] for the fitted signal, with the numerical error of the matrices (Eq. M.24)."""
        each = zip(self.bands, found.exitance, strict=True)
        return np.concatenate([band.sigma(exitance @ found.powers) for band, exitance in each])

    def _slopes(self, found: PointSources) -> Array:
        """(N, 4K) slopes of the fitted power over σ: with all coordinates, then with all powers."""
        length = self.settings.step * self.edge
        slopes = []
        for position, power, column in zip(found.positions, found.powers, found.columns.T, strict=True):
            if not power > 0:
                raise InversionError(
                    f"locate: {len(found.powers)} sources are too many, one gets no power. Give fewer."
                )
            slopes += [power * self._slope(position, length * axis, column) / length for axis in np.eye(3)]
        return np.column_stack([*slopes, *found.columns.T]) / found.sigma[:, None]

    def _slope(self, position: Array, way: Array, column: Array) -> Array:
        """Change (N,) of a source's image along a way, backwards where the tissue ends."""
        try:
            return self._images((position + way)[None])[1][:, 0] - column
        except FluxError:
            return column - self._images((position - way)[None])[1][:, 0]

    def _images(self, positions: Array) -> tuple[tuple[Array, ...], Array]:
        """Of sources of 1 W at the positions (K, 3): J_n of each band (V, K) [1/mm²], and their columns (N, K)."""
        self._report("fit", self._share)
        exitance = tuple(np.column_stack([band.exitance(position) for position in positions]) for band in self.bands)
        return exitance, np.concatenate(
            [band.transport @ values for band, values in zip(self.bands, exitance, strict=True)]
        )

    def _endless(self, found: PointSources) -> InversionError:
        shown = "; ".join(f"({', '.join(f'{x:.4g}' for x in position)})" for position in found.positions)
        return InversionError(
            f"locate: the fit does not end with sources inside the tissue; the last positions are {shown} mm. Give "
            f"fewer sources, or, near the border, a mesh edge below {self.edge:.3g} mm."
        )
