"""Least squares of `calibrate`: parameters, their covariance, and what the images do not determine.

    σ_i² = P_i/k + σ_other² + e_i² (Eq. M.24, P the fitted image),   C = (Jᵀ J)⁻¹ + g² b bᵀ,   J = ∂(P/σ)/∂p

with b = (Jᵀ J)⁻¹ Jᵀ P/σ, the change of the parameters by a common factor of the powers, and g its uncertainty: Eq. M.26
of docs/model.md. What noise that views have in common adds to C is in `common_noise`. J comes from differences to both
sides where the fit starts and where it ends, and from the images of the search between (Broyden, Math. Comp. 19, 577
(1965)), each of which a slope would cost two of for each parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import ExitanceError, InversionError, OpticsError, SceneError
from .common_noise import beyond_independent
from .damped_steps import DampedSteps, LinearFit
from .measurement import Chi2, Noise

Array = NDArray[np.float64]
Images = Callable[[Array], tuple[Array, Array]]
REFUSALS = (ExitanceError, OpticsError, SceneError)  # of values for which there is no image, such as f_number = -1


@dataclass(frozen=True)
class CalibrationSettings:
    """Accuracy of `calibrate`.

    rtol : of the integrals; None: a tenth of the median noise over the brightest pixel, in `rtols`
    rtols : least and largest rtol that the noise chooses
    change : of the image by a step of the differences, root mean square over that of the image, for an rtol of
        1e-4, and in proportion to rtol^½. The slopes are then right to about 0.5 %, half of it from the images and
        half from the step; at an rtol of 1e-3 to 3 %.
    chi2 : change of Σ (residual/σ)² at which the fit ends: 1e-2 leaves parameters within 0.1 of their sd
    nearby : steps of the differences within which slopes are taken again; they then belong to an image that differs by
        less than half of `change`
    steps : most steps of the fit
    reach : of its first step, in steps of the differences: 20 of them change an image by a tenth
    condition : of the Jacobian with columns of length 1, above which parameters count as not determined separately: the
        combination that is least determined then has a standard deviation so many times that of each parameter alone
    doubtful : share of its slope by which a combination's slope may change with a doubled step. Above it the standard
        deviation of this combination would be wrong by as much, and it counts as not determined.
    """

    rtol: float | None = None
    rtols: tuple[float, float] = (1e-4, 1e-3)
    change: float = 5e-3
    chi2: float = 1e-2
    nearby: float = 0.5
    steps: int = 40
    reach: float = 20.0
    condition: float = 1e3
    doubtful: float = 0.3

    def for_noise(self, noise: float) -> CalibrationSettings:
        """The same with the rtol for images with this median `noise` over their brightest pixel, and its `change`."""
        rtol = float(np.clip(0.1 * noise, *self.rtols)) if self.rtol is None else self.rtol
        return replace(self, rtol=rtol, change=self.change * (rtol / 1e-4) ** 0.5)


class UndeterminedError(InversionError):
    """Parameters that the images do not determine separately.

    condition : number of the Jacobian with columns of length 1
    combinations : one dict for each combination that stays free, name → share in units of that parameter's own sd
    """

    def __init__(self, names: tuple[str, ...], condition: float, directions: Array) -> None:
        self.condition = condition
        self.combinations = [{n: float(s) for n, s in zip(names, v, strict=True)} for v in directions]
        texts = [" ".join(f"{share:+.2f} {name}" for name, share in one.items()) for one in self.combinations]
        super().__init__(
            f"calibrate: the images do not determine {', '.join(names)} separately (condition number {condition:.3g}): "
            f"{'; '.join(texts)}, each in units of its own standard deviation, is free. Fix one of them, or add views."
        )


@dataclass(frozen=True, eq=False)
class Measured:
    """Pixels of all views (views, h, w): power [W], their noise, and which ones count.

    gain_error : relative standard deviation of a factor common to all pixels
    """

    power: Array
    noise: Noise
    used: NDArray[np.bool_]
    gain_error: float

    def sigma(self, signal: Array, numerical: Array) -> Array:
        """Standard deviation of the pixels [W], for a fitted signal (Eq. M.24, M.27); 1 where they do not count.

        A pixel has at least the shot noise of one electron.
        """
        variance = np.maximum(self.noise.variance(signal, self.used), self.noise.shot**2) + numerical**2
        return np.where(self.used, np.sqrt(variance), 1.0)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Values (p,), covariance (p, p), Σ (residual/σ)², what the noise makes of it, and condition number."""

    values: Array
    covariance: Array
    chi2_sum: float
    noise: Chi2
    condition: float


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes [W] of the images by y, (views, h, w, p), at `y` (p,), where the images are `power`.

    measured : they are differences to both sides at `y`, not the secants of a search
    """

    y: Array
    power: Array
    slopes: Array
    measured: bool

    def at(self, y: Array, power: Array) -> Slopes:
        """The slopes that give the images at both places and differ from these least (Broyden's update)."""
        step = y - self.y
        missing = (power - self.power - self.slopes @ step) / (step @ step)
        return Slopes(y.copy(), power, self.slopes + missing[..., None] * step, False)


class CalibrationFit:
    """Fit of parameters `names` to what was `measured`.

    images : values (p,) → power and numerical error, (views, h, w) [W]; raises one of `REFUSALS` for values without
    start : (p,) values

    Inside, y (p,) are the distances from the start in units of the steps of the differences.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        start: Array,
        measured: Measured,
        images: Images,
        settings: CalibrationSettings,
    ) -> None:
        self.names, self.start, self.measured, self.settings = names, start, measured, settings
        self._images = images
        self._steps = np.ones(len(start))
        self._kept = Slopes(np.full(len(start), np.inf), np.empty(0), np.empty(0), False)  # of no place
        self._refusal: Exception | None = None  # of a step from the present values to some without an image

    def solved(self) -> Fitted:
        """Minimum of Σ (residual/σ)², with σ of its own image."""
        self._steps = self._chosen_steps(self._images(self.start)[0])
        self._require_determined(np.zeros(len(self.start)))
        y = self._minimum()
        image, sigma = self._weighted(y)
        slopes, condition = self._require_determined(y)
        used = self.measured.used
        residual = ((image - self.measured.power) / sigma)[used]
        noise = self.measured.noise.chi2(image, sigma, used)
        inverse = np.linalg.inv(slopes.T @ slopes)
        factor = inverse @ (slopes.T @ (image / sigma)[used])  # Eq. M.26
        covariance = inverse + self.measured.gain_error**2 * np.outer(factor, factor)
        covariance += beyond_independent(
            self.measured.noise.common(image, used), slopes @ inverse / sigma[used][:, None]
        )
        scale = np.outer(self._steps, self._steps)
        return Fitted(self._values(y), covariance * scale, float(residual @ residual), noise, condition)

    def _values(self, y: Array) -> Array:
        return self.start + self._steps * y

    def _weighted(self, y: Array) -> tuple[Array, Array]:
        """Images at y [W] and the standard deviations of the pixels by them [W], (views, h, w)."""
        image, numerical = self._images(self._values(y))
        return image, self.measured.sigma(image, numerical)

    def _minimum(self) -> Array:
        """y (p,) of the minimum; slopes are then measured there or nearby.

        Of a fall of Σ (residual/σ)² below the fit's end the errors of the images would be the larger part. Steps to
        values without an image are made shorter; where no other leads on, the error of these values is raised.
        """
        y, damped = np.zeros(len(self.start)), DampedSteps(self.settings.chi2, longest=self.settings.reach)
        for _ in range(self.settings.steps):
            image, sigma = self._weighted(y)
            residual, self._refusal = self._residual(image, sigma), None
            linear = LinearFit.of(self._whitened(sigma), residual)
            nearer = damped.lower(linear, partial(self._nearer, y, sigma, float(residual @ residual)))
            if nearer is not None:
                y = nearer
                self._follow(y)
            elif self._are_measured(y):
                if self._refusal is not None:
                    raise self._refusal
                return y
            else:
                self._measure(y)
        shown = ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.names, self._values(y), strict=True))
        raise InversionError(
            f"calibrate: the fit has not ended after {self.settings.steps} steps, at {shown}. Start nearer, with other "
            "<default> values."
        )

    def _nearer(self, y: Array, sigma: Array, before: float, step: Array) -> Array | None:
        """y + step if there is an image and its Σ (residual/σ)² is less than `before`."""
        try:
            image = self._power(y + step)
        except REFUSALS as refusal:
            self._refusal = refusal
            return None
        return y + step if np.sum(self._residual(image, sigma) ** 2) < before else None

    def _residual(self, image: Array, sigma: Array) -> Array:
        """(pixels that count,) measured − fitted power, in standard deviations."""
        return np.asarray(((self.measured.power - image) / sigma)[self.measured.used])

    def _power(self, y: Array) -> Array:
        return self._images(self._values(y))[0]

    def _are_measured(self, y: Array) -> bool:
        """True where the slopes that are kept are differences to both sides at y or nearby."""
        return self._kept.measured and self._is_near(y)

    def _is_near(self, y: Array) -> bool:
        """True where y is so near the place of the slopes that are kept that these are taken again."""
        return bool(np.abs(self._kept.y - y).max() <= self.settings.nearby)

    def _follow(self, y: Array) -> None:
        """Slopes at y after a step: by the secant, but after a short step from a secant measured."""
        if not self._is_near(y):
            self._kept = self._kept.at(y, self._power(y))
        elif not self._kept.measured:
            self._measure(y)

    def _measure(self, y: Array) -> None:
        """Slopes by differences a step to both sides of y."""
        slopes = np.stack([self._slope(y, one) for one in np.eye(len(y))], axis=-1)
        self._kept = Slopes(y.copy(), self._power(y), slopes, True)

    def _whitened(self, sigma: Array) -> Array:
        """(pixels that count, p) slopes of the fitted power: those that are kept, in standard deviations."""
        return (self._kept.slopes / sigma[..., None])[self.measured.used]

    def _slope(self, y: Array, way: Array, length: float = 1.0) -> Array:
        """Change of the images [W] along a way, by a difference to both sides; to one where the other has no image."""
        try:
            ahead, span = self._power(y + length * way), length
        except REFUSALS:
            ahead, span = self._power(y), 0.0
        try:
            behind, span = self._power(y - length * way), span + length
        except REFUSALS:
            if span == 0:
                raise
            behind = self._power(y)
        return (ahead - behind) / span

    def _chosen_steps(self, first: Array) -> Array:
        """Step of each parameter that changes the image by `CalibrationSettings.change`, to a factor of 3."""
        used, goal = self.measured.used, self.settings.change
        light = np.linalg.norm(first[used])
        if not light > 0:
            raise InversionError(
                "calibrate: the scene's image is dark where the measured ones are not masked. Check both."
            )
        steps = np.empty(len(self.start))
        for k, (name, value) in enumerate(zip(self.names, self.start, strict=True)):
            step, change = 3e-3 * (abs(value) or 1.0), 0.0
            while step < 100 * max(abs(value), 10.0):
                moved = self.start + step * (np.arange(len(self.start)) == k)
                change = float(np.linalg.norm((self._images(moved)[0] - first)[used]) / light)
                if goal / 3 <= change <= 3 * goal:
                    break
                step *= float(np.clip(goal / max(change, 1e-300), 0.02, 30))
            if change < goal / 30:
                raise InversionError(f"calibrate: no pixel depends on '{name}'. Leave it out of 'free'.")
            steps[k] = step
        return steps

    def _require_determined(self, y: Array) -> tuple[Array, float]:
        """Slopes and condition number of the Jacobian; UndeterminedError with the combinations that stay free."""
        if not self._are_measured(y):
            self._measure(y)
        sigma = self._weighted(y)[1]
        slopes = self._whitened(sigma)
        lengths = np.linalg.norm(slopes, axis=0)
        for name, length in zip(self.names, lengths, strict=True):
            if not length > 0:
                raise InversionError(f"calibrate: no pixel depends on '{name}'. Leave it out of 'free'.")
        _, singular, directions = np.linalg.svd(slopes / lengths, full_matrices=False)
        condition = float(singular[0] / max(singular[-1], 1e-300))
        free = singular * self.settings.condition < singular[0]
        if not free.any() and len(self.names) > 1:
            way = directions[-1] / lengths
            way /= np.abs(way).max()
            one = slopes @ way
            two = (self._slope(y, way, 2.0) / sigma)[self.measured.used]
            free[-1] = np.linalg.norm(two - one) > self.settings.doubtful * np.linalg.norm(one)
        if free.any():
            raise UndeterminedError(self.names, condition, directions[free])
        return slopes, condition
