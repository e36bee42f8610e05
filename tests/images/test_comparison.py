"""Metrics: against hand-computed numbers, and the z-test against seeded noise of known size."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from mitsuba_fspt.detector.detector import Detector
from mitsuba_fspt.images.comparison import compare
from mitsuba_fspt.images.image import Image
from mitsuba_fspt.images.z_test import differences
from mitsuba_fspt.runtime.errors import ImageError

STANDARD = Image(np.array([[0.0, 2.0], [4.0, 8.0]]) * 1e-9)
CALCULATED = Image(np.array([[1.0, 2.0], [2.0, 5.0]]) * 1e-9)


def test_metrics_by_hand():
    """Normalised: standard 0, .25, .5, 1; calculated .2, .4, .4, 1. Differences .2, .15, .1, 0: ME = .45/4.

    Absolute: differences 1, 0, 2, 3 of a peak of 8. Seen to fail without the normalisation of either image,
    with the calculated peak in place of the standard's, and with the square root of the rms dropped.
    """
    comparison = compare(CALCULATED, STANDARD)
    assert comparison.me == pytest.approx(0.1125, rel=1e-12)
    assert comparison.max_error == pytest.approx(3 / 8, rel=1e-12)
    assert comparison.rms == pytest.approx(math.sqrt(14 / 4) / 8, rel=1e-12)
    assert comparison.ratio == pytest.approx(10 / 14, rel=1e-12)
    # Deviations from the means 3.5 and 2.5: (-3.5, -1.5, .5, 4.5) and (-1.5, -.5, -.5, 2.5).
    assert comparison.cf == pytest.approx(17 / math.sqrt(35 * 9), rel=1e-12)


def test_scale_of_one_image_shows_in_the_absolute_numbers_only():
    doubled = Image(2 * CALCULATED.power)
    once, twice = compare(CALCULATED, STANDARD), compare(doubled, STANDARD)
    assert twice.me == pytest.approx(once.me, rel=1e-12)
    assert twice.cf == pytest.approx(once.cf, rel=1e-12)
    assert twice.ratio == pytest.approx(2 * once.ratio, rel=1e-12)
    assert twice.max_error == pytest.approx(2 / 8, rel=1e-12)  # (2, 2, 0, 2) of 8


def test_equal_images_differ_by_nothing():
    comparison = compare(STANDARD, STANDARD)
    assert (comparison.me, comparison.max_error, comparison.rms, comparison.ratio) == (0, 0, 0, 1)
    assert comparison.cf == pytest.approx(1, abs=1e-15)
    assert comparison.z_test is None


def test_stray_light_of_one_image_is_told():
    power = np.array([[1.0, 2.0], [3.0, 4.0]])
    clear, veiled = Image(power), Image(power, metadata={"veiling_glare": 0.02})
    assert compare(clear, veiled).stray_light == "standard"
    assert "only the calculated contains the stray light" in compare(veiled, clear).render_text()
    assert compare(veiled, veiled).stray_light is None
    assert "stray" not in compare(clear, clear).render_text()


@pytest.mark.parametrize("scale", [1e-30, 1e-200, 1e200])
def test_metrics_do_not_depend_on_the_scale_of_both(scale):
    comparison = compare(Image(CALCULATED.power * scale), Image(STANDARD.power * scale))
    reference = compare(CALCULATED, STANDARD)
    for name in ("me", "cf", "max_error", "rms", "ratio"):
        assert getattr(comparison, name) == pytest.approx(getattr(reference, name), rel=1e-12)


def test_float32_images_are_compared_in_double():
    """A difference of 1e-7 of the peak survives; the sum of a million float32 pixels would lose it."""
    power = np.random.default_rng(1).random((1000, 1000), dtype=np.float32)
    power[0, 0] = 1
    comparison = compare(Image(power), Image(power.astype(np.float64) * (1 + 1e-7)))
    assert comparison.ratio - 1 == pytest.approx(-1e-7, rel=1e-6)
    assert comparison.max_error == pytest.approx(1e-7, rel=1e-6)


def test_profiles():
    """The default goes through the standard's peak, which here is in the last row and the last column."""
    row, column = compare(CALCULATED, STANDARD).profiles
    assert (row.line, row.index, column.line, column.index) == ("row", 1, "column", 1)
    np.testing.assert_array_equal(row.calculated, np.array([2, 5]) * 1e-9)
    np.testing.assert_array_equal(row.standard, np.array([4, 8]) * 1e-9)
    np.testing.assert_array_equal(column.calculated, np.array([2, 5]) * 1e-9)
    np.testing.assert_array_equal(column.standard, np.array([2, 8]) * 1e-9)
    (column,) = compare(CALCULATED, STANDARD, columns=[0]).profiles
    np.testing.assert_array_equal(column.standard, np.array([0, 4]) * 1e-9)
    assert compare(CALCULATED, STANDARD, rows=[]).profiles == ()


