"""The detector: means and variances of many pixels against the closed forms of EMVA 1288."""

import json
import math
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as Picture

from mitsuba_fspt.detector.detector import Detector
from mitsuba_fspt.detector.parameters import EXAMPLES
from mitsuba_fspt.images.formats import read_planes
from mitsuba_fspt.images.image import Image
from mitsuba_fspt.images.pixel_axes import PixelAxes
from mitsuba_fspt.runtime.errors import BackendError, DetectorError, ImageError

CCD = Detector.typical_ccd()
WAVELENGTH_NM = 650.0
# One photon of 650 nm, from the electron volt: E = 1239.841984 eV nm / λ.
PHOTON = 1239.841984 / WAVELENGTH_NM * 1.602176634e-19  # [J]
DARK = Image(np.zeros((4, 4)))


def flat(photons_per_second: float, size: int = 512, **metadata: float) -> Image:
    return Image(np.full((size, size), photons_per_second * PHOTON), metadata=metadata)


def assert_moments(values: np.ndarray, mean: float, variance: float) -> None:
    """Sample mean and variance within four standard errors (of the variance: for a nearly normal law)."""
    n = values.size
    assert values.mean() == pytest.approx(mean, abs=4 * math.sqrt(variance / n))
    assert values.var(ddof=1) == pytest.approx(variance, rel=4 * math.sqrt(2 / n))


@pytest.mark.parametrize(("photons", "time"), [(0.38, 300.0), (3.1, 60.0), (500.0, 20.0)])
def test_mean_and_variance_of_electrons(photons, time):
    """Rationale: shot noise of light and dark current plus read noise, mean = η N + D, variance = mean + σ².

    Seen to fail without the quantum efficiency, the exposure time or the read noise, with the variance of the
    read noise for its deviation, and without the shot noise.
    """
    electrons = CCD.expose(flat(photons), time, WAVELENGTH_NM, seed=3).electrons.astype(np.float64)
    mean = 0.85 * photons * time + 1e-3 * time
    assert_moments(electrons, mean, mean + 3.5**2)


def test_dark_frame():
    """No light: an hour of dark current gives 3.6 e- and their shot noise. Fails without the current."""
    electrons = CCD.expose(flat(0.0), 3600.0, WAVELENGTH_NM, seed=1).electrons.astype(np.float64)
    assert_moments(electrons, 3.6, 3.6 + 3.5**2)
    assert electrons.min() < 0  # a read-out below zero is a fact, the bias keeps it


def test_bias_frame():
    """Time 0: counts are the bias plus read noise / gain plus the rounding error of variance 1/12."""
    counts = CCD.expose(flat(100.0), 0.0, WAVELENGTH_NM, seed=2).counts.astype(np.float64)
    assert_moments(counts, 500.0, (3.5 / 1.6) ** 2 + 1 / 12)


def test_counts():
    """DN = bias + electrons/gain with a rounding error of at most one half, on every pixel."""
    exposure = CCD.expose(flat(1000.0), 10.0, WAVELENGTH_NM, seed=4)
    error = exposure.counts - (500 + exposure.electrons.astype(np.float64) / 1.6)
    assert 0.49 < np.abs(error).max() <= 0.5
    assert_moments(exposure.counts.astype(np.float64), 500 + 8500.01 / 1.6, (8500.01 + 12.25) / 1.6**2 + 1 / 12)


def test_binning_sums_before_the_read_noise():
    """Sixteen pixels' charge meets one read noise: mean and shot noise 16-fold, σ² once.

    Summed after the read-out the variance would be larger by 15 σ² = 184 of 449 and this test fails.
    """
    exposure = CCD.expose(flat(0.5, size=1024), 60.0, WAVELENGTH_NM, binning=4, seed=5)
    assert exposure.electrons.shape == (256, 256)
    mean = 16 * (0.85 * 0.5 + 1e-3) * 60
    assert_moments(exposure.electrons.astype(np.float64), mean, mean + 3.5**2)


def test_bins_are_squares_in_place():
    """Each pixel's charge goes to its own bin: rows and columns of a non-square image told apart."""
    power = np.arange(24.0).reshape(4, 6) * PHOTON
    mean = replace(CCD, dark_current=0).expected(Image(power), 1 / 0.85, WAVELENGTH_NM, binning=2).mean
    expected = [[0 + 1 + 6 + 7, 2 + 3 + 8 + 9, 4 + 5 + 10 + 11], [62, 70, 78]]
    np.testing.assert_allclose(mean, expected, rtol=1e-8)


