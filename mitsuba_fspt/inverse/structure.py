"""Structure in the residuals of a fit: patterns that noise does not make, though χ² over all pixels does not show them.

Let the rows of B be the slopes of the fitted pixels over σ with the unknowns, A the Hessian (BᵀB, and the penalty's),
K = B A⁻¹ Bᵀ. Residuals over σ have the covariance I − K, and patterns Z the scores s = Zᵀr with

    C = Zᵀ(I − K)Z + Σ_u [Zᵀ(I − K)u] [Zᵀ(I − K)u]ᵀ,   E s = Zᵀ(I − K)Z a

for known common errors u and patterns a: Eq. M.34 of docs/model.md. Noise with the correlations X that images have in
common adds Zᵀ(I − K)X(I − K)Z to C (Eq. M.55).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import csr_array
from scipy.special import gammaln
from scipy.stats import chi2

from .common_noise import CommonNoise
from .patterns import Pattern, Patterns, Seen

Array = NDArray[np.float64]
Columns: TypeAlias = csr_array | Array
CHUNK = 1 << 16  # pixels at a time
TISSUE = (
    "optical coefficients (state mua_sd, musp_sd), an extended source (give shape sphere), or a depth at which SP3 or "
    "diffusion does not hold"
)
HINTS = {
    "factor": "exposure and filter of the view, or give gain_per_view",
    "background": "background and read-out offset",
    "gradient": "flat field, vignetting and exit law",
    "shift": "pose",
    "scale": "distance, magnification and focus",
    "smooth": "shape, exit law, absorbers and light that the model leaves out",
    "ring": TISSUE,
    "absorption": TISSUE,
    "scattering": TISSUE,
}


@dataclass(frozen=True)
class StructureSettings:
    """Thresholds of the test.

    chance : probability of a false alarm by noise, of all patterns together, and of the most likely one
    noise : least share of a direction's variance that is noise of the images. The rest is variance of J_n
        that the penalty smooths away; in directions with more of it, the test would be one of the prior
    rougher : variance of J_n in a direction, over that of the prior. The weight is a mean over all roughness
        (Eq. M.25); where few features of J_n have most of it, each has many times its share
    least : least share of its variance that a direction keeps where noise in common cancels
    absorbed : least share of a direction that the fit leaves in the residuals; below it rounding counts
    named : most causes that are named
    shown : least share of the squared length of a cause that the residuals show. What the fit absorbs but for less, as
        factors of views with `gain_per_view`, would get any size, and is no cause
    """

    chance: float = 1e-4
    noise: float = 0.5
    rougher: float = 25.0
    least: float = 0.01
    absorbed: float = 1e-3
    named: int = 3
    shown: float = 1e-2


@dataclass(frozen=True)
class Cause:
    """A pattern found: its kind, where, size with its sd in units of the kind, and ln of the probability by noise."""

    kind: str
    where: str
    size: tuple[float, ...]
    sd: tuple[float, ...]
    log_p: float

    def text(self) -> str:
        """The cause in words, with its size."""
        one, sd = self.size[0], self.sd[0]
        match self.kind:
            case "factor":
                return f"a factor in {self.where}, {1 + one:.4g} ± {sd:.1g}"
            case "background":
                return f"a background in {self.where}, {one:.2g} ± {sd:.1g} W a pixel"
            case "gradient":
                return (
                    f"a gradient in {self.where}, {100 * one:+.2g} % to the right and {100 * self.size[1]:+.2g} % down"
                )
            case "shift":
                return f"a shift of {self.where}, {-one:+.2g} pixels to the right and {-self.size[1]:+.2g} down"
            case "scale":
                return f"a scale of {self.where}, {1 - one:.5g} ± {sd:.1g}"
            case "absorption" | "scattering":
                return f"other coefficients of {self.where}, as {self.kind} {1 + one:.3g} ± {sd:.1g} times as large"
            case "ring":
                return f"a ring around {self.where}"
        return f"a smooth pattern over {self.where}"


@dataclass(frozen=True)
class Structure:
    """Result: Σ z² over the `directions` tested, ln of its probability by noise, and the causes by likelihood."""

    chi2_sum: float
    directions: int
    log_p: float
    causes: tuple[Cause, ...]

    def lines(self) -> list[str]:
        """The warning in one line; none where noise explains the residuals."""
        if not self.causes:
            return []
        shown = "; ".join(cause.text() for cause in self.causes)
        checks = ", ".join(dict.fromkeys(HINTS[cause.kind] for cause in self.causes))
        exponent = min(self.log_p, *(cause.log_p for cause in self.causes)) / np.log(10)
        return [
            f"the residuals have structure that noise does not make (p 1e{exponent:.0f}): {shown}. Intervals do not "
            f"contain it. Check {checks}."
        ]


def common_errors(numerical: Array, views: Sequence[Seen]) -> csr_array:
    """(N, views) numerical errors over σ, each of one sign over its view.

    numerical : (N,) over σ, one view after the other
    """
    view = np.repeat(np.arange(len(views)), [len(one.rows) for one in views])
    return csr_array((numerical, (np.arange(len(view)), view)), shape=(len(view), len(views)))


def structure(
    residual: Array,
    slopes: Columns,
    solve: Callable[[Array], Array],
    patterns: Patterns,
    known: Columns,
    settings: StructureSettings | None = None,
    parts: Sequence[CommonNoise] = (),
    sigma: Array | None = None,
) -> Structure:
    """Test of the residuals (N,) over σ, the most likely causes first.

    slopes : (N, m) of the fitted pixels over σ with the unknowns;  solve : A⁻¹ of (m, k)
    known : (N, k) standard deviations over σ of errors that many pixels have in common, contained in the intervals
    parts : of the noise that images have in common, with sigma (N,), σ [W]
    """
    settings = settings or StructureSettings()
    z = patterns.columns
    down = _dense(z.T @ slopes).T
    lift = solve(down)
    cross = _dense(z.T @ z)
    mean = cross - down.T @ lift  # Zᵀ(I − K)Z
    fitted = sum(part.T @ part for part in (slopes[k : k + CHUNK] @ lift for k in range(0, len(residual), CHUNK)))
    noise = mean - down.T @ lift + fitted  # Zᵀ(I − K)²Z
    common = _dense(z.T @ known) - lift.T @ _dense(slopes.T @ known)
    kept = _directions(cross, mean, noise, settings)
    smoothed = (settings.rougher - 1) * (mean - noise)
    covariance = kept.T @ (mean + smoothed + common @ common.T) @ kept
    shared = [part for part in parts if part.is_shared]
    if kept.size and sigma is not None and shared:
        covariance = _with(covariance, kept.T @ _by_noise_in_common(z, slopes, lift, shared, sigma) @ kept, settings)
    white = kept @ np.linalg.inv(np.linalg.cholesky(covariance)).T if kept.size else kept
    score = white.T @ (z.T @ residual)
    effect = white.T @ mean * patterns.lengths
    causes = [one for one in patterns.causes if _share(effect, patterns.lengths, one) > settings.shown]
    total, count = float(score @ score), len(score)
    log_p = _ln_tail(total, count) if count else 0.0
    return Structure(total, count, log_p, tuple(_causes(score, effect, causes, log_p, settings)))


def _by_noise_in_common(
    z: csr_array, slopes: Columns, lift: Array, parts: Sequence[CommonNoise], sigma: Array
) -> Array:
    """(p, p) Zᵀ(I − K)X(I − K)Z with the correlations X of different pixels."""
    extra = np.zeros((z.shape[1], z.shape[1]))
    for part in parts:
        share = part.deviation / sigma
        groups = csr_array((share, (part.shared, np.arange(len(share)))))
        sums = (
            _dense(groups @ z) - (groups @ slopes) @ lift
        )  # with many vertices, slopes are too large as a dense array
        extra += sums.T @ sums
        for k in range(0, len(share), CHUNK):
            own = slice(k, k + CHUNK)
            left = share[own, None] * (_dense(z[own]) - _dense(slopes[own] @ lift))
            extra -= left.T @ left
    return extra


def _with(covariance: Array, extra: Array, settings: StructureSettings) -> Array:
    """Sum of a covariance and of what noise in common adds, of which each direction keeps a share `least`."""
    values, vectors = eigh(extra, covariance)
    back = covariance @ vectors
    return np.asarray(covariance + back * np.maximum(values, settings.least - 1) @ back.T)


def _share(effect: Array, lengths: Array, cause: Pattern) -> float:
    """Largest share of a cause's squared length, over its unknowns, that the scores show."""
    columns = cause.columns.reshape(len(cause.columns), -1)
    shown = np.linalg.norm(effect[:, columns].sum(axis=2), axis=0) ** 2
    return float(np.max(shown / np.maximum((lengths[columns] ** 2).sum(axis=1), 1e-300), initial=0.0))