def test_profiles_of_an_array_of_rows_or_of_one_alone():
    """Seen to fail with a ValueError and a TypeError."""
    profiles = compare(CALCULATED, STANDARD, rows=np.arange(2), columns=1).profiles
    assert [(profile.line, profile.index) for profile in profiles] == [("row", 0), ("row", 1), ("column", 1)]
    json.dumps(compare(CALCULATED, STANDARD, rows=np.arange(2)).to_dict())
    for wrong in ([0.5], ["0"], [None]):
        with pytest.raises(ImageError, match=r"number of a row must be a whole number, got .*Give for example 0"):
            compare(CALCULATED, STANDARD, rows=wrong)


def test_powers_that_add_up_to_0_have_no_ratio(run, tmp_path):
    """Seen to fail: a warning of NumPy, 'nan' and a NaN that is no JSON."""
    image = Image(np.array([[1.0, -1.0], [2.0, -2.0]]))
    image.write(tmp_path / "z.exr")
    assert compare(STANDARD, image).ratio is None
    assert compare(image, STANDARD).ratio == 0
    code, out, err = run("compare", tmp_path / "z.exr", tmp_path / "z.exr")
    assert (code, err) == (0, "")
    assert "ratio  none       the standard's powers add up to 0\n" in out
    code, out, err = run("compare", tmp_path / "z.exr", tmp_path / "z.exr", "--json", "--png", tmp_path / "z.png")
    assert (code, err) == (0, "")
    assert json.loads(out)["ratio"] is None


def test_z_by_hand():
    """Differences 1, 0, 2, 3 over deviations 5 = √(3² + 4²), 0, 2, 0: z = .2 and 1; the 3 is not judged."""
    calculated = replace(CALCULATED, error=np.array([[3, 0], [2, 0]]) * 1e-9)
    standard = replace(STANDARD, error=np.array([[4, 0], [0, 0]]) * 1e-9)
    z = compare(calculated, standard).z_test
    assert z.max_z == pytest.approx(1, rel=1e-12)
    assert z.chi2 == pytest.approx((0.04 + 1) / 2, rel=1e-12)
    assert (z.pixels, z.unjudged) == (2, 1)
    # Outside ±1 sigma lies 0.31731 of a normal distribution.
    assert z.p_value == pytest.approx(1 - (1 - 0.3173105078629141) ** 2, rel=1e-12)


def test_z_of_true_noise_and_of_a_bias():
    """Rationale: for true errors p-values are uniform and chi2 is 1; a bias of six sigma is seen.

    Expected: over 400 seeded pairs of 256 pixels the p-values have mean 1/2 ± 4/√(12 · 400), chi2 has mean
    1 ± 4 √(2/(256 · 400)). Seen to fail without Šidák's exponent and with one of the two errors left out.
    """
    rng = np.random.default_rng(11)
    truth = 10 + rng.random((16, 16))

    def z_test(bias):
        calculated, standard = (truth + sigma * rng.normal(size=truth.shape) for sigma in (0.3, 0.4))
        error = np.full_like(truth, 0.3), np.full_like(truth, 0.4)
        return compare(Image(calculated + bias, error[0]), Image(standard, error[1])).z_test

    true = [z_test(0) for _ in range(400)]
    assert np.mean([z.p_value for z in true]) == pytest.approx(0.5, abs=4 / math.sqrt(12 * 400))
    assert np.mean([z.chi2 for z in true]) == pytest.approx(1, abs=4 * math.sqrt(2 / (256 * 400)))
    assert z_test(3.0).p_value < 1e-9


