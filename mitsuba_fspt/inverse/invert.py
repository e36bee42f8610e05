"""`invert`: the surface flux density J_n from images of several views, with intervals.

The power on pixel i is T J, its noise normal with the variance of Eq. M.24 or M.27 of docs/model.md, taken from the
fitted signal. J >= 0 minimises half of χ² and the penalty of Eq. M.23. Samples are such minima for data and penalty
with noise added (randomise then optimise: J. M. Bardsley et al., SIAM J. Sci. Comput. 36, A1895, 2014).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import block_diag, csr_array, diags_array, hstack

from ..images.exposure import Exposure
from ..images.image import Image
from ..runtime.errors import InversionError
from ..runtime.progress_bar import Progress, reported
from .fit_settings import Settings
from .fit_warnings import fit_warnings, tell_unconverged
from .inversion import Inversion
from .invert_options import Options, require_matrix
from .kept_factor import KeptFactor
from .measurement import Measurement
from .mesh_error import MeshError
from .mlem import mlem
from .multipliers import Minima
from .nonnegative import Accuracy, Solve, minimise
from .outlook import is_hopeless
from .seen_area import seen_share
from .smoothness import Prior, Smoothness
from .surface import CREASE_ANGLE, Surface
from .transport_matrix import TransportMatrix
from .view_factors import ViewFactors
from .weight_search import secant

Array = NDArray[np.float64]
MOST = 0.5  # of the area of a vertex: with less of it seen, J_n there says little about its power


def invert(
    matrix: TransportMatrix,
    images: ArrayLike | Sequence[Image | Exposure | str | os.PathLike[str]] | Image | Exposure | os.PathLike[str],
    /,
    *,
    error: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    weight: float | None = None,
    prior: Prior | None = None,
    gain_error: float | None = None,
    gain_per_view: float = 0.0,
    sampled: bool = False,
    samples: int = 0,
    seed: int = 0,
    confidence: float = 0.9,
    method: str = "smooth",
    crease_angle: float = CREASE_ANGLE,
    scene: object = None,
    progress: Progress | None = None,
    settings: Settings | None = None,
) -> Inversion:
    """Surface flux density J_n >= 0 [W/mm²] that fits the images of all views of a transport matrix, with intervals.

        R = fspt.invert(T, images, samples=200, seed=1)

    Parameters
    ----------
    matrix : of `transport` or `read_transport`
    images : one Image, Exposure or file of either per view, in their order; or powers (views, h, w) [W] with `error`
    error : standard error of the power [W], a number or (views, h, w); None: the noise stated by the images
    mask : (views, h, w), True for pixels to leave out, in addition to those that the images mask
    weight : of the penalty on roughness [mm²], >= 0; None: the weight that agrees with the roughness found (Eq. M.25)
    prior : mean, reference and correlation length of the penalty; None: roughness relative to J_n itself is penalised
    gain_error : relative uncertainty of a factor common to all pixels, in [0, 1); None: that of the images, else 0
    gain_per_view : relative standard deviation of a factor of each view, fitted with J_n (Eq. M.35), in [0, 1); 0: none
    sampled : True for images of a Monte Carlo, whose variance is then a smooth function of the fitted signal (Eq. M.27)
        and whose errors may be 0; images whose metadata name `passes` are taken so by themselves
    samples, seed : random draws for the intervals, 0 for none or 2/(1 − confidence) − 1 or more; their seed, 0 … 2⁵³
    method : 'smooth', with the penalty; or 'mlem', maximum likelihood without penalty and intervals (Eq. M.28)
    crease_angle : [degree], 0 … 180: J_n is not smoothed across edges of a larger one, such as a rim; 180: across all
    scene : scene with the meshes of the matrix, where its own cannot be read any more
    progress : function of the present step (text) and the share done (0 … 1); None: a bar in notebooks
    confidence, settings : of the intervals, in (0, 1); accuracy of the fit

    Raises
    ------
    InversionError : an option outside its range, images without light, without an error or with all pixels masked,
        fewer pixels than J_n needs without a penalty, meshes that are not those of the matrix.
    TransportError, DetectorError : images that do not fit the matrix, counts without their detector's numbers.
    ImageError : a file of an image cannot be read.
    """
    require_matrix(matrix)
    options = Options(weight, samples, seed, confidence, method, crease_angle, gain_per_view, prior)
    measurement = Measurement.of(matrix, images, error, mask, gain_error, sampled)
    surface = replace(Surface.of(matrix, scene), crease_angle=options.crease_angle)
    settings, prior = settings or Settings(), prior or Prior()
    problem = Problem.of(measurement.matrix, measurement, surface, prior, settings, options.gain_per_view)
    with reported(progress) as report:
        found = problem.solved(options, report)
    return found


@dataclass(frozen=True, eq=False)
class Fit:
    """State of the fit: x = J_n/reference (m,) and unknowns of factors, σ (N,) [W], weight, determined unknowns γ.

    correction : (N,) [W], added to the data: what variances of the fitted signal take from it (Eq. M.29)
    converged : False where variances or weight still changed in the last round
    """

    x: Array
    sigma: Array
    numerical: Array
    correction: Array
    weight: float
    determined: float
    decrement: float
    converged: bool = True


@dataclass(frozen=True, eq=False)
class Problem:
    """Data and penalty on the unknowns x = J_n/reference, over the pixels that see the surface and are not masked.

    rows : numbers of these pixels;  transport : (N, m) [W], the power of x = 1
    sensitivity : (points,) of the mesh to these pixels [mm²]
    bounded : (m,) unknowns that some pixel sees: J_n >= 0 holds there, the others only continue them
    factors : of the views, unknowns after those of J_n
    kept : factor of the last `normal`
    """

    matrix: TransportMatrix
    surface: Surface
    measurement: Measurement
    rows: NDArray[np.int64]
    transport: csr_array
    sensitivity: Array
    bounded: NDArray[np.bool_]
    smoothness: Smoothness
    reference: float
    prior: Prior
    settings: Settings
    factors: ViewFactors
    kept: KeptFactor = field(default_factory=KeptFactor)

    @classmethod
    def of(
        cls,
        matrix: TransportMatrix,
        measurement: Measurement,
        surface: Surface,
        prior: Prior,
        settings: Settings,
        gain_per_view: float = 0.0,
    ) -> Problem:
        rows = np.flatnonzero((np.diff(matrix.matrix.indptr) > 0) & ~measurement.mask)
        if not len(rows):
            raise InversionError("invert: all pixels that see the surface are masked. Expose for a shorter time.")
        columns = csr_array(matrix.matrix[rows])
        sensitivity = np.bincount(surface.number, columns.sum(axis=0), surface.points).astype(np.float64)
        part = csr_array(columns @ surface.spread)
        light = float(measurement.power[rows].sum())
        reference = prior.reference or light / float(part.sum())
        if not reference > 0:
            raise InversionError(
                f"invert: the pixels that see the surface hold {light:.3g} W in total, no light. Check the images, "
                "their background and the order of the views."
            )
        smooth = Smoothness.of(surface, prior.correlation_length)
        part = csr_array(part * reference)
        bounded = part.sum(axis=0) > 0
        views, height, width = matrix.image_shape
        own = reference, prior, settings, ViewFactors(gain_per_view, rows // (height * width), views)
        return cls(matrix, surface, measurement, rows, part, sensitivity, bounded, smooth, *own)

    def signal(self, x: Array) -> Array:
        """(N,) power on the pixels [W], with the factors of the views."""
        count = self.surface.unknowns
        return np.asarray((self.transport @ x[:count]) * self.factors.of(x[count:])[self.factors.view])

    def design(self, x: Array) -> csr_array:
        """(N, m + factors) slopes of the power [W] with J_n, and with the factors of the views at x."""
        if not self.factors.count:
            return self.transport
        columns = self.factors.columns(self.transport @ x[: self.surface.unknowns])
        return csr_array(hstack([self.transport, columns], format="csr"))

    @property
    def bounds(self) -> NDArray[np.bool_]:
        """(m + factors,) unknowns that are >= 0."""
        return np.concatenate([self.bounded, np.zeros(self.factors.count, bool)])

    def solved(self, options: Options, report: Progress) -> Inversion:
        """Fit and draws, with more unknowns where the data determine too many of them."""
        if options.method == "mlem":
            none = np.empty((self.surface.unknowns + self.factors.views, 0))
            return self.result(self.most_likely(report), none, options)
        if options.weight == 0:
            self._require_pixels()
        whole, levels = self, self.surface.coarser() if options.weight != 0 else [self.surface]
        if is_hopeless(self, levels, self.settings.hopeless, report):
            rounds = min(self.settings.rounds, self.settings.hopeless.rounds)
            whole, levels = replace(self, settings=replace(self.settings, rounds=rounds)), levels[-2:]
        elif self.surface.unknowns <= self.settings.unknowns:
            levels = [self.surface]
        while len(levels) > 1 and levels[-2].unknowns <= self.settings.unknowns:
            levels.pop()
        problem, coarse = whole._with(levels[-1]), None
        while True:
            problem, first, fit = problem.fitted(options, report, coarse)
            levels.pop()
            if not levels or not fit.converged or problem.surface.unknowns >= self.settings.resolved * fit.determined:
                break
            coarse = problem.surface, first, fit
            problem = whole._with(levels[-1])
        draws = problem.draws(fit, options.samples, options.seed, report)
        tell_unconverged(fit, problem.settings.rounds)
        return problem.result(fit, draws, options)

    def _carried(self, x: Array, coarse: Surface) -> Array:
        """Unknowns of a fit on a coarser surface as those of this problem."""
        return np.concatenate([self.surface.carried(x[: coarse.unknowns], coarse), x[coarse.unknowns :]])

    def free_on(self, surface: Surface) -> Problem:
        """The same problem with other unknowns, none of which is bounded."""
        found = self._with(surface)
        return replace(found, bounded=np.zeros_like(found.bounded))

    def _with(self, surface: Surface) -> Problem:
        """The same problem with other unknowns."""
        if surface is self.surface:
            return self
        return Problem.of(self.matrix, self.measurement, surface, self.prior, self.settings, self.factors.sd)

    def fitted(
        self, options: Options, report: Progress, coarse: tuple[Surface, Fit, Fit] | None = None
    ) -> tuple[Problem, Fit, Fit]:
        """The problem with its penalty, relative to a first fit unless the prior has a reference; that fit; the fit.

        The first fit has no bounds: where its J_n is small or negative, the penalty is relative to the least ρ.
        `coarse`: surface, first fit and fit with fewer unknowns, from which this one goes on.
        """
        start = first = None
        if coarse is not None:
            first, start = (replace(one, x=self._carried(one.x, coarse[0])) for one in coarse[1:])
        problem = self
        if options.weight != 0 and self.prior.reference is None:
            if first is None:
                first = self.free_on(self.surface).fit(None, report, rough=True)
            problem = self.relative_to(first.x)
        fit = problem.fit(options.weight, report, start or first, again=start is not None)
        return problem, first or fit, fit

    def _require_pixels(self) -> None:
        """Raise InversionError where fewer pixels than unknowns leave J_n undetermined without a penalty."""
        if (unknowns := int(self.bounded.sum())) > len(self.rows):
            raise InversionError(
                f"invert: 'weight' = 0 with {len(self.rows)} pixels for {unknowns} unknowns determines nothing. Give "
                "more views or pixels, a coarser mesh, or a weight > 0."
            )

    @property
    def mean(self) -> float:
        """Mean of the prior over the reference."""
        return self.prior.mean / self.reference

    def relative_to(self, x: Array) -> Problem:
        """The same problem with a penalty relative to a first fit x: ρ = J_n, at least a share of the reference."""
        light = np.maximum(x[: self.surface.unknowns], self.settings.darkest)
        relative = np.where(self.bounded, light, 1.0)
        return replace(self, smoothness=Smoothness.of(self.surface, self.prior.correlation_length, relative))

    def fit(
        self,
        weight: float | None,
        report: Progress,
        start: Fit | None = None,
        rough: bool = False,
        again: bool = False,
    ) -> Fit:
        """Minimum with variances from its own signal and, where `weight` is None, the weight of Eq. M.25.

        The weight is a fixed point, whose logarithm is sought by secants, from that of `start` if `again`.
        """
        power = self.measurement.power[self.rows]
        numerical = np.zeros_like(power)
        # A start that no bright or dark pixel leads astray: the same noise on all of them.
        sigma = self._sigma(np.full_like(power, np.maximum(power, 0).mean()), numerical)
        x = np.concatenate([np.ones(self.surface.unknowns), np.zeros(self.factors.count)])
        state = Fit(x, sigma, numerical, 0 * numerical, weight or 0.0, np.nan, np.nan)
        if start is not None:
            state = replace(start, weight=state.weight)
        if weight is None:
            state = replace(state, weight=start.weight if start and again else self._first_weight(sigma))
        probes = np.random.default_rng(1).choice([-1.0, 1.0], (len(self.rows), self.settings.probes))
        looser = self.settings.rough if rough else 1.0
        converged, tried = False, list[tuple[float, float]]()
        rounds = min(self.settings.roughly, self.settings.rounds) if rough else self.settings.rounds
        for turn in range(rounds):
            report("fit", turn / rounds)
            before, state = state, self._improved(state, probes, weight, self.settings.drawn)
            state = replace(state, sigma=self._averaged(before.sigma, state.sigma, turn))
            drift = float(np.sqrt(np.mean((state.sigma / before.sigma - 1) ** 2)))
            changed = abs(np.log(state.weight / before.weight)) if weight is None else 0.0
            converged = bool(drift < looser * self.settings.reweighted and changed < looser * self.settings.weight)
            if converged:
                break
            if weight is None:
                tried = [*tried[-1:], (float(np.log(before.weight)), float(np.log(state.weight)))]
                state = replace(state, weight=float(np.exp(secant(tried))))
        if not rough and state.decrement > self.settings.accuracy.decrement:
            state = self._improved(state, probes, weight, self.settings.accuracy)
        return replace(state, converged=converged)

    def _averaged(self, before: Array, sigma: Array, turn: int) -> Array:
        """σ (N,) for the next round: of images of a Monte Carlo, after some rounds, the mean variance of the rounds.

        Their variance changes by steps where a pixel changes its group (Eq. M.27): without the mean it may never end.
        """
        sampled = self.measurement.noise.sampled[self.factors.view]
        count = turn - self.settings.averaged
        if count < 1 or not sampled.any():
            return sigma
        mean = np.sqrt((count * before**2 + sigma**2) / (count + 1))
        return np.where(sampled, mean, sigma)

    def most_likely(self, report: Progress) -> Fit:
        """Maximum of the likelihood without a penalty."""
        shot = self.measurement.shot[self.rows]
        if not (shot > 0).all():
            raise InversionError(
                "invert: method 'mlem' needs electrons, not watts with error=. Give images of 'fspt reduce'."
            )
        power = self.measurement.power[self.rows]
        light, x, gap = 0 * power, np.zeros(0), np.inf
        for _ in range(self.settings.responses if np.any(self.measurement.noise.relative) else 1):
            background = self.measurement.background(self.rows, light)
            x, gap = mlem(self.transport, power, 1 / shot, background, self.settings.mlem, lambda s: report("fit", s))
            light = self.signal(x)  # of which the error of the pixels' response is a share
        numerical = self._numerical(x)
        return Fit(x, self._sigma(self.signal(x), numerical), numerical, 0 * numerical, 0.0, 0.0, 2 * gap)

    def _improved(self, state: Fit, probes: Array, weight: float | None, accuracy: Accuracy) -> Fit:
        """Minimum for the variances and the weight of `state`, then its own variances, and its own weight for None."""
        design, count = self.design(state.x), self.surface.unknowns
        normal, solve = self.normal(design, state.sigma, state.weight)
        right = self._right(design, self.measurement.power[self.rows] + state.correction, state.sigma, state.weight)
        start = Minima(normal, solve, self.bounds, self.settings.columns).near(right[:, None], state.x)
        found = minimise(normal, right[:, None], start, self.bounds, solve, accuracy)
        x = found.x[:, 0]
        determined, correction = self._fitted_noise(design, solve, state, probes)
        if weight is None:  # Eq. M.25, of J_n
            rough = max(self.smoothness.energy(x[:count] - self.mean), 1e-300)
            weight = max(determined - self._determined_factors(solve), 1e-3 * determined) / rough
        numerical = self._numerical(x)
        sigma = self._sigma(self.signal(x), numerical)
        return Fit(x, sigma, numerical, correction, weight, determined, float(found.decrement[0]))

    def _first_weight(self, sigma: Array) -> float:
        """Weight to begin with: above the one at which data and penalty have the same trace, where few J_n are 0."""
        trace = float((self.transport.multiply((1 / sigma)[:, None]) ** 2).sum())
        return max(self.settings.first * trace / float(self.smoothness.matrix.diagonal().sum()), 1e-300)

    def _determined_factors(self, solve: Solve) -> float:
        """Number of factors of views that the data determine: their count less the trace of their covariance."""
        count, own = self.factors.count, np.arange(self.factors.count)
        if not count:
            return 0.0
        unit = np.zeros((self.surface.unknowns + count, count))
        unit[self.surface.unknowns + own, own] = 1
        return count - float(np.trace(solve(unit)[self.surface.unknowns :]))

    def _fitted_noise(self, design: csr_array, solve: Solve, state: Fit, probes: Array) -> tuple[float, Array]:
        """γ, the number of unknowns that the data determine, and the correction of the data (N,) [W] (Eq. M.25, M.29).

        Both are of K = σ⁻¹ T (H + w Q)⁻¹ Tᵀ σ⁻¹, the change of the fitted pixels with the measured ones: γ = tr K, by
        random vectors `probes` (N, k). A pixel that is too bright by chance has too large a fitted signal, too large a
        variance, and counts less; the correction is the power that it loses so.
        """
        sigma = state.sigma[:, None]
        found = (design @ solve(design.T @ (probes / sigma))) / sigma
        count = probes.shape[1]
        share = np.einsum("nk,nk->n", found, probes - found) / count
        slope = self.measurement.slope(self.rows, self.signal(state.x))
        return float(np.einsum("nk,nk->", probes, found) / count), slope * share

    def normal(self, design: csr_array, sigma: Array, weight: float, exact: bool = False) -> tuple[csr_array, Solve]:
        """H + w Q with H = TᵀT/σ², and what solves it: `exact` for many solutions, which steps would take longer."""
        normal = self.hessian(design, sigma, weight)
        return normal, self.kept.solve(normal, sigma, weight, (design, self.smoothness), exact)

    def hessian(self, design: csr_array, sigma: Array, weight: float) -> csr_array:
        """H + w Q with H = TᵀT/σ², T the design, and the unit variance of the factors of views."""
        scaled = csr_array(diags_array(1 / sigma) @ design)
        prior = block_diag([weight * self.smoothness.matrix, diags_array(np.ones(self.factors.count))], format="csr")
        normal = csr_array(scaled.T @ scaled + prior)
        if weight == 0:
            ridge = 1e-12 * normal.diagonal().max()
            normal = csr_array(normal + ridge * diags_array(np.ones(normal.shape[0])))
        return normal

    def _right(self, design: csr_array, power: Array, sigma: Array, weight: float) -> Array:
        """Tᵀ P/σ² + w Q mean for power (N,) or (N, k), T the design."""
        over = power / sigma**2 if power.ndim == 1 else power / sigma[:, None] ** 2
        flat = weight * self.mean * (self.smoothness.matrix @ np.ones(self.surface.unknowns))
        flat = np.concatenate([flat, np.zeros(self.factors.count)])
        return design.T @ over + (flat if power.ndim == 1 else flat[:, None])

    def _sigma(self, signal: Array, numerical: Array) -> Array:
        """Standard deviation of each pixel [W] for a fitted signal (Eq. M.24)."""
        return self.measurement.sigma(self.rows, signal, numerical, "invert")

    def _numerical(self, x: Array) -> Array:
        """Numerical error of T J [W] on the pixels."""
        exitance = self.surface.spread @ (x[: self.surface.unknowns] * self.reference)
        return self.matrix.error(exitance).ravel()[self.rows]

    def between(self, x: Array) -> tuple[Array, float]:
        """Power on the pixels (N,) [W] of what J_n linear on faces leaves out, and length of the edges (Eq. M.42)."""
        count = self.surface.unknowns
        error = MeshError.of(self.surface, self.surface.spread @ (x[:count] * self.reference))
        factors = self.factors.of(x[count:])[self.factors.view]
        return np.asarray((self.matrix @ error.columns)[self.rows] * factors), error.edge

    def draws(self, fit: Fit, count: int, seed: int, report: Progress) -> Array:
        """x of `count` random draws, (m, count), followed by the factors of the views, (views, count)."""
        if not count:
            return np.empty((self.surface.unknowns + self.factors.views, 0))
        design = self.design(fit.x)
        normal, solve = self.normal(design, fit.sigma, fit.weight, exact=True)
        minima = Minima(normal, solve, self.bounds, self.settings.columns * count)
        between = self.between(fit.x)[0]
        sizes = [min(self.settings.block, count - k) for k in range(0, count, self.settings.block)]
        seeds = np.random.SeedSequence(seed).spawn(len(sizes))

        def block(size: int, sequence: np.random.SeedSequence) -> Array:
            rng = np.random.default_rng(sequence)
            right, gain = self._drawn(design, fit, between, size, rng)
            found = minimise(normal, right, minima.near(right, fit.x), self.bounds, solve, self.settings.drawn).x
            common = np.exp(self.factors.common * rng.standard_normal(size))
            own = slice(self.surface.unknowns, None)
            return np.concatenate([found[: own.start] * gain * common, self.factors.of(found[own]) / common])

        found = []
        with ThreadPoolExecutor(self.settings.threads) as pool:
            futures = [pool.submit(block, *job) for job in zip(sizes, seeds, strict=True)]
            try:
                for k, future in enumerate(futures):
                    report("samples", k / len(futures))
                    found.append(future.result())
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        return np.concatenate(found, axis=1)

    def _drawn(
        self, design: csr_array, fit: Fit, between: Array, size: int, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Right-hand sides (m + factors, size) with noise on data and priors, and factors of gain (size,).

        The numerical error of a view has one sign: it does not average out over pixels. What J_n linear on faces
        leaves out has one size on the whole surface.
        """
        power = self.measurement.power[self.rows] + fit.correction
        noise = np.sqrt(np.maximum(fit.sigma**2 - fit.numerical**2, 0))
        common = rng.standard_normal((self.factors.views, size))[self.factors.view]
        data = power[:, None] + self.measurement.drawn(self.rows, self.signal(fit.x), noise, size, rng)
        data += fit.numerical[:, None] * common
        data += between[:, None] * rng.standard_normal(size)
        right = self._right(design, data, fit.sigma, fit.weight)
        rough = self.smoothness.root.T @ rng.standard_normal((self.surface.unknowns, size))
        gain = 1 + self.measurement.gain_error * rng.standard_normal(size)
        prior = np.concatenate([np.sqrt(fit.weight) * rough, rng.standard_normal((self.factors.count, size))])
        return right + prior, gain

    def result(self, fit: Fit, draws: Array, options: Options) -> Inversion:
        """What the fit and the draws say, on the columns of the matrix."""
        spread = self.surface.spread * self.reference
        count, views = self.surface.unknowns, self.matrix.image_shape
        solution, factors = spread @ fit.x[:count], self.factors.of(fit.x[count:])
        areas = self.surface.point_areas
        per_area = self.sensitivity / np.where(areas > 0, areas, np.inf)
        lit = per_area >= self.settings.seen * per_area.max()
        seen = lit & (seen_share(self.surface, self.sensitivity, self.settings.seen) >= MOST)
        fitted = (self.matrix @ solution).reshape(views) * factors[:, None, None]
        signal = self.signal(fit.x)
        chi2_sum = float(np.sum(((self.measurement.power[self.rows] - signal) / fit.sigma) ** 2))
        sigma = np.full(self.matrix.shape[0], np.nan)
        sigma[self.rows] = fit.sigma
        warnings, mesh_error = fit_warnings(self, fit, signal, chi2_sum, options.confidence)
        return Inversion(
            matrix=self.matrix,
            surface=self.surface,
            solution=solution,
            draws=np.asarray(spread @ draws[:count]),
            view_factors=factors,
            view_factor_draws=draws[count:],
            seen=seen[self.surface.number] & self.matrix.seen,
            left_out=float(areas[lit & ~seen].sum()),
            confidence=options.confidence,
            weight=fit.weight,
            reference=self.reference,
            determined=fit.determined,
            pixels=len(self.rows),
            decrement=fit.decrement,
            converged=fit.converged,
            gain_error=self.measurement.gain_error,
            gain_per_view=self.factors.sd,
            chi2_sum=chi2_sum,
            mesh_error=mesh_error,
            warnings=tuple(warnings),
            measured=np.where(self.measurement.mask, np.nan, self.measurement.power).reshape(views),
            fitted=fitted,
            sigma=sigma.reshape(views),
        )