def _dense(matrix: Columns) -> Array:
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())


def _directions(cross: Array, mean: Array, noise: Array, settings: StructureSettings) -> Array:
    """(p, k) combinations of patterns that the fit leaves in the residuals, and whose variance is mostly noise."""
    values, vectors = np.linalg.eigh(cross)
    sound = vectors[:, values > 1e-8 * values.max()] / np.sqrt(values[values > 1e-8 * values.max()])
    left, turned = np.linalg.eigh(sound.T @ mean @ sound)
    sound = sound @ turned[:, left > settings.absorbed]
    if not sound.size:
        return sound
    share, turned = eigh(sound.T @ noise @ sound, sound.T @ mean @ sound)
    return np.asarray(sound @ turned[:, share > settings.noise])


def _causes(
    score: Array, effect: Array, patterns: Sequence[Pattern], log_p: float, settings: StructureSettings
) -> list[Cause]:
    """Causes one after the other: each time the one that explains what is left least likely by chance."""
    effects = [
        effect[:, one.columns] if one.columns.ndim == 1 else effect[:, one.columns].sum(axis=2) for one in patterns
    ]
    found, taken, level = list[int](), np.empty((len(score), 0)), np.log(settings.chance)
    best_log = list[float]()
    while patterns and len(found) < settings.named:
        left = score - taken @ (taken.T @ score)
        chances = [_chance(left, own - taken @ (taken.T @ own), own) for own in effects]
        best = int(np.argmin(chances))
        likely = chances[best] + np.log(len(patterns))
        if likely > level and (found or log_p > level):
            break
        if best in found or chances[best] >= 0:
            break
        found.append(best)
        best_log.append(float(min(likely, 0.0)))
        taken = _span(np.concatenate([effects[k] for k in found], axis=1))
    joint = np.concatenate([effects[k] for k in found], axis=1) if found else np.empty((len(score), 0))
    # Of length 1: the effect of a background of 1 W a pixel is so long that `pinv` would leave out all others.
    lengths = np.linalg.norm(joint, axis=0).clip(1e-300)
    fitted = np.linalg.pinv(joint / lengths) / lengths[:, None]
    # Not from the inverse of the normal equations, whose diagonal rounding makes negative where effects nearly depend.
    size, sd, causes, first = fitted @ score, np.linalg.norm(fitted, axis=1), list[Cause](), 0
    for k, log in zip(found, best_log, strict=True):
        own = slice(first, first := first + effects[k].shape[1])
        causes.append(Cause(patterns[k].kind, patterns[k].where, tuple(size[own]), tuple(sd[own]), log))
    return causes


def _span(columns: Array) -> Array:
    """Orthonormal basis of the columns, those of a length below 1e-6 of the longest left out."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(lengths > 0, lengths, 1.0)
    basis, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(basis[:, singular > 1e-6 * singular.max(initial=1e-300)])


def _chance(left: Array, beside: Array, own: Array) -> float:
    """ln of the probability that noise fits as well as a pattern with these effects `beside` those found."""
    fresh = np.linalg.norm(beside, axis=0) > 1e-3 * np.linalg.norm(own, axis=0).clip(1e-300)
    if not fresh.any():
        return 0.0
    basis = _span(beside[:, fresh])
    return _ln_tail(float(np.sum((basis.T @ left) ** 2)), basis.shape[1])


def _ln_tail(total: float, count: int) -> float:
    """ln of the probability that chi-squared of `count` degrees of freedom exceeds `total`, also where that is 0 in
    double precision: Γ(a, t) ≈ tᵃ e⁻ᵗ/(t + 1 − a) with a = count/2, t = total/2, to a share of a/t².
    """
    found = float(chi2.logsf(total, count))
    if np.isfinite(found):
        return found
    a, t = count / 2, total / 2
    return float(a * np.log(t) - t - np.log(t + 1 - a) - gammaln(a))