TRUTH = 10 + np.random.default_rng(5).random((16, 16))
INTEGRAL = {"method": "integral"}


def sampled(rng, passes, truth=TRUTH):
    """Image of so many passes with normal noise of a standard deviation of 1, and the standard error that they show."""
    each = truth + rng.normal(size=(passes, *truth.shape))
    return Image(each.mean(0), each.std(0, ddof=1) / math.sqrt(passes), metadata={"method": "path", "passes": passes})


@pytest.mark.parametrize(("passes", "exact", "slack"), [(4, True, 0), (16, True, 0), (16, False, 0.1)])
def test_variances_of_few_passes(passes, exact, slack):
    """Rationale: with s from few passes, z is Student's t (against an exact image) or Welch's (of two Monte Carlos).

    Expected: over 400 images of 256 pixels p-values are uniform: mean 1/2 ± 4/√(12 · 400), and 5 % below 0.05 ± 4
    binomial deviations; chi2 has mean 1 ± 0.02. Welch's test errs on the safe side far out: `slack` above the mean.
    Seen to fail for the normal distribution (p below 0.05 in all cases of 4 passes), and for `passes` in place of
    `passes` - 1 degrees of freedom.
    """
    rng = np.random.default_rng(passes)

    def z_test():
        return compare(Image(TRUTH) if exact else sampled(rng, passes), sampled(rng, passes)).z_test

    found = [z_test() for _ in range(400)]
    p = np.array([z.p_value for z in found])
    tolerance = 4 / math.sqrt(12 * 400)
    assert 0.5 - tolerance < p.mean() < 0.5 + tolerance + slack
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / 400))
    assert np.mean([z.chi2 for z in found]) == pytest.approx(1, abs=0.02 + slack)


def test_error_of_the_integral_is_a_bound():
    """A difference of 5 with a bound of 3 and s = 2 is z = 1, not 5/√13; within the bound it is 0.

    Seen to fail with both errors added in quadrature.
    """
    standard = replace(STANDARD, error=np.full((2, 2), 2e-9))  # of any number of samples: a known deviation
    power = np.array([[0.0, 7.0], [1.5, 8.0]]) * 1e-9
    calculated = Image(power, np.full((2, 2), 3e-9), metadata=INTEGRAL)
    assert differences(calculated, standard) == pytest.approx(np.array([[np.nan, 1], [0, 0]]), nan_ok=True)
    assert differences(standard, calculated)[0, 1] == pytest.approx(-1)
    z = compare(calculated, standard).z_test
    assert (z.max_z, z.pixels, z.noisy, z.chi2) == (pytest.approx(1), 3, 0, None)
    # Of three pixels p_1 = 0.00334450: z = 2.934; (3 + 2.934 · 2)/8.
    assert z.detectable == pytest.approx((3 + 2 * 2.9342) / 8, rel=1e-3)


@pytest.mark.parametrize("first", ["measured", "calculated"])
def test_a_gain_error_is_common_to_all_pixels(first):
    """A measured image 5 % too bright, with a gain error of 5 % and noise of 1 % of the brightest pixel.

    Expected: a share of 0.05, chi2 1; without the gain error, or with one of 0.5 %, it differs. Seen to fail (p = 0)
    with the gain error left out, and with the sign of the standard's light turned.
    """
    rng = np.random.default_rng(5)
    noise = 0.01 * TRUTH.max()
    exact = Image(TRUTH, np.full(TRUTH.shape, 1e-6), metadata=INTEGRAL)

    def z_test(gain_error):
        counts = Image(power, np.full(TRUTH.shape, noise), metadata={"gain_error": gain_error} if gain_error else {})
        return compare(*((counts, exact) if first == "measured" else (exact, counts))).z_test

    power = 1.05 * TRUTH + noise * rng.standard_normal(TRUTH.shape)
    found = z_test(0.05)
    assert found.gain == pytest.approx(0.05, abs=3e-3)
    assert found.chi2 == pytest.approx(1, abs=4 * math.sqrt(2 / TRUTH.size))
    assert found.p_value > 1e-3
    assert "\ngain   +" in found.render_text()
    assert z_test(0.0).gain is None
    assert z_test(0.0).p_value < 1e-6
    assert z_test(0.005).p_value < 1e-6  # nearly ten deviations


