"""Test of two images' difference against their errors: Student's t on every pixel, Šidák's correction over them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .image_data import ImageData
from .noise_model import NoiseModel, covariance
from .recorded_number import recorded_number

LEVEL = 0.01  # probability of a false alarm, to which `ZTest.detectable` refers
NOISY = 0.5  # largest bound over standard error of a pixel that counts for chi2: a bias of that size adds 0.25 to it

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class ZTest:
    """Test of the differences in units of their standard error, z = max(|P_cal − P_std| − bound, 0) / s.

    s is the standard error of the difference, √(s_cal² + s_std² − 2 c), with the covariance c of two reduced images: by
    one frame that was subtracted from both, and by the response of the pixels of one detector that both name. The
    `error` of a deterministic image (`method` = integral in its metadata) is no standard deviation: it is the bound of
    that image's error. Any other image's `error` is a standard error; that of a measured image beside the integral is
    taken for the integral's light. If the metadata hold `passes`, s was estimated from the scatter of that number of
    passes, and z follows Student's t with passes − 1 degrees of freedom (for two such images: Welch's number). The
    values of z below are converted to those of a normal distribution with the same probability.

    Attributes
    ----------
    max_z : the largest |z|
    chi2 : mean of z² without the bound, about 1 if the standard errors are right, over the `noisy` pixels; None if
        there are none
    p_value : probability that the smallest of `pixels` independent p_1 is at most the one found, p = 1 − (1 −
        p_1)^pixels (Šidák's correction), p_1 = erfc(|z|/√2); a small value means that the images differ
    pixels : number of pixels with light in either image and a standard error above 0, masked in neither, which are
        tested
    unjudged : number of pixels without a standard error that differ by more than the bound; they are not tested
    noisy : number of the tested pixels whose bound is at most half the standard error
    detectable : smallest difference on the standard's brightest pixel, over its power, for which p < 0.01; None if
        that pixel is not tested
    gain : share by which a measured image with a `gain_error` is brighter than the other on all pixels, most probably;
        the differences are those without it, and the share over its deviation counts for `p_value` like a pixel. None
        without such an image
    """

    max_z: float
    chi2: float | None
    p_value: float
    pixels: int
    unjudged: int
    noisy: int
    detectable: float | None
    gain: float | None = None

    def render_text(self) -> str:
        """The test, the smallest difference that it detects, and the `gain` if there is one: a line each."""
        chi2 = "none   the integral's errors exceed the noise" if self.chi2 is None else f"{self.chi2:.3f}   per pixel"
        test = f"chi2   {chi2}; largest |z| {self.max_z:.2f} of {self.pixels} pixels, p {self.p_value:.2g}"
        if self.detectable is None or self.detectable >= 1:
            power = "none    the errors exceed the brightest pixel; give more samples or a smaller rtol"
        else:
            power = (
                f"{self.detectable:.2e}   smallest difference of the brightest pixel, over its power, for p < {LEVEL}"
            )
        if self.gain is None:
            return f"{test}\npower  {power}"
        return f"{test}\npower  {power}\ngain   {self.gain:+.2%}   by which the measured image is brighter"


def is_deterministic(image: ImageData) -> bool:
    """True if `error` is the integral's estimate, not a standard error."""
    return image.metadata.get("method") == "integral"


def error_bound(*images: ImageData) -> Plane:
    """Sum of the errors [W] of the deterministic images, shape (h, w)."""
    given = [image.error for image in images if image.error is not None and is_deterministic(image)]
    return np.sum([np.zeros(images[0].shape), *given], axis=0, dtype=np.float64)


def brightest(image: ImageData, kept: NDArray[np.bool_]) -> tuple[int, int]:
    """Row and column of the brightest of the pixels `kept` (h, w)."""
    row, column = np.unravel_index(np.where(kept, image.power, -np.inf).argmax(), image.shape)
    return int(row), int(column)


def differences(calculated: ImageData, standard: ImageData) -> Plane:
    """z of every pixel with the sign of P_cal − P_std, shape (h, w); NaN on pixels that are not tested."""
    return _Differences(calculated, standard).signed_z()


def z_test(calculated: ImageData, standard: ImageData) -> ZTest | None:
    """Test of the differences against their errors; None if no pixel with light has a standard error above 0."""
    found = _Differences(calculated, standard)
    tested = found.tested
    if not tested.any():
        return None
    pixels = int(tested.sum())
    z = np.abs(found.signed_z()[tested])
    noisy = tested & (found.bound <= NOISY * found.error)
    whole = np.abs(found.normal(found.difference, found.error))[noisy]
    largest = max(float(z.max(initial=0.0)), abs(found.gain_z))
    p_one, tests = math.erfc(largest / math.sqrt(2)), pixels + (found.gain is not None)
    return ZTest(
        max_z=float(z.max(initial=0.0)),
        chi2=float(np.square(whole).mean()) if whole.size else None,
        # log1p and expm1 keep a p_one far below 1e-16, which 1 − (1 − p_one)^tests would round to 0.
        p_value=abs(math.expm1(tests * math.log1p(-p_one))) if p_one < 1 else 1.0,
        pixels=pixels,
        unjudged=int(np.count_nonzero((found.error == 0) & (found.excess > 0))),
        noisy=int(noisy.sum()),
        detectable=found.detectable(brightest(standard, found.kept), pixels),
        gain=found.gain,
    )


def _standard_error(image: ImageData, other: ImageData) -> Plane | None:
    """Standard error [W] of an image, (h, w): of a measured one beside an exact one that of the exact light.

    The error that a measured image states follows from its own light (Eq. M.24), and is too small where noise made it
    dark.
    """
    if image.error is None:
        return None
    error, model = np.asarray(image.error, np.float64), NoiseModel.of(image)
    if model is None:
        return error
    if is_deterministic(other):
        return np.sqrt(model.variance(other.power.astype(np.float64)))
    exact = np.sqrt(model.variance(image.power.astype(np.float64)))  # of which a file keeps 32 bits
    return np.where(np.isclose(error, exact, rtol=1e-6, atol=0), exact, error)


class _Differences:
    """Difference of two images and its errors, arrays of shape (h, w).

    power : of the standard [W]
    kept : pixels masked in neither image
    difference : P_cal − P_std [W] without `gain`; 0 on masked pixels, like `error`
    gain, gain_z : share by which a measured image is brighter, None where no image has a `gain_error`; that of the
        pixels alone over its standard deviation and `gain_error`
    bound : error of the deterministic images [W]
    excess : max(|difference| − bound, 0) [W]
    common : covariance of the two images [W²], which s² has twice less than the sum of their variances
    error : standard error s of the difference [W]
    freedom : its degrees of freedom, Welch's; infinite where s counts as known
    missed : standard deviation [W] in addition to s, of light that no sample met
    tested : pixels with light in either image and s > 0. A pixel without light in both is not tested: the error of the
        Monte Carlo there is the power of a possible sample
    """

    def __init__(self, calculated: ImageData, standard: ImageData) -> None:
        p_cal, self.power = (image.power.astype(np.float64) for image in (calculated, standard))
        self.kept = calculated.kept & standard.kept
        self.difference = np.where(self.kept, p_cal - self.power, 0)
        self.bound = error_bound(calculated, standard)
        variance, spread = np.zeros(self.power.shape), np.zeros(self.power.shape)
        pairs = ((calculated, standard), (standard, calculated))
        noisy = [(own, _standard_error(own, other)) for own, other in pairs if not is_deterministic(own)]
        self.scale = max([float(np.abs(error).max()) for _, error in noisy if error is not None], default=0.0) or 1.0
        for image, error in noisy:
            if error is None:
                continue
            own = np.square(error / self.scale)  # over their largest: s⁴ must not underflow
            variance += own
            passes = int(recorded_number(image.metadata, "passes", 0))
            spread += own * own / (passes - 1) if passes > 1 else 0.0
        both = len(noisy) == 2 and all(error is not None for _, error in noisy)
        self.common = covariance(calculated, standard, -1) if both else np.zeros(self.power.shape)
        variance = np.maximum(variance - 2 * self.common / self.scale / self.scale, 0)
        self.error = np.where(self.kept, self.scale * np.sqrt(variance), 0)
        self.freedom = np.divide(variance**2, spread, out=np.full_like(spread, np.inf), where=spread > 0)
        self.tested = (self.error > 0) & ((p_cal != 0) | (self.power != 0))
        self.gain_z = 0.0
        self.gain = self._without_gain(calculated, standard)
        self.excess = np.maximum(np.abs(self.difference) - self.bound, 0)
        self.missed = self._missed(calculated, standard)

    def _without_gain(self, calculated: ImageData, standard: ImageData) -> float | None:
        """Take the share by which a measured image is brighter than the other, most probably, out of the difference.

        A share g of the light t, normal about 0 with the deviation δ = `gain_error`, is common to all its pixels. With
        the light b = ± t of the other image in the difference d, Σ (d − g b)²/(s² + bound²) is least for
        g = Σ w b d/Σ w b², whose standard deviation σ follows from the scatter over the pixels; g δ²/(δ² + σ²) is
        returned. The noise n of b adds n² to the mean of b² and c − n² to that of b d, with the covariance c of the two
        images; both are taken out of the sums.
        """
        deviations = [image.gain_error or 0.0 for image in (calculated, standard)]
        deviation = math.hypot(*deviations)
        if not deviation or not self.tested.any():
            return None
        sign, other = (1, standard) if deviations[0] else (-1, calculated)
        light = sign * other.power.astype(np.float64)
        noise = 0.0 if other.error is None or is_deterministic(other) else np.asarray(other.error, np.float64)
        noise = np.broadcast_to(noise, light.shape)
        given = self.difference, light, self.error, self.bound, noise
        d, b, s, bound, own = (of[self.tested] / self.scale for of in given)
        common = self.common[self.tested] / self.scale / self.scale
        weight = 1 / (s * s + bound * bound)
        squares, products = weight * (b * b - own * own), weight * (b * d + own * own - common)
        if not (curvature := float(squares.sum())) > 0:
            return 0.0
        alone = float(products.sum()) / curvature
        variance = float(np.square(products - alone * squares).sum()) / curvature**2
        self.gain_z = alone / math.sqrt(deviation**2 + variance)
        gain = alone * deviation**2 / (deviation**2 + variance)
        self.difference = np.where(self.kept, self.difference - gain * light, 0)
        return gain

    def _missed(self, calculated: ImageData, standard: ImageData) -> Plane:
        """Standard deviation [W] missing in s where Monte Carlo is darker than a deterministic image by d.

        If light arrives in events of power w, the variance of the mean is w (P + d). From the passes of a pixel that
        missed some events it is estimated as w P. w = s²/P is taken as the largest in the 3 × 3 neighbourhood.
        """
        sampled = [image for image in (calculated, standard) if not is_deterministic(image)]
        if len(sampled) != 1 or "passes" not in sampled[0].metadata:
            return np.zeros(self.power.shape)
        power = np.maximum(sampled[0].power.astype(np.float64), 0)
        event = np.divide(self.error, power, out=np.zeros_like(power), where=power > 0) * self.error
        height, width = event.shape
        padded = np.pad(event, 1)
        largest = np.max([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
        darker = self.difference < 0 if sampled[0] is calculated else self.difference > 0
        return np.where(darker, np.sqrt(largest) * np.sqrt(self.excess), 0)

    def signed_z(self) -> Plane:
        """z of the excess with the sign of the difference; NaN where not tested."""
        error = np.hypot(self.error, self.missed)
        return np.where(self.tested, np.copysign(self.normal(self.excess, error), self.difference), np.nan)

    def normal(self, excess: Plane, error: Plane) -> Plane:
        """z of a normal distribution with the probability of Student's t = |excess|/error; 0 where `error` is 0."""
        from scipy.special import ndtri, stdtr

        t = np.abs(np.divide(excess, error, out=np.zeros_like(excess), where=error > 0))
        finite = np.isfinite(self.freedom)
        tail = stdtr(np.where(finite, self.freedom, 1.0), -t)
        return np.where(finite, -ndtri(np.clip(tail, 1e-300, 0.5)), t)  # beyond 1e-300 z stays at 37

    def detectable(self, pixel: tuple[int, int], pixels: int) -> float | None:
        """Difference on `pixel` over the standard's power there with p = `LEVEL` among so many pixels."""
        from scipy.special import ndtri, stdtrit

        if not self.tested[pixel]:
            return None
        tail = -math.expm1(math.log1p(-LEVEL) / pixels) / 2
        freedom = self.freedom[pixel]
        t = -(stdtrit(freedom, tail) if math.isfinite(freedom) else ndtri(tail))
        return float((self.bound[pixel] + t * self.error[pixel]) / self.power[pixel])
