"""Least squares of `calibrate`: parameters, their covariance, and what the images do not determine.

    σ_i² = P_i/k + σ_other² + e_i² (Eq. M.24, P the fitted image),   C = (Jᵀ J)⁻¹ + g² b bᵀ,   J = ∂(P/σ)/∂p

with b = (Jᵀ J)⁻¹ Jᵀ P/σ, the change of the parameters by a common factor of the powers, and g its uncertainty: Eq. M.26
of docs/model.md. What noise that views have in common adds to C is in `common_noise`. J comes from differences to both
sides where the fit starts and where it ends, and from the images of the search between (Broyden, Math. Comp. 19, 577
(1965)), each of which a slope would cost two of for each parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import LONGEST_TEXT, ExitanceError, InversionError, OpticsError, SceneError, one_line
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


@dataclass(frozen=True)
class Border:
    """Border of the values that a scene allows, at which a parameter ended.

    beyond : a value next to it that is refused;  refusal : why
    """

    beyond: float
    refusal: Exception

    @property
    def reason(self) -> str:
        """Why values beyond are refused, without the values of all parameters that the message begins with."""
        text = one_line(self.refusal, LONGEST_TEXT).rstrip(".")
        return text.partition(": ")[2] if text.startswith("calibrate, at ") else text


@dataclass(frozen=True, eq=False)
class Fitted:
    """Values (p,), covariance (p, p), Σ (residual/σ)², what the noise makes of it, and condition number.

    borders : one line for each parameter that ended at a `Border`, where there is no minimum
    """

    values: Array
    covariance: Array
    chi2_sum: float
    noise: Chi2
    condition: float
    borders: tuple[str, ...] = ()


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
        self._refused: tuple[Array, Exception] | None = None  # step from the present values to some without an image
        self._borders: dict[int, Border] = {}  # of the parameters that are held there, by number

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
        beyond = inverse @ (slopes.T @ residual) / np.sqrt(np.diag(covariance))
        borders = self._border_lines(self._values(y), beyond)
        return Fitted(self._values(y), covariance * scale, float(residual @ residual), noise, condition, borders)

    def _border_lines(self, values: Array, beyond: Array) -> tuple[str, ...]:
        """A line for each parameter at its border; `beyond` (p,): distance of the minimum from the values [sd]."""
        return tuple(
            f"'{self.names[k]}' ended at {values[k]:.6g}, the border of the values that the scene allows; at "
            f"{one.beyond:.6g}: {one.reason}. The minimum lies {abs(beyond[k]):.2g} sd beyond, so that value +- sd is "
            "no interval. Check the scene's other numbers and the images, or fix it."
            for k, one in self._borders.items()
            if beyond[k] ** 2 > self.settings.chi2
        )

    def _values(self, y: Array) -> Array:
        return self.start + self._steps * y

    def _weighted(self, y: Array) -> tuple[Array, Array]:
        """Images at y [W] and the standard deviations of the pixels by them [W], (views, h, w)."""
        image, numerical = self._images(self._values(y))
        return image, self.measured.sigma(image, numerical)

    def _minimum(self) -> Array:
        """y (p,) of the minimum; slopes are then measured there or nearby.

        Of a fall of Σ (residual/σ)² below the fit's end the errors of the images would be the larger part. Steps to
        values without an image are made shorter. Where no other leads on, the parameters that are at their borders are
        held, and the others fitted on.
        """
        y, damped = np.zeros(len(self.start)), DampedSteps(self.settings.chi2, longest=self.settings.reach)
        for _ in range(self.settings.steps):
            image, sigma = self._weighted(y)
            residual, self._refused = self._residual(image, sigma), None
            whitened, free = self._whitened(sigma), [k for k in range(len(y)) if k not in self._borders]
            nearer = None
            if free:
                linear = LinearFit.of(whitened[:, free], residual)
                attempt = partial(self._nearer, y, sigma, float(residual @ residual), free, linear.lengths)
                nearer = damped.lower(linear, attempt)
            if nearer is y or (nearer is None and self._refused is not None and self._are_measured(y)):
                self._hold(y)
            elif nearer is not None:
                y = nearer
                self._follow(y)
            elif not self._are_measured(y):
                self._measure(y)
            elif not self._release(y, whitened, residual):
                return y
        shown = ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.names, self._values(y), strict=True))
        raise InversionError(
            f"calibrate: the fit has not ended after {self.settings.steps} steps, at {shown}. Start nearer, with other "
            "<default> values."
        )

    def _nearer(
        self, y: Array, sigma: Array, before: float, free: list[int], lengths: Array, step: Array
    ) -> Array | None:
        """y and a step of the `free` parameters, if there is an image and its Σ (residual/σ)² is less than `before`.

        y itself where a border is nearer than the fit's end leaves a parameter from its minimum, in standard deviations
        of each alone, 1/`lengths`: shorter steps would only creep on.
        """
        whole = np.zeros(len(y))
        whole[free] = step
        try:
            image = self._power(y + whole)
        except REFUSALS as refusal:
            self._refused = whole, refusal
            return y if np.abs(step * lengths).max() ** 2 <= self.settings.chi2 else None
        return y + whole if np.sum(self._residual(image, sigma) ** 2) < before else None

    def _hold(self, y: Array) -> None:
        """Hold the parameters at their borders: those of which the refused step alone is refused.

        Where none is, the border is one of a combination, and those are held without which the step is not refused; or
        all, if there are none.
        """
        if self._refused is None:
            return
        (step, refusal), found = self._refused, dict[int, Border]()
        beyond, moved = self._values(y + step), [int(k) for k in np.flatnonzero(step)]
        for k in moved:
            if own := self._refusal(y + step * (np.arange(len(y)) == k)):
                found[k] = Border(float(beyond[k]), own)
        together = {k: Border(float(beyond[k]), refusal) for k in moved}
        if not found:
            found = {k: at for k, at in together.items() if not self._refusal(y + step * (np.arange(len(y)) != k))}
        self._borders |= found or together

    def _refusal(self, y: Array) -> Exception | None:
        """Why there is no image at y, None if there is one."""
        try:
            self._power(y)
        except REFUSALS as refusal:
            return refusal
        return None

    def _release(self, y: Array, whitened: Array, residual: Array) -> bool:
        """Release parameters that are held at a border from which Σ (residual/σ)² now falls inwards; True if any is."""
        inwards = list[int]()
        for k, border in self._borders.items():
            pull = float(whitened[:, k] @ residual / np.linalg.norm(whitened[:, k]))
            outwards = np.sign((border.beyond - self._values(y)[k]) / self._steps[k])
            if pull * outwards < 0 and pull**2 > self.settings.chi2:
                inwards.append(k)
        for k in inwards:
            del self._borders[k]
        return bool(inwards)

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
                change = float(np.linalg.norm((self._moved(k, step) - first)[used]) / light)
                if goal / 3 <= change <= 3 * goal:
                    break
                step *= float(np.clip(goal / max(change, 1e-300), 0.02, 30))
            if change < goal / 30:
                raise InversionError(f"calibrate: no pixel depends on '{name}'. Leave it out of 'free'.")
            steps[k] = step
        return steps

    def _moved(self, k: int, step: float) -> Array:
        """Images [W] a step of parameter k from the start, to the other side where one has no image."""
        way = step * (np.arange(len(self.start)) == k)
        try:
            return self._images(self.start + way)[0]
        except REFUSALS:
            return self._images(self.start - way)[0]

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
            with suppress(*REFUSALS):  # of both sides, in a corner between borders
                two = (self._slope(y, way, 2.0) / sigma)[self.measured.used]
                free[-1] = np.linalg.norm(two - one) > self.settings.doubtful * np.linalg.norm(one)
        if free.any():
            raise UndeterminedError(self.names, condition, directions[free])
        return slopes, condition