def test_coarse_pixels_have_the_dark_current_of_their_area():
    """0.108 mm are 8 × 8 pixels of 13.5 µm; the same light as 8 × 8 fine pixels binned."""
    coarse = CCD.expected(flat(64.0, size=4, pixel_pitch=0.108), 100.0, WAVELENGTH_NM)
    fine = CCD.expected(flat(1.0, size=32, pixel_pitch=0.0135), 100.0, WAVELENGTH_NM, binning=8)
    np.testing.assert_allclose(coarse.mean, fine.mean, rtol=1e-12)
    np.testing.assert_allclose(coarse.variance, fine.variance, rtol=1e-12)
    dark = CCD.expected(flat(0.0, size=4, pixel_pitch=0.108), 100.0, WAVELENGTH_NM).mean
    np.testing.assert_allclose(dark, 6.4, rtol=1e-12)
    own = replace(CCD, pixel_pitch=None).expected(flat(0.0, 4, pixel_pitch=0.108), 100.0, WAVELENGTH_NM).mean
    np.testing.assert_allclose(own, 0.1, rtol=1e-12)


def test_arrays_are_no_images():
    with pytest.raises(DetectorError, match="must be given an image, got ndarray"):
        Detector.typical_ccd().expose(np.ones((2, 2)), 60, 650)


def test_expected_is_what_expose_draws_about():
    """On an image with structure: z over 2^18 pixels has mean 0 and variance 1."""
    rng = np.random.default_rng(8)
    image = Image(rng.random((512, 512)) * 1e3 * PHOTON)
    expected = CCD.expected(image, 5.0, WAVELENGTH_NM)
    electrons = CCD.expose(image, 5.0, WAVELENGTH_NM, seed=9).electrons
    assert_moments((electrons - expected.mean) / np.sqrt(expected.variance), 0.0, 1.0)


def test_wavelength():
    """The same power is twice as many photons at twice the wavelength."""
    image = flat(1000.0, 2)
    short, long = (CCD.expected(image, 1.0, w).mean - 1e-3 for w in (325.0, 650.0))
    np.testing.assert_allclose(2 * short, long, rtol=1e-12)


@pytest.mark.parametrize("photons", [2e5, 1e20, 1e300])
def test_full_well(photons):
    """Beyond the full well every pixel delivers it, even in light beyond what NumPy's Poisson draws."""
    exposure = CCD.expose(flat(photons, 8), 1.0, WAVELENGTH_NM)
    assert (exposure.electrons == 1e5).all()
    assert (exposure.counts == 500 + 62500).all()
    assert exposure.metadata["saturated_pixels"] == 64


def test_half_of_the_pixels_at_the_full_well():
    """Light that fills the well on average clips about half of the pixels and leaves the others alone."""
    exposure = CCD.expose(flat(1e5 / 0.85), 1.0, WAVELENGTH_NM, seed=6)
    share = exposure.metadata["saturated_pixels"] / exposure.counts.size
    assert share == pytest.approx(0.5, abs=4 * 0.5 / 512)
    assert exposure.electrons.max() == 1e5


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_converter_ends_at_its_last_count(bits):
    detector = replace(CCD, bits=bits, gain=0.5)
    exposure = detector.expose(flat(9e4, 8), 1.0, WAVELENGTH_NM)
    assert exposure.counts.dtype == np.uint16
    assert (exposure.counts == 2**bits - 1).all()
    assert exposure.metadata["saturated_pixels"] == 64


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.int16, np.array])
def test_small_numbers_of_numpy_are_plain_numbers(kind):
    """2^bits of an 8-bit 12 is no number of 8 bits. Seen to fail: every count was 255."""
    numbers = {"gain": 2, "bits": 12, "bias": 50, "read_noise": 3, "dark_current": 1}
    arguments = {"exposure_time": 60, "binning": 2, "seed": 9}
    image = flat(100.0, 200)
    plain = replace(CCD, **numbers).expose(image, wavelength_nm=WAVELENGTH_NM, **arguments)
    small = replace(CCD, **{name: kind(value) for name, value in numbers.items()})
    small_arguments = {name: kind(value) for name, value in arguments.items()}
    exposure = small.expose(image, wavelength_nm=np.array(WAVELENGTH_NM), **small_arguments)
    np.testing.assert_array_equal(exposure.counts, plain.counts)
    assert exposure.counts.max() > 255
    assert json.dumps(exposure.metadata) == json.dumps(plain.metadata)