def test_gain_of_images_that_are_mostly_noise():
    """Two images of light of half the noise, one with a gain error of 30 % and no error of it.

    Expected: a share of 0 within four standard deviations: with n pixels and the noise σ over the light, b d has the
    variance σ² (2 + 4 σ²) and its mean over b² that over n. Seen to fail (0.8) with the measured image's own light,
    whose noise is in the difference, too, and (−0.8) without taking the other's noise out.
    """
    rng, light, sigma = np.random.default_rng(8), np.full((128, 64), 1.0), 2.0
    measured, other = (
        Image(light + sigma * rng.standard_normal(light.shape), np.full(light.shape, sigma)) for _ in range(2)
    )
    found = compare(replace(measured, metadata={"gain_error": 0.3}), other).z_test
    assert abs(found.gain) < 4 * sigma * math.sqrt((2 + 4 * sigma**2) / light.size)
    assert found.p_value > 1e-3


def test_noise_is_judged_where_it_exceeds_the_bound():
    """Bounds far above the noise leave no power, and the test says so; far below it, chi2 is 1.

    Seen to fail (chi2 0.05, p = 1, no word of it) with the bound taken as a standard deviation.
    """
    rng = np.random.default_rng(3)
    noise = sampled(rng, 32)
    tight, loose, useless = (
        compare(Image(TRUTH, np.full(TRUTH.shape, bound), metadata=INTEGRAL), noise) for bound in (1e-3, 1.0, 20.0)
    )
    assert tight.z_test.chi2 == pytest.approx(1, abs=4 * math.sqrt(2 / 256))
    assert tight.z_test.noisy == 256
    assert tight.z_test.detectable < 0.1
    assert (loose.z_test.chi2, loose.z_test.noisy, loose.z_test.p_value) == (None, 0, 1)
    assert 0.1 < loose.z_test.detectable < 0.2  # a bound of 1 of 11
    assert "chi2   none   the integral's errors exceed the noise; largest |z| 0.00 of 256 pixels, p 1\n" in str(
        loose.render_text()
    )
    assert loose.render_text().endswith("smallest difference of the brightest pixel, over its power, for p < 0.01")
    assert useless.render_text().endswith(
        "power  none    the errors exceed the brightest pixel; give more samples or a smaller rtol"
    )


def test_two_integrals_have_bounds_alone():
    """No standard error, so no z-test: pixels beyond both bounds are counted. Differences are 1, 0, 2 and 3."""
    calculated = Image(CALCULATED.power, np.full((2, 2), 1e-9), metadata=INTEGRAL)
    standard = Image(STANDARD.power, np.full((2, 2), 1.5e-9), metadata=INTEGRAL)
    found = compare(calculated, standard)
    assert (found.z_test, found.beyond) == (None, 1)
    assert "beyond 1   pixels that differ by more than the errors of both together" in found.render_text()


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_the_test_does_not_depend_on_the_scale_of_both(scale):
    """Seen to fail (z = 0) with squares of the errors, which underflow."""
    rng = np.random.default_rng(2)
    image = sampled(rng, 16)
    exact = Image(TRUTH, np.full(TRUTH.shape, 0.01), metadata=INTEGRAL)

    def z_test(factor):
        scaled = (replace(one, power=one.power * factor, error=one.error * factor) for one in (exact, image))
        return compare(*scaled).z_test

    one, other = z_test(1.0), z_test(scale)
    for name in ("max_z", "chi2", "p_value", "detectable"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-9)


