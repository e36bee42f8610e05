"""EMCCD and sCMOS: the register, spurious charge, maps and PRNU, exposed and reduced, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.reduction import read_measured, reduced
from mitsuba_fspt.images.image import Image, read_image_or_exposure
from mitsuba_fspt.images.noise_model import NoiseModel
from mitsuba_fspt.inverse.measurement import noise_of
from mitsuba_fspt.runtime.errors import DetectorError, ImageError

CCD = fspt.Detector.typical_ccd()
EMCCD = replace(fspt.Detector.typical_emccd(), full_well=1e9, bits=16, gain=40.0, pixel_pitch=None)
SETTINGS = {"exposure_time": 60, "wavelength_nm": 650}
JOULE = 1239.841984 / 650 * 1.602176634e-19  # of one photon of 650 nm
SHAPE = (96, 128)


def image(electrons, shape=SHAPE, eta=0.9, **metadata):
    """Image on which 60 s give so many photoelectrons a pixel."""
    return Image(np.broadcast_to(electrons, shape) * (JOULE / (60 * eta)), metadata=metadata)


def assert_moments(values, mean, variance, fourth=3.0):
    """Mean and variance within four standard errors; `fourth` over the squared variance, 3 of a normal law."""
    n = values.size
    assert values.mean() == pytest.approx(mean, abs=4 * math.sqrt(variance / n))
    assert values.var(ddof=1) == pytest.approx(variance, rel=4 * math.sqrt((fourth - 1) / n))


@pytest.mark.parametrize("electrons", [0.3, 20.0])
@pytest.mark.parametrize("excess", [1.0, 1.5, 2.0])
def test_the_register_multiplies_charge_and_noise(electrons, excess):
    """Mean g n, variance g² F² n + σ²: quantum efficiency, dark current and spurious charge are before the register.

    Seen to fail without F², with the read noise before the register, and with the spurious charge after it.
    """
    camera = replace(EMCCD, excess_noise=excess, spurious_charge=0.05, dark_current=1e-3)
    charge = electrons + 0.05 + 0.06
    found = camera.expose(image(electrons, (256, 256)), **SETTINGS, seed=3).electrons.astype(np.float64)
    fourth = 3 + (2 * excess - 1) * (3 * excess - 2) / (excess * charge)  # of gamma distributed events
    assert_moments(found, 300 * charge, 300**2 * excess * charge + 60**2, fourth)
    expected = camera.expected(image(electrons, (2, 2)), **SETTINGS)
    np.testing.assert_allclose(expected.mean, 300 * charge, rtol=1e-6)
    np.testing.assert_allclose(expected.variance, 300**2 * excess * charge + 60**2, rtol=1e-6)


def test_one_electron_leaves_the_register_exponentially_distributed():
    """F² = 2: of single electrons the share above x is exp(-x/g)."""
    camera = replace(EMCCD, read_noise=0, dark_current=0, spurious_charge=0)
    found = camera.expose(image(1e-3, (512, 512)), **SETTINGS, seed=1).electrons
    lit = found[found > 0]
    for x in (100, 300, 900):
        share = math.exp(-x / 300)
        assert np.mean(lit > x) == pytest.approx(share, abs=4 * math.sqrt(share / lit.size) + 1e-3)


def test_counts_of_an_emccd_reduce_to_power():
    """Number, dark frame or bias frame: mean power and χ² on three levels of light.

    Seen to fail without F² (χ² 1.9), without 1/g, and with the spurious charge of a bias frame subtracted twice.
    """
    pytest.importorskip("ccdproc")
    camera = replace(EMCCD, spurious_charge=0.5, dark_current=0.01)
    light = image(np.repeat([0.5, 5.0, 100.0], 32)[:, None], (96, 96))
    none = image(0.0, (96, 96))
    counts = camera.expose(light, **SETTINGS, seed=1).counts
    dark = np.array([camera.expose(none, **SETTINGS, seed=10 + k).counts for k in range(40)])
    bias = np.array([camera.expose(none, 0.0, 650, seed=60 + k).counts for k in range(40)])
    for given in ({}, {"dark": dark}, {"bias": bias}):
        found = camera.reduce(counts, **SETTINGS, **given)
        model = NoiseModel.of(found)
        variance = model.variance(light.power)
        chi2 = (found.power - light.power) ** 2 / variance
        for rows in (slice(0, 32), slice(32, 64), slice(64, 96)):
            mean = (found.power - light.power)[rows].mean() / math.sqrt(variance[rows].mean() / (32 * 96))
            assert abs(mean) < 4.5
            events = light.power[rows].mean() * found.electrons_per_watt + 1.1
            assert chi2[rows].mean() == pytest.approx(1, abs=4 * math.sqrt((2 + 6 / events) / (32 * 96)))
        assert found.read_noise == pytest.approx(60 / 300)
        assert found.metadata["excess_noise"] == 2


def test_an_emccd_exposure_reduces_by_its_own_numbers(tmp_path):
    exposure = EMCCD.expose(image(5.0), **SETTINGS, seed=1)
    exposure.write(tmp_path / "e.exr")
    one, other = reduced(exposure), read_measured(tmp_path / "e.exr")
    np.testing.assert_array_equal(one.power, other.power)
    np.testing.assert_array_equal(one.error, other.error)
    k = one.electrons_per_watt
    dark = 5e-4 * 60 + 2e-3
    np.testing.assert_allclose(one.power * k, exposure.electrons / 300 - dark, atol=1e-5)
    np.testing.assert_allclose(np.square(one.error * k), 2 * np.maximum(one.power * k, 0) + 2 * dark + 0.04, rtol=1e-5)


@pytest.fixture
def sensor(tmp_path):
    """sCMOS whose five maps are FITS, TIFF and NPY files beside its TOML."""
    fits, tifffile = pytest.importorskip("astropy.io.fits"), pytest.importorskip("tifffile")
    rng = np.random.default_rng(5)
    maps = {
        "read_noise": rng.lognormal(math.log(1.6), 0.6, SHAPE),
        "gain": 0.46 * rng.normal(1, 0.02, SHAPE),
        "bias": rng.normal(100, 3, SHAPE),
        "dark_current": rng.lognormal(-3, 1, SHAPE),
        "prnu": rng.normal(0, 0.03, SHAPE),
    }
    (tmp_path / "maps").mkdir()
    fits.PrimaryHDU(maps["read_noise"]).writeto(tmp_path / "maps/read.fits")
    tifffile.imwrite(tmp_path / "gain.tif", maps["gain"].astype(np.float32))
    names = {"read_noise": "maps/read.fits", "gain": "gain.tif"}
    for name in ("bias", "dark_current", "prnu"):
        np.save(tmp_path / f"{name}.npy", maps[name])
        names[name] = f"{name}.npy"
    lines = [f'{name} = "{file}"' for name, file in names.items()]
    text = "\n".join(["[detector]", "quantum_efficiency = 0.9", "full_well = 3e4", "bits = 16", *lines])
    (tmp_path / "camera.toml").write_text(text)
    return fspt.Detector.from_toml(tmp_path / "camera.toml"), maps


def test_maps_are_those_of_the_pixels(sensor, tmp_path):
    """Mean and variance of each pixel over 300 exposures; reduced, the power is even and χ² is 1 where noise is large.

    Seen to fail with the mean of each map in its place.
    """
    pytest.importorskip("ccdproc")
    camera, maps = sensor
    light = image(50.0)
    stack = np.array([camera.expose(light, **SETTINGS, seed=k).electrons for k in range(300)], np.float64)
    response = 1 + maps["prnu"]
    mean = 50 * response + 60 * maps["dark_current"]
    variance = mean + maps["read_noise"] ** 2
    assert np.mean((stack.mean(axis=0) - mean) ** 2 / variance) * 300 == pytest.approx(1, abs=0.06)
    assert np.mean(stack.var(axis=0, ddof=1) / variance) == pytest.approx(1, abs=0.01)
    exposure = camera.expose(light, **SETTINGS, seed=1)
    np.testing.assert_array_equal(
        exposure.counts, np.rint(maps["bias"] + exposure.electrons / np.float32(maps["gain"]).astype(float))
    )
    found = camera.reduce(exposure.counts, **SETTINGS)
    np.testing.assert_allclose(found.flat, response)
    noisy = maps["read_noise"] ** 2 + 60 * maps["dark_current"] > 30
    chi2 = (found.power - light.power) ** 2 / NoiseModel.of(found).variance(light.power)
    for part in (noisy, ~noisy):
        assert chi2[part].mean() == pytest.approx(1, abs=4 * math.sqrt(2.1 / part.sum()))
    dark = maps["read_noise"] ** 2 + 60 * maps["dark_current"] + np.float32(maps["gain"]).astype(float) ** 2 / 12
    np.testing.assert_allclose(found.dark_noise, np.sqrt(dark), rtol=1e-6)


def test_exposures_name_their_maps(sensor, tmp_path):
    """Path and digest of each map; the EXR reduces as the exposure does, and no longer once a map has changed."""
    camera, maps = sensor
    exposure = camera.expose(image(50.0), **SETTINGS, seed=1)
    assert exposure.metadata["read_noise"] == pytest.approx(maps["read_noise"].mean())
    assert exposure.metadata["read_noise_map"] == str(tmp_path / "maps/read.fits")
    assert len(str(exposure.metadata["read_noise_map_digest"])) == 16
    exposure.write(tmp_path / "e.exr")
    one, other = reduced(exposure), read_measured(tmp_path / "e.exr")
    assert "read_noise_map" not in one.metadata
    for name in ("power", "error", "flat", "dark_noise"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(exposure.counts, read_image_or_exposure(tmp_path / "e.exr").counts)
    np.save(tmp_path / "bias.npy", maps["bias"] + 1)
    with pytest.raises(DetectorError, match=r"'bias' = '.*bias.npy' is not the map that the exposure was made with"):
        read_measured(tmp_path / "e.exr")
    (tmp_path / "bias.npy").unlink()
    with pytest.raises(DetectorError, match=r"'bias' = '.*bias.npy' does not exist"):
        read_measured(tmp_path / "e.exr")


@pytest.mark.parametrize("suffix", [".exr", ".tif", ".h5", ".npz", ".fits"])
def test_files_keep_the_noise_model(sensor, tmp_path, suffix):
    """Planes and numbers, from which `invert` weighs: the stated error follows. Crops and sums keep it, too.

    Seen to fail with the mean read noise in place of the plane.
    """
    camera, _ = sensor
    camera = replace(camera, em_gain=20, full_well=1e6)
    one, two = (reduced(camera.expose(image(50.0), **SETTINGS, seed=k)) for k in (1, 2))
    one.write(tmp_path / f"p{suffix}")
    again = fspt.read(tmp_path / f"p{suffix}")
    noise = noise_of((1, *SHAPE), [again])
    stated = noise.variance(again.power[None].astype(np.float64), np.ones((1, *SHAPE), bool))[0]
    np.testing.assert_allclose(stated, np.square(one.error), rtol=1e-5)
    np.testing.assert_allclose(noise.shot[0], 2 / (one.electrons_per_watt * one.flat), rtol=1e-6)
    part = NoiseModel.of(again[10:20, 5:9])
    np.testing.assert_allclose(part.dark, noise.other[0][10:20, 5:9])
    two.write(tmp_path / f"two{suffix}")
    both = NoiseModel.of(again + fspt.read(tmp_path / f"two{suffix}"))
    np.testing.assert_allclose(both.dark, 2 * noise.other[0], rtol=1e-5)
    np.testing.assert_allclose(both.shot, noise.shot[0])


def test_a_number_for_prnu_is_one_pattern_of_this_deviation():
    """The same in all exposures, 2 % over the pixels, 1 % over bins of 2 × 2; in the errors without a flat field.

    A flat field of the same camera takes it out of both. Seen to fail with a pattern of its own for each seed.
    """
    pytest.importorskip("ccdproc")
    camera = replace(CCD, prnu=0.02, pixel_pitch=None)
    light = image(4e4, eta=0.85)
    stack = np.array([camera.expose(light, **SETTINGS, seed=k).electrons for k in range(20)])
    own = stack.mean(axis=0) / 4e4 - 1
    assert own.std() == pytest.approx(math.hypot(0.02, math.sqrt(1 / 4e4 / 20)), rel=0.03)
    binned = camera.expected(light, **SETTINGS, binning=2).mean
    assert (binned / 1.6e5).std() == pytest.approx(0.01, rel=0.05)
    found = reduced(camera.expose(light, **SETTINGS, seed=1))
    assert found.metadata["prnu"] == 0.02
    np.testing.assert_allclose(found.error / found.power, np.sqrt(1 / 4e4 + 0.02**2), rtol=0.01)
    bin_of_four = reduced(camera.expose(image(1e4, eta=0.85), **SETTINGS, binning=2, seed=1))
    assert bin_of_four.metadata["prnu"] == pytest.approx(0.01)
    flats = np.array([camera.expose(light, **SETTINGS, seed=50 + k).counts for k in range(20)])
    flat = camera.reduce(camera.expose(light, **SETTINGS, seed=1).counts, **SETTINGS, flat=flats, flat_kind="sensor")
    assert "prnu" not in flat.metadata
    assert np.mean(((flat.power - light.power) / flat.error) ** 2) == pytest.approx(1, abs=0.06)


def test_a_map_of_the_response_or_of_its_deviation(tmp_path):
    response = 1 + 0.1 * np.random.default_rng(3).uniform(-1, 1, (4, 5))
    for name, values in (("response.npy", response), ("deviation.npy", response - 1)):
        np.save(tmp_path / name, values)
        camera = replace(CCD, prnu=tmp_path / name)
        np.testing.assert_allclose(camera.response((4, 5)), response)


def test_the_excess_noise_follows_the_gain():
    """2 by default, 1 without multiplication, also after `replace`; a given one stays."""
    assert (CCD.excess_noise, EMCCD.excess_noise, replace(EMCCD, em_gain=1).excess_noise) == (1, 2, 1)
    assert replace(EMCCD, excess_noise=1.4).excess_noise == 1.4
    with pytest.raises(DetectorError, match=r"'excess_noise' = 1\.4 goes with 'em_gain' > 1"):
        replace(CCD, excess_noise=1.4)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("em_gain", 0.5, r">= 1 electron out per electron in"),
        ("excess_noise", 0.9, r"in \[1, 2\.5\], 1 for photon counting, 2 for a multiplying register"),
        ("excess_noise", 3, r"in \[1, 2\.5\]"),
        ("spurious_charge", -1e-3, ">= 0 e-/px/frame"),
        ("prnu", 0.2, r"in \[0, 0\.1\]; above that give a map"),
    ],
)
def test_cameras_that_cannot_exist(name, value, words):
    with pytest.raises(DetectorError, match=f"'{name}' must be finite and {words}") as caught:
        replace(EMCCD, **{name: value})
    assert "\n" not in str(caught.value)


def test_maps_that_cannot_be_used(tmp_path):
    """NaN, values outside the range, another shape, three planes, text, a file that is missing or no map."""
    bad = np.ones((4, 4))
    bad[1, 2] = np.nan
    for name, values, words in (
        ("nan", bad, "1 values that are NaN or infinite"),
        ("negative", -np.ones((4, 4)), "must be > 0 e-/DN, got -1"),
        ("stack", np.ones((2, 4, 4)), r"must be numbers of shape \(h, w\), got float64 of shape \(2, 4, 4\)"),
    ):
        np.save(tmp_path / f"{name}.npy", values)
        with pytest.raises(DetectorError, match=words) as caught:
            replace(CCD, gain=tmp_path / f"{name}.npy")
        assert "\n" not in str(caught.value)
    with pytest.raises(DetectorError, match=r"'gain' = '.*none.fits' does not exist"):
        replace(CCD, gain="none.fits")
    (tmp_path / "a.exr").write_text("")
    with pytest.raises(DetectorError, match=r"'\.exr' is not read"):
        replace(CCD, gain=tmp_path / "a.exr")
    np.save(tmp_path / "prnu.npy", np.full((4, 4), -2.0))
    with pytest.raises(DetectorError, match="must be > 0 on every pixel"):
        replace(CCD, prnu=tmp_path / "prnu.npy")
    np.save(tmp_path / "small.npy", np.ones((4, 4)))
    with pytest.raises(DetectorError, match=r"'read_noise' = .* has 4 × 4 pixels, the pixels read out are 128 × 96"):
        replace(CCD, read_noise=tmp_path / "small.npy").expose(image(1.0), **SETTINGS)
    with pytest.raises(DetectorError, match="'full_well' must be a number"):
        replace(CCD, full_well="well.fits")


def test_toml_both_ways(sensor, tmp_path):
    camera, _ = sensor
    for one in (camera, EMCCD, replace(CCD, prnu=0.01)):
        one.to_toml(tmp_path / "again.toml")
        assert fspt.Detector.from_toml(tmp_path / "again.toml") == one


def test_typical_cameras_expose():
    for camera in (fspt.Detector.typical_emccd(), fspt.Detector.typical_scmos()):
        found = reduced(camera.expose(image(20.0), **SETTINGS, seed=1))
        assert found.power.mean() == pytest.approx(image(20.0).power.mean(), rel=0.15)
        assert not found.mask.any()


def test_images_of_no_detector_have_no_noise_model():
    assert NoiseModel.of(image(1.0)) is None
    with pytest.raises(ImageError, match=r"an excess noise of 0\.5"):
        NoiseModel.of(image(1.0, electrons_per_watt=1e18, excess_noise=0.5))


def test_the_verb_takes_registers_and_maps(tmp_path, run):
    np.save(tmp_path / "bias.npy", np.full(SHAPE, 321.0))
    image(5.0).write(tmp_path / "p.exr")
    options = ["--exposure-time", "60", "--wavelength-nm", "650", "--em-gain", "30", "--bias", tmp_path / "bias.npy"]
    assert run("expose", tmp_path / "p.exr", "-o", tmp_path / "e.exr", *options)[::2] == (0, "")
    known = read_image_or_exposure(tmp_path / "e.exr").metadata
    expected = {"em_gain": 30, "excess_noise": 2, "bias": 321, "bias_map": str(tmp_path / "bias.npy")}
    assert expected.items() <= known.items()
    code, _, err = run("expose", tmp_path / "p.exr", "-o", tmp_path / "f.exr", *options, "--excess-noise", "9")
    assert (code, err.count("\n")) == (2, 1)
    assert "'excess_noise' must be finite and in [1, 2.5]" in err
    assert not (tmp_path / "f.exr").exists()