def test_counts_end_at_zero():
    """Without a bias the read-outs below zero are lost, half of them in the dark."""
    counts = replace(CCD, bias=0, gain=0.1).expose(flat(0.0), 0.0, WAVELENGTH_NM).counts
    assert np.mean(counts == 0) == pytest.approx(0.5, abs=0.01)


def test_seed():
    image = flat(100.0, 16)
    first, again, other = (CCD.expose(image, 1.0, WAVELENGTH_NM, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.electrons, again.electrons)
    np.testing.assert_array_equal(first.counts, again.counts)
    assert (first.electrons != other.electrons).any()


def test_binned_pixels_of_a_crop_window_keep_their_positions():
    """Centres of 2 × 2 pixels are the means of theirs, and the axis is the film's. Fails with unbinned numbers."""
    crop = {"film_width": 40, "film_height": 32, "crop_offset_x": 6, "crop_offset_y": 20}
    image = flat(100.0, 8, pixel_pitch=0.4, magnification=0.5, **crop)
    fine, coarse = (
        PixelAxes.of(shape, metadata)
        for shape, metadata in (
            ((8, 8), image.metadata),
            ((4, 4), CCD.expose(image, 1.0, WAVELENGTH_NM, binning=2).metadata),
        )
    )
    assert fine.x[0] == pytest.approx(0.8 * (6.5 - 20))
    np.testing.assert_allclose(coarse.x, fine.x.reshape(-1, 2).mean(axis=1))
    np.testing.assert_allclose(coarse.y, fine.y.reshape(-1, 2).mean(axis=1))


def test_exr(tmp_path):
    """Electrons in the channel; in the header the image's metadata and all that makes the exposure again."""
    image = flat(100.0, 16, pixel_pitch=0.0135, f_number=2.8, seed=77)
    exposure = CCD.expose(image, 30.0, WAVELENGTH_NM, binning=4, seed=12)
    exposure.write(tmp_path / "e.exr")
    planes, metadata = read_planes(tmp_path / "e.exr")
    np.testing.assert_array_equal(planes["electrons"], exposure.electrons)
    expected = {"quantity": "electrons", "unit": "e-", "f_number": 2.8, "seed": 77, "detector_seed": 12}
    expected |= {"exposure_time": 30.0, "wavelength_nm": 650.0, "binning": 4, "pixel_pitch": 0.054}
    expected |= {"quantum_efficiency": 0.85, "dark_current": 1e-3, "read_noise": 3.5, "full_well": 1e5}
    expected |= {"gain": 1.6, "bias": 500, "bits": 16, "detector": "typical, not a data sheet"}
    expected |= {"detector_pixel_pitch": 0.0135}  # of the dark current
    assert expected.items() <= metadata.items()


@pytest.mark.parametrize("name", ["dn.png", "dn.tif", "dn.TIFF"])
def test_counts_files(tmp_path, name):
    """All 16 bits of every count come back, row by row."""
    power = np.geomspace(1, 1e5, 35).reshape(5, 7) * PHOTON
    exposure = CCD.expose(Image(power), 1.0, WAVELENGTH_NM)
    exposure.write_counts(tmp_path / name)
    with Picture.open(tmp_path / name) as picture:
        np.testing.assert_array_equal(np.asarray(picture), exposure.counts)
        text = picture.info["Description"] if name.endswith("png") else picture.tag_v2[270]
    assert np.ptp(exposure.counts) > 2**15
    assert json.loads(text) == exposure.metadata | {"quantity": "counts", "unit": "DN"}


def test_counts_files_that_cannot_be_written(tmp_path, monkeypatch):
    exposure = CCD.expose(flat(1.0, 2), 1.0, WAVELENGTH_NM)
    with pytest.raises(ImageError, match=r"Give a \.png or \.tif"):
        exposure.write_counts(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match=r"does not exist\. Create it first"):
        exposure.write_counts(tmp_path / "none" / "a.png")
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(BackendError, match=r"pip install 'mitsuba-fspt\[plot\]'"):
        exposure.write_counts(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


TOML = """
[lens]
focal_length = 50

[detector]
name = "CCD 1"
quantum_efficiency = 0.9
dark_current = 2e-3
read_noise = 4
full_well = 6e4
gain = 0.8
bias = 300
bits = 14
"""


def test_detector_of_a_file(tmp_path):
    """Every number of the table [detector] is the class's; a table [lens] beside it is not read."""
    (tmp_path / "c.toml").write_text(TOML)
    found = Detector.from_toml(tmp_path / "c.toml")
    assert found == Detector(0.9, 2e-3, 4, 6e4, 0.8, 300, 14, None, "CCD 1")
    (tmp_path / "c.toml").write_text(TOML.replace('name = "CCD 1"', "pixel_pitch = 0.013"))
    assert Detector.from_toml(tmp_path / "c.toml").pixel_pitch == 0.013


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[detector]", "[camera]", r"the table \[detector\] is missing\. Give it, with quantum_efficiency, "),
        ("[lens]", "[lense]", r"'lense' means nothing here\. Put it into \[detector\], or leave it out"),
        ("read_noise", "readnoise", r"\[detector\]: 'readnoise' means nothing here\. Give quantum_efficiency, "),
        ("read_noise = 4", "", r"\[detector\]: 'read_noise' is missing\. Give for example read_noise = 3\.5"),
        ("= 4", '= "low"', r"\[detector\]: 'read_noise' must be a number, got 'low'\. Give for example 3\.5"),
        ("= 4", "= true", "'read_noise' must be a number, got True"),
        ("= 0.9", "= 90", r"\[detector\]: 'quantum_efficiency' must be finite and in \(0, 1\].*, got 90"),
        ('"CCD 1"', "1", r"'name' must be a text in quotes, got 1\. Give for example"),
        ("= 4", "= ", "is no TOML file: "),
    ],
)
def test_files_of_no_detector(tmp_path, old, new, message):
    assert old in TOML
    (tmp_path / "c.toml").write_text(TOML.replace(old, new))
    with pytest.raises(DetectorError, match=message) as raised:
        Detector.from_toml(tmp_path / "c.toml")
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(f"'{tmp_path / 'c.toml'}'")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(DetectorError, match=r"c\.toml' cannot be read: No such file or directory\. Check the name"):
        Detector.from_toml(tmp_path / "c.toml")


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("quantum_efficiency", 0, r"in \(0, 1\]"),
        ("quantum_efficiency", 1.2, r"in \(0, 1\]"),
        ("full_well", 0, r"in \(0, 1e15\] e-"),
        ("gain", -1, "> 0 e-/DN"),
        ("gain", math.inf, "> 0 e-/DN"),
        ("dark_current", math.nan, ">= 0"),
        ("read_noise", math.inf, ">= 0"),
        ("bias", -1, ">= 0"),
        ("bits", 17, "a whole number in 1 … 16"),
        ("bits", 7.5, "a whole number in 1 … 16"),
        ("pixel_pitch", 0, "> 0 mm"),
    ],
)
def test_detectors_that_cannot_exist(name, value, rule):
    with pytest.raises(DetectorError, match=f"'{name}' must be finite and {rule}.*, for example .*, got {value}"):
        replace(CCD, **{name: value})


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_value_that_is_no_number_is_refused_with_a_valid_one(name):
    """Seen to fail: 16 for a quantum efficiency, which is 1 at the most."""
    camera = replace(CCD, em_gain=300)
    with pytest.raises(DetectorError, match=f"'{name}' must be a number, got 'many'") as caught:
        replace(camera, **{name: "many"})
    replace(camera, **{name: float(re.search(r"Give for example (.*)\.$", str(caught.value))[1])})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"exposure_time": -1.0}, "'exposure_time' must be finite and in 0 … 1e12 s, for example 60, got -1.0"),
        ({"wavelength_nm": 0.0}, "'wavelength_nm' must be in 200 … 2500 nm, got 0"),
        ({"wavelength_nm": 1e308, "image": DARK}, "must be in 200 … 2500 nm, got 1e\\+308"),
        ({"exposure_time": 1e300, "image": DARK}, "must be finite and in 0 … 1e12 s, for example 60, got 1e\\+300"),
        ({"exposure_time": "60"}, "'exposure_time' must be a number, got '60'. Give for example 60"),
        ({"seed": 1.5}, "'seed' must be a whole number, got 1.5. Give for example 1"),
        ({"seed": -1}, "'seed' must be finite and >= 0"),
        ({"binning": 3}, r"'binning' = 3 does not divide the image of 4 × 4 pixels. Give a divisor of 4"),
        (
            {"binning": 2, "image": Image(np.ones((2, 3)))},
            "does not divide the image of 3 × 2 pixels",
        ),
        ({"binning": 0}, "'binning' = 0 does not divide"),
        ({"image": Image([[1.0, -1e-12]])}, "power must be >= 0 on every pixel, got -1e-12 W"),
    ],
)
def test_exposures_that_cannot_be_made(arguments, message):
    defaults = {"image": flat(1.0, 4), "exposure_time": 1.0, "wavelength_nm": 650.0}
    with pytest.raises(DetectorError, match=message):
        CCD.expose(**defaults | arguments)
