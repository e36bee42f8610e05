"""Saturation that the detector's numbers do not contain is found; noise, faint light, simulated counts are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.saturation import unknown_ceiling
from mitsuba_fspt.runtime.errors import DetectorError, ImageError

CCD = fspt.Detector.typical_ccd()
SETTINGS = {"exposure_time": 60.0, "wavelength_nm": 650.0}
PER_WATT = 0.85 * 60 * 650e-9 / (6.62607015e-34 * 299792458.0)
ROWS, COLUMNS = np.indices((64, 64)) - 31.5
SPOT = np.exp(-(ROWS**2 + COLUMNS**2) / 2 / 12**2)
CAMERAS = [CCD, replace(CCD, gain=10.0), replace(CCD, gain=0.5), replace(CCD, gain=78.0, bias=10, bits=10)]


def exposed(shape, electrons, seed=1, camera=CCD):
    """Counts of an image of this shape (h, w) with so many electrons at its brightest."""
    return camera.expose(fspt.Image(shape * electrons / PER_WATT), 60, 650, seed=seed).counts


def test_twelve_bits_in_sixteen_are_found(caplog):
    """Clipped at 4095 DN: these pixels are masked and told, and the others have their power.

    Seen to fail: no pixel masked, total 14 % too small.
    """
    image = fspt.Image(SPOT * 8000 / PER_WATT)
    found = CCD.reduce(np.minimum(exposed(SPOT, 8000), 4095), **SETTINGS)
    assert found.mask.sum() > 100
    assert (found.mask == (exposed(SPOT, 8000) >= 4095)).all()
    assert found.total_power == pytest.approx(image.power[found.kept].sum(), rel=2e-3)
    (told,) = [record.getMessage() for record in caplog.records]
    assert f"{found.masked} pixels of the counts have exactly the largest value, 4095 DN" in told
    assert "Correct 'bits' or 'full_well'" in told


def test_of_a_stack_the_pixels_that_reach_it_once_are_masked(caplog):
    """Also of a mean over frames, whose pixels all saturate in each."""
    stack = np.array([np.minimum(exposed(SPOT, 8000, seed), 4095) for seed in range(4)])
    found = CCD.reduce(stack, **SETTINGS)
    np.testing.assert_array_equal(found.mask, stack.max(axis=0) == 4095)
    mean = CCD.reduce(stack.mean(axis=0), **SETTINGS, frames=4)
    np.testing.assert_array_equal(mean.mask, stack.min(axis=0) == 4095)
    assert len(caplog.records) == 2


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"gain {camera.gain:g}")
@pytest.mark.parametrize("shape", [SPOT, np.ones((64, 64)), np.hypot(ROWS, COLUMNS) < 20], ids=["spot", "flat", "disc"])
def test_noise_makes_no_ceiling(shape, camera):
    """0 to 10,000 electrons, where faint light has two or three values: none of 20 seeds each is called saturated."""
    for electrons in (0, 1, 3, 10, 100, 1000, 10000):
        for seed in range(20):
            counts = exposed(shape.astype(float), electrons, seed, camera).astype(float)
            assert unknown_ceiling(camera, counts) is None


@pytest.mark.parametrize(
    "counts",
    [
        np.full((64, 64), 1000.0),
        np.rint(500 + 3000 * SPOT),
        500 + 3000.0 * (np.hypot(ROWS, COLUMNS) < 20),
        np.where(ROWS > 0, 1000.0, 500.0),
        np.rint(2000 + 15.2 * COLUMNS),
    ],
    ids=["uniform", "spot", "disc", "halves", "ramp"],
)
def test_counts_without_noise_have_no_ceiling(counts):
    """Simulated counts repeat values anywhere."""
    assert unknown_ceiling(CCD, counts) is None


def test_steps_of_smooth_counts_are_no_noise():
    """Noise of a third of a step of the converter. Seen to fail: a ceiling in 24 of 300 frames of such spots."""
    coarse = replace(CCD, gain=10.0)
    rows, columns = np.indices((128, 128)) - 63.5
    for electrons in (3, 10, 100, 1000):
        spot = np.exp(-(rows**2 + columns**2) / 2 / 24**2)
        for seed in range(6):
            assert unknown_ceiling(coarse, exposed(spot, electrons, seed, coarse).astype(float)) is None
        assert unknown_ceiling(coarse, np.rint(500 + electrons * spot / 10)) is None


@pytest.mark.parametrize("value", [0, 500])
def test_areas_of_one_value_hide_no_ceiling(value):
    """What is around the spot was cleared, or two columns have no response. Seen to fail: counts without noise."""
    counts = np.minimum(exposed(SPOT, 8000), 4095).astype(float)
    cleared = np.where(np.hypot(ROWS, COLUMNS) > 25, value, counts)
    assert unknown_ceiling(CCD, cleared) == 4095
    assert unknown_ceiling(CCD, np.where(COLUMNS < -30, value, counts)) == 4095


def test_counts_that_are_all_at_the_ceiling(caplog):
    """12 bits in 16, also of a flat field. Seen to be taken for a uniform image."""
    full = np.full((64, 64), 4095, np.uint16)
    assert unknown_ceiling(CCD, full.astype(float)) == 4095
    assert CCD.reduce(full, **SETTINGS).masked == full.size
    with pytest.raises(DetectorError, match="no usable pixel: 4096 are saturated"):
        CCD.reduce(exposed(SPOT, 2000), **SETTINGS, flat=full, flat_kind="sensor", flat_dark=500)


@pytest.mark.parametrize(("camera", "top"), list(zip(CAMERAS, (4095, 1023, 16383, 255), strict=True)))
def test_ceilings_of_other_cameras_are_found(camera, top):
    """10 bits of 10 e-/DN, 14 bits of 0.5, 8 bits of 78, each three times over its range."""
    counts = np.minimum(exposed(SPOT, 3 * top * camera.gain, camera=replace(camera, bits=16)), top)
    assert unknown_ceiling(replace(camera, bits=16), counts.astype(float)) == top


def test_counts_of_a_shifted_converter():
    """14 bits shifted to 16: all counts are multiples of 4 DN. The limit 4 · 16383 is found, and no other."""
    camera = replace(CCD, gain=0.4, full_well=1e6)
    counts = [4.0 * exposed(SPOT, electrons, camera=replace(camera, gain=1.6)) for electrons in (50, 2000, 60000)]
    for free in counts[:2]:
        assert unknown_ceiling(camera, free) is None
    assert unknown_ceiling(camera, np.minimum(counts[2], 4 * 16383)) == 4 * 16383


def test_stacks_with_the_frames_last_are_refused():
    """(64, 64, 5) is no stack of 64 frames; (100, 32, 32) and (5, 64, 64) are stacks; `frames` says which it is."""
    counts = np.random.default_rng(1).poisson(500, (64, 64, 5))
    with pytest.raises(ImageError, match="would be 64 frames of 5 × 64 pixels, and look like 5 frames of 64 × 64"):
        CCD.reduce(counts, **SETTINGS)
    assert CCD.reduce(counts, **SETTINGS, frames=64).shape == (64, 5)
    assert CCD.reduce(np.moveaxis(counts, -1, 0), **SETTINGS).shape == (64, 64)
    assert CCD.reduce(np.random.default_rng(1).poisson(500, (100, 32, 32)), **SETTINGS).shape == (32, 32)
    with pytest.raises(ImageError, match="have 64 frames, 'frames' is 5"):
        CCD.reduce(counts, **SETTINGS, frames=5)


def test_a_mean_of_frames_has_their_noise():
    """Ten frames, as a stack and as their mean with `frames`: the same image and errors, which fit the scatter."""
    stack = np.array([exposed(SPOT, 1000, seed) for seed in range(10)])
    whole, mean = CCD.reduce(stack, **SETTINGS), CCD.reduce(stack.mean(axis=0), **SETTINGS, frames=10)
    np.testing.assert_allclose(mean.power, whole.power, rtol=1e-12)
    np.testing.assert_allclose(mean.error, whole.error, rtol=1e-12)
    assert mean.metadata == whole.metadata
    chi2 = ((mean.power - SPOT * 1000 / PER_WATT) / mean.error) ** 2
    assert chi2.mean() == pytest.approx(1, abs=4 * (2 / chi2.size) ** 0.5)
    with pytest.raises(ImageError, match="'frames' must be >= 1, got 0"):
        CCD.reduce(stack[0], **SETTINGS, frames=0)


def test_bad_pixels_are_masked(tmp_path):
    """From an array of True and False and from a file; another size is refused."""
    bad = np.zeros((64, 64), bool)
    bad[3, 4] = bad[:, 10] = True
    np.save(tmp_path / "bad.npy", bad)
    np.save(tmp_path / "numbers.npy", bad.astype(np.uint8))
    for given in (bad, tmp_path / "bad.npy", tmp_path / "numbers.npy"):
        np.testing.assert_array_equal(CCD.reduce(exposed(SPOT, 100), **SETTINGS, bad_pixels=given).mask, bad)
    with pytest.raises(ValueError, match="'bad_pixels' has the shape"):
        CCD.reduce(exposed(SPOT, 100), **SETTINGS, bad_pixels=bad[1:])