def test_events_that_no_sample_met():
    """Rationale: of Poisson events the passes of a pixel that missed most of them show too small a variance.

    An exact image of 9 events a pixel against Monte Carlo with one pixel of 1 event: s is 1 there, z = 8 by itself, but
    the probability of at most one event is 1.2e-3, z = 3.2; with the variance of the expected events z = 8/3.
    Seen to fail (8) without the variance of missed events.
    """
    power = np.full((5, 5), 9.0)
    power[2, 2] = 1
    counted = Image(power, np.sqrt(power), metadata={"method": "ptracer", "passes": 10**6})
    exact = Image(np.where(np.eye(5), 9.0, 9.000001), metadata=INTEGRAL)
    assert differences(exact, counted)[2, 2] == pytest.approx(8 / 3, rel=1e-4)


def test_p_value_at_its_ends():
    error = np.full((2, 2), 1e-9)
    same = compare(replace(STANDARD, error=error), STANDARD).z_test
    assert (same.max_z, same.chi2, same.p_value) == (0, 0, 1)
    # z = 12 in four pixels: p = 4 · erfc(12/√2), far below 1e-16.
    apart = compare(replace(STANDARD, power=STANDARD.power + 12e-9, error=error), STANDARD).z_test
    assert apart.p_value == pytest.approx(4 * math.erfc(12 / math.sqrt(2)), rel=1e-6)
    assert compare(replace(STANDARD, power=STANDARD.power + 1, error=error), STANDARD).z_test.p_value == 0


def test_json():
    found = json.loads(json.dumps(compare(replace(CALCULATED, error=np.ones((2, 2))), STANDARD).to_dict()))
    assert found["ratio"] == pytest.approx(10 / 14)
    assert found["z_test"]["pixels"] == 4
    assert found["profiles"][0] == {
        "line": "row",
        "index": 1,
        "calculated": [2e-9, 5e-9],
        "standard": [4e-9, 8e-9],
    }
    assert compare(CALCULATED, STANDARD).to_dict()["z_test"] is None
    bound = replace(CALCULATED, error=np.full((2, 2), 1.5e-9), metadata={"method": "integral"})
    assert compare(bound, STANDARD).to_dict()["beyond"] == 2


@pytest.mark.parametrize(
    ("calculated", "arguments", "message"),
    [
        (Image(np.ones((2, 3))), {}, "calculated image has 3 × 2 pixels, the standard 2 × 2"),
        (Image(np.zeros((2, 2))), {}, "calculated image is dark, its brightest pixel has 0 W"),
        (Image(np.full((2, 2), 0.5)), {}, "every pixel of the calculated image has 0.5 W"),
        (CALCULATED, {"rows": [2]}, r"row 2 does not exist. Give one in 0 … 1"),
        (CALCULATED, {"columns": [-1]}, r"column -1 does not exist"),
    ],
)
def test_what_cannot_be_compared(calculated, arguments, message):
    with pytest.raises(ImageError, match=message):
        compare(calculated, STANDARD, **arguments)


def test_the_standard_is_checked_too():
    with pytest.raises(ImageError, match="the standard is dark"):
        compare(STANDARD, Image(np.zeros((2, 2))))
    with pytest.raises(ImageError, match="every pixel of the standard"):
        compare(STANDARD, Image(np.ones((2, 2))))


def test_counts_are_judged_by_the_noise_of_the_exact_light():
    """A spot of up to 2,000 DN from a typical CCD, 40 draws of the noise, against its exact power.

    Expected: p below 0.05 in at most 7 of 40, by chance once in 300. Seen to fail (19 of 40) with the errors that the
    images state, which are too small where noise made a pixel dark.
    """
    y, x = np.mgrid[:48, :48]
    power = 1e-12 * np.exp(-((x - 24) ** 2 + (y - 22) ** 2) / 100)
    exact, camera = Image(power, np.full(power.shape, 1e-18), metadata=INTEGRAL), Detector.typical_ccd()
    p = []
    for seed in range(40):
        counts = camera.expose(exact, 1e-3, 620, seed=seed).counts
        image = camera.reduce(counts, exposure_time=1e-3, wavelength_nm=620, metadata={"pixel_pitch": 0.0135})
        p.append(compare(image, exact).z_test.p_value)
    assert np.count_nonzero(np.array(p) < 0.05) <= 7
