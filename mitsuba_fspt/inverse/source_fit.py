"""Least squares over the positions and powers of sources: Levenberg and Marquardt, with SP3 or diffusion.

Sources are points, or spheres of given radii (see `extent`). Positions and powers >= 0 minimise Σ (residual/σ)² with
the variances of Eq. M.24; their covariance is that of Eq. M.26, J the slopes with positions and powers. The powers of
given positions follow from linear least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.sparse import block_diag, csr_array, hstack
from scipy.stats import chi2

from ..optics.media import Source
from ..optics.shapes import Sphere
from ..runtime.errors import FluxError, InversionError
from ..runtime.numbers import number
from ..runtime.progress_bar import Progress
from .band_images import BandImages, of_each
from .common_noise import CommonNoise, beyond_independent, joined, squared_correlations
from .damped_steps import DampedSteps, LinearFit
from .measurement import Chi2
from .patterns import Patterns, Seen, views_of
from .sensitivity_picture import view_labels
from .source_grid import SourceGrid
from .structure import Structure, common_errors, structure
from .view_factors import PixelNoise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocationSettings:
    """Accuracy of the fit.

    chi2 : fall of Σ (residual/σ)² by a step at which the fit ends: 1e-2 leaves parameters within 0.1 of their sd
    step : of the differences for slopes, over the edge of the tetrahedra; the slopes are right to about 1 %
    steps : most accepted steps
    flat, patience : fall of Σ (residual/σ)² below which a step counts as one along a valley, and steps in a row after
        which the fit ends there: the images do not determine the place along it, which the intervals and p-values say;
        steps that only the border of the tissue shortens lead to no minimum inside
    model_error : factor of the stated error of SP3 or diffusion (Eq. M.51); 0: images made with the same equation
    chance : p-value of a source above which a warning says that noise alone may look like it
    stuck : no step is tried of which Σ (residual/σ)² would fall by less than this share of `chi2`: the minimum is at
        the border, or beyond
    apart : least singular value of the slopes with columns of length 1, over the largest; below it sources count as not
        determined separately
    """

    chi2: float = 1e-2
    step: float = 0.01
    steps: int = 40
    flat: float = 0.5
    patience: int = 3
    model_error: float = 1.0
    chance: float = 1e-3
    stuck: float = 1e-2
    apart: float = 1e-3

    def __post_init__(self) -> None:
        """InversionError where `model_error` is no factor."""
        factor = number("locate: 'model_error'", self.model_error, InversionError, "1")
        if not 0 <= factor < np.inf:
            raise InversionError(
                f"locate: 'model_error' must be >= 0 and finite, got {factor:g}. Give 1, or 0 for none."
            )


@dataclass(frozen=True, eq=False)
class PointSources:
    """Sources and their images: positions (K, 3) [mm], powers (K,) [W] and radii (K,) [mm], 0 for points.

    exitance : of each band, (V, K) J_n per watt of each source [1/mm²]
    columns : (N, K) power on the pixels of all bands per watt;  gradients : (N, K, 3) its change per mm of x, y, z
    noise : of the pixels, with the factors of views;  cost : Σ of squares of the residual over it
    """

    positions: Array
    powers: Array
    radii: Array
    exitance: tuple[Array, ...]
    columns: Array
    gradients: Array
    noise: PixelNoise
    cost: float

    @property
    def sigma(self) -> Array:
        """(N,) standard deviation of the pixels without the factors of views [W]."""
        return self.noise.sigma

    @property
    def unlikelihood(self) -> float:
        """-2 ln of the likelihood for normal noise, but for a constant: also compares fits with different σ."""
        return self.cost + self.noise.log_determinant

    @property
    def values(self) -> Array:
        """(4K,) x, y, z [mm] and power [W] of each source in turn."""
        return np.column_stack([self.positions, self.powers]).ravel()

    @property
    def signal(self) -> Array:
        """(N,) fitted power [W]."""
        return np.asarray(self.columns @ self.powers)

    @property
    def changes(self) -> Array:
        """(N, 4K) change of the fitted power [W] with the `values`."""
        changes = np.concatenate([self.powers[:, None] * self.gradients, self.columns[..., None]], axis=2)
        return changes.reshape(len(changes), -1)

    @property
    def slopes(self) -> Array:
        """(N, 4K) change of the fitted power over the noise with the `values`."""
        return self.noise.over(self.changes)

    def residual(self, power: Array) -> Array:
        """(N,) power − fitted power, over the noise, for the measured power (N,) [W]."""
        return self.noise.over(power - self.signal)

    @property
    def sources(self) -> list[Source]:
        """The sources of the tissue; those without power are left out."""
        each = zip(self.positions.tolist(), self.radii.tolist(), self.powers.tolist(), strict=True)
        return [Source(Sphere((x, y, z), radius), power) for (x, y, z), radius, power in each if power > 0]

    def sorted(self) -> PointSources:
        """The same, the source of the largest power first."""
        order = np.argsort(-self.powers, kind="stable")
        return replace(
            self,
            positions=self.positions[order],
            powers=self.powers[order],
            radii=self.radii[order],
            exitance=tuple(values[:, order] for values in self.exitance),
            columns=self.columns[:, order],
            gradients=self.gradients[:, order],
        )


class SourceFit:
    """Fit of point sources to the images of all bands, their pixels one after the other, (N,)."""

    def __init__(
        self,
        bands: Sequence[BandImages],
        settings: LocationSettings,
        report: Progress,
        gain_per_view: float = 0.0,
        band_correlation: float = 0.0,
    ) -> None:
        self.bands, self.settings, self.gain_per_view = list(bands), settings, gain_per_view
        self._correlation = band_correlation
        self._report, self._share = report, 0.0  # of the steps that are done
        self.power = np.concatenate([band.power for band in bands])
        ends = np.cumsum([0, *(len(band.rows) for band in bands)])
        self.parts = [slice(*part) for part in pairwise(ends)]  # of each band
        # Uncertain coefficients (see OpticsFit): change of the pixels per standard deviation (N, P) [W], and what their
        # present values have of it (N,) [W], which counts as if it were measured in addition.
        self.uncertain, self.offset = np.empty((len(self.power), 0)), np.zeros(len(self.power))
        first = np.cumsum([0, *(band.matrix.image_shape[0] for band in bands)])
        self.view = np.concatenate([band.view + start for band, start in zip(bands, first, strict=False)])

    def factors(self, found: PointSources) -> Array:
        """(views,) most likely factors of the views, of all bands one after the other."""
        count = len(found.noise.squares)
        return 1 + self.gain_per_view * self.common(found)[:count] if self.gain_per_view else np.ones(count)

    def common(self, found: PointSources) -> Array:
        """Most likely unknowns of variance 1: of the views, if they have factors, and of the uncertain coefficients."""
        return found.noise.all_unknowns((self._target - found.signal) / found.sigma)

    @property
    def _target(self) -> Array:
        """(N,) power that sources and what is uncertain make [W]."""
        return self.power + self.offset

    def joint_covariance(self, found: PointSources) -> Array:
        """Covariance of the `values`, the views' factors and the uncertain coefficients, over their prior sd."""
        slopes = np.column_stack([found.changes / found.sigma[:, None], found.noise.all_columns])
        prior = np.repeat([0.0, 1.0], [found.changes.shape[1], found.noise.all_columns.shape[1]])
        return np.asarray(np.linalg.inv(slopes.T @ slopes + np.diag(prior)))

    def joint_sd(self, found: PointSources) -> Array:
        """Standard deviations in the order of `joint_covariance`, with the errors of the equation itself (Eq. M.51) and
        noise that images have in common.
        """
        covariance = self.joint_covariance(found)
        slopes = np.column_stack([found.changes / found.sigma[:, None], found.noise.all_columns])
        estimate = slopes @ covariance / found.sigma[:, None]
        change = estimate.T @ self.model_errors(found)
        extra = beyond_independent(self.in_common(found), estimate)
        return np.sqrt(np.diag(covariance + extra) + (change**2).sum(axis=1))

    def fitted(self, found: PointSources) -> Array:
        """(N,) fitted power [W], with the factors of the views and the coefficients as fitted."""
        fitted = found.signal * self.factors(found)[self.view] - self.offset
        if found.noise.others is not None:
            others = found.noise.others
            fitted += found.sigma * (others @ self.common(found)[-others.shape[1] :])
        return np.asarray(fitted)

    def noise(self, found: PointSources) -> list[Chi2]:
        """Σ (noise/σ)² of each band as its stated noise makes it, and what noise in common to bands adds."""
        each, sigma = list(zip(self.bands, self.parts, strict=True)), found.sigma
        own = [b.measurement.chi2(b.rows, found.signal[part], sigma[part]) for b, part in each]
        if len(each) == 1:
            return own
        parts = [b.measurement.common(b.rows, found.signal[part]) for b, part in each]
        alone = sum(squared_correlations(one, sigma[part]) for one, (_, part) in zip(parts, each, strict=True))
        return [*own, Chi2(0.0, 2 * (squared_correlations(joined(parts), sigma) - alone))]

    def structure(self, found: PointSources) -> Structure:
        """Test of the residuals for structure: over views, around sources, by coefficients of the tissue."""
        views, known, tissue = list[Seen](), [], list[tuple[str, str, Array]]()
        light = found.columns * found.powers / found.sigma[:, None]
        by_model = self.model_errors(found) / found.sigma[:, None]
        by_bands = of_each(lambda band: band.slopes(found.sources), self.bands)
        for band, own, exitance, by_tissue in zip(self.bands, self.parts, found.exitance, by_bands, strict=True):
            fitted = band.measurement.as_images(band.rows, found.signal[own])[0]
            names = [label if band.name is None else f"{band.name}: {label}" for label in view_labels(band.matrix)]
            seen = views_of(names, fitted, band.rows, found.sigma[own])
            numerical = band.numerical(exitance @ found.powers) / found.sigma[own]
            known.append(hstack([common_errors(numerical, seen), csr_array(by_model[own])]))
            views += seen
            where = "the tissue" if band.name is None else f"band {band.name}"
            for kind, change in by_tissue.items():
                slope = np.zeros_like(found.signal)
                slope[own] = change / found.sigma[own]
                tissue.append((kind, where, slope))
        places = np.concatenate([band.points for band in self.bands])
        rings = [(light[:, k], np.linalg.norm(places - at, axis=1)) for k, at in enumerate(found.positions)]
        slopes = np.column_stack([found.changes / found.sigma[:, None], found.noise.all_columns])
        inverse = self.joint_covariance(found)
        errors = csr_array(block_diag(known, format="csr"))
        residual = (self.power - self.fitted(found)) / found.sigma
        patterns, parts = Patterns.of(views, rings, tissue), self.in_common(found)
        return structure(residual, slopes, lambda x: inverse @ x, patterns, errors, None, parts, found.sigma)

    def images(self, values: Array) -> Array | dict[str, Array]:
        """Values (N,) of the pixels as images, (views, height, width); by the names of the bands where they have names.

        NaN on pixels that are masked or do not see the surface.
        """
        images = [band.image(values[own]) for band, own in zip(self.bands, self.parts, strict=True)]
        if self.bands[0].name is None:
            return images[0]
        return {str(band.name): image for band, image in zip(self.bands, images, strict=True)}

    def best(self, grid: SourceGrid, count: int) -> PointSources:
        """The most likely of the minima from several sets of first positions, the brightest source first.

        The sets are those of the grid for flat noise and for the noise of the first minimum. Raises InversionError
        where no fit ends with sources inside the tissue.
        """
        starts, found, failed = grid.positions(count), list[PointSources](), None
        tried = set[frozenset[tuple[float, ...]]]()
        while starts:
            start = starts.pop(0)
            if (places := frozenset(map(tuple, start.tolist()))) in tried:
                continue
            tried.add(places)
            try:
                found.append(self.minimum(start))
            except InversionError as error:
                failed = error
            else:
                if len(found) == 1 and (self.p_values(found[0], len(grid.inner)) <= self.settings.chance).all():
                    starts += replace(grid, sigma=found[0].sigma).positions(count)
        if failed and not found:
            raise failed
        return min(found, key=lambda one: one.unlikelihood).sorted()

    def minimum(self, positions: Array, radii: Array | None = None) -> PointSources:
        """Sources of least Σ (residual/σ)² from these first positions; σ is that of the last step.

        radii : (K,) of spheres [mm]; points if not given
        """
        settings, damped = self.settings, DampedSteps(self.settings.stuck * self.settings.chi2)
        even = np.concatenate([band.flat_sigma() for band in self.bands])
        radii = np.zeros(len(positions)) if radii is None else radii
        found, _ = self._tried(positions, radii, PixelNoise(even, np.zeros_like(even), self.view), np.inf)
        flat, border = 0, False
        for step in range(settings.steps):
            if found is None or (flat == settings.patience and border):
                break
            positions, self._share = found.positions, step / settings.steps
            found = self._weighted(found, self._noise(found))
            if not (found.powers > 0).all():  # no image tells the position of a source without power
                break
            linear = LinearFit.of(found.slopes, found.residual(self._target))
            if flat == settings.patience or linear.fall < settings.chi2:
                return found
            inside = list[bool]()  # of each attempt
            tried = damped.lower(linear, partial(self._moved, found, inside))
            flat = flat + 1 if tried is not None and found.cost - tried.cost < settings.flat else 0
            found, border = tried, not all(inside)
        shown = "; ".join(f"({', '.join(f'{x:.4g}' for x in position)})" for position in positions)
        raise InversionError(
            f"locate: the fit does not end with sources inside the tissue; the last positions are {shown} mm. Give "
            "fewer sources, or, for a source near the border, 'edge' in [mesh] of the phantom file shorter than its "
            "depth."
        )

    def covariance(self, found: PointSources) -> Array:
        """(4K, 4K) of the `values` by the images, for the radii: inverse of JᵀJ (Eq. M.26), with common factors (M.49).

        Raises InversionError where the images do not determine the sources separately.
        """
        slopes = found.slopes
        lengths = np.linalg.norm(slopes, axis=0)
        singular = np.linalg.svd(slopes / lengths, compute_uv=False)
        if singular[-1] < self.settings.apart * singular[0]:
            raise InversionError(
                f"locate: the images do not determine {len(found.powers)} sources separately (condition number "
                f"{singular[0] / max(singular[-1], 1e-300):.3g}). Give fewer."
            )
        return np.asarray(np.linalg.inv(slopes.T @ slopes))

    def by_model(self, found: PointSources, covariance: Array) -> Array:
        """(4K, 4K) covariance of the `values` by the errors of the equation itself (Eq. M.51).

        But for what is near creases, the fit does not weigh pixels by them: they are not known well enough to take the
        source from what they leave.
        """
        change = covariance @ (found.slopes.T @ found.noise.over(self.model_errors(found)))
        return np.asarray(change @ change.T)

    def in_common(self, found: PointSources) -> list[CommonNoise]:
        """Noise of the pixels that images, of all bands, have in common."""
        each = zip(self.bands, self.parts, strict=True)
        return joined([band.measurement.common(band.rows, found.signal[own]) for band, own in each])

    def by_common(self, found: PointSources, covariance: Array) -> Array:
        """(4K, 4K) covariance of the `values` by common noise of images, beyond that of as much noise without.

        The fit weighs pixels as independent ones.
        """
        return beyond_independent(self.in_common(found), found.noise.from_pixels(found.slopes @ covariance))

    def p_values(self, found: PointSources, places: int, numbers: int = 4) -> Array:
        """(K,) probability, at most, that noise alone makes a source fit as well as each of these.

        At each of `places` positions a source that is not there lowers Σ (residual/σ)² by chi-squared of as many
        degrees of freedom as it has `numbers`, with the other sources free, and the factors of their light and the
        coefficients with their prior; Bonferroni's bound over the positions.
        """
        values = np.empty(len(found.powers))
        for k in range(len(values)):
            others = replace(found, powers=np.where(np.arange(len(values)) == k, 0.0, found.powers))
            noise = self._noise_of(others, found.sigma)  # factors and coefficients alone make no light
            own = slice(4 * k, 4 * k + 4)
            changes = np.column_stack([np.delete(found.changes, own, axis=1), found.changes[:, own]])
            directions = np.linalg.qr(noise.over(changes))[0][:, -4:]  # what this source adds to the others
            effect = directions.T @ noise.over(self._target - others.signal)
            spread = np.eye(4) + beyond_independent(self.in_common(others), noise.from_pixels(directions))
            values[k] = places * chi2.sf(effect @ np.linalg.solve(spread, effect), numbers)
        return values.clip(max=1.0)

    def is_linear(self, found: PointSources, covariance: Array, z: float) -> bool:
        """True if Σ (residual/σ)² rises as for a linear model along the direction that the images determine least.

        At both points z standard deviations away, with the other directions at their minimum, it must rise by z²/2 to
        2 z²: the length of a normal interval is then wrong by less than the root of 2.
        """
        scale, slopes = np.sqrt(np.diag(covariance)), found.slopes
        weakest = scale * np.linalg.eigh(covariance / np.outer(scale, scale))[1][:, -1]
        weakest *= z / np.linalg.norm(slopes @ weakest)
        along = slopes @ weakest / z
        others = np.linalg.svd(slopes * scale - np.outer(along, along @ slopes * scale), full_matrices=False)[0][:, :-1]
        for sign in (1, -1):
            try:
                residual = self._residual_at(found, found.values + sign * weakest)
            except FluxError:  # beyond the border
                return False
            residual -= others @ (others.T @ residual)
            if not 0.5 < (residual @ residual - found.cost) / z**2 < 2:
                return False
        return True

    def _residual_at(self, found: PointSources, values: Array) -> Array:
        """(N,) residual over the σ of `found` for other `values` (4K,); raises FluxError as `BandImages.exitance`."""
        positions, powers = values.reshape(-1, 4)[:, :3], values.reshape(-1, 4)[:, 3]
        return found.noise.over(self._target - self._images(positions, found.radii)[1] @ powers)

    def _moved(self, found: PointSources, inside: list[bool], step: Array) -> PointSources | None:
        """Sources a step (4K,) of the `values` on, if they fit better; `inside` gets whether they are in the tissue."""
        positions = found.positions + step.reshape(-1, 4)[:, :3]
        tried, is_inside = self._tried(positions, found.radii, found.noise, found.cost)
        inside.append(is_inside)
        return tried

    def _tried(
        self, positions: Array, radii: Array, noise: PixelNoise, below: float
    ) -> tuple[PointSources | None, bool]:
        """Sources at these positions with the powers > 0 that fit best; False where the tissue has no solution there.

        The sources are None then, and where one gets no power or Σ (residual/σ)² is not below `below`.
        """
        try:
            exitance, columns = self._images(positions, radii)
            empty = PointSources(positions, np.zeros(len(positions)), radii, exitance, columns, np.empty(0), noise, 0.0)
            tried = self._weighted(empty, noise)
            if not ((tried.powers > 0).all() and tried.cost < below):
                return None, True
            return replace(tried, gradients=np.stack([*map(self._gradient, positions, radii)], axis=1)), True
        except FluxError:
            return None, False

    def _weighted(self, found: PointSources, noise: PixelNoise) -> PointSources:
        """The same positions with the powers >= 0 that fit best for another noise."""
        powers, length = nnls(noise.over(found.columns), noise.over(self._target))
        return replace(found, powers=powers, noise=noise, cost=length**2)

    def _noise(self, found: PointSources) -> PixelNoise:
        """Noise of the pixels for the fitted signal, with the numerical error of the matrices (Eq. M.24) and the error
        of the equation near creases (Eq. M.51).
        """
        each = zip(self.bands, found.exitance, strict=True)
        sigma = np.concatenate([band.sigma(exitance @ found.powers) for band, exitance in each])
        if self.settings.model_error:
            crease = np.concatenate([band.crease_error for band in self.bands])
            sigma = np.hypot(sigma, self.settings.model_error * crease * found.signal)
        return self._noise_of(found, sigma)

    def _noise_of(self, found: PointSources, sigma: Array) -> PixelNoise:
        """Noise with this σ and what factors and coefficients change of the light of `found`; of no light, nothing."""
        uncertain = self.uncertain if found.powers.any() else self.uncertain[:, :0]
        others = np.column_stack([self._by_factors(found), uncertain]) / sigma[:, None]
        return PixelNoise(sigma, self.gain_per_view * found.signal / sigma, self.view, others if others.size else None)

    def _by_factors(self, found: PointSources) -> Array:
        """(N, E) change of the pixels [W] by one standard deviation of the factors of the bands, `gain_error`.

        A factor is √ρ c + √(1 − ρ) e with the correlation ρ of the bands, c common to all and e of the band.
        """
        own = np.zeros((len(self.power), len(self.bands)))
        for k, (band, part) in enumerate(zip(self.bands, self.parts, strict=True)):
            own[part, k] = band.measurement.gain_error * found.signal[part]
        if not own.any():
            return own[:, :0]
        return np.column_stack([(1 - self._correlation) ** 0.5 * own, self._correlation**0.5 * own.sum(axis=1)])

    def model_errors(self, found: PointSources) -> Array:
        """(N, E) change of the pixels [W] by one standard deviation of the errors of the equation itself (Eq. M.51).

        Half of their variance is common to all bands, half of each band.
        """
        if not self.settings.model_error:
            return np.empty((len(self.power), 0))
        columns, count = list[Array](), len(self.bands)
        for k, power in enumerate(found.powers):
            errors = [band.model_error(found.positions[k], float(found.radii[k])) for band in self.bands]
            common = np.zeros((len(self.power), errors[0].shape[1]))
            for relative, part in zip(errors, self.parts, strict=True):
                common[part] = self.settings.model_error * power * found.columns[part, k, None] * relative
                if count > 1:
                    own = np.zeros_like(common)
                    own[part] = 0.5**0.5 * common[part]
                    columns.append(own)
            columns.append(common if count == 1 else 0.5**0.5 * common)
        return np.column_stack(columns)

    def _gradient(self, position: Array, radius: float) -> Array:
        """(N, 3) change of a source's image per mm along x, y and z; raises FluxError at the border."""
        step = self.settings.step * self.bands[0].tissue.mesh.edge
        return np.concatenate(of_each(lambda band: band.transport @ band.gradient(position, radius, step), self.bands))

    def _images(self, positions: Array, radii: Array) -> tuple[tuple[Array, ...], Array]:
        """Of sources of 1 W at the positions (K, 3): J_n of each band (V, K) [1/mm²], and their columns (N, K)."""
        self._report("fit", self._share)
        exitance = tuple(of_each(lambda band: np.column_stack([*map(band.exitance, positions, radii)]), self.bands))
        return exitance, np.concatenate(
            [band.transport @ values for band, values in zip(self.bands, exitance, strict=True)]
        )
