"""Masked pixels, such as saturated ones, hold 0 W: comparison, regions and totals of images leave them out."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.detector import Detector
from mitsuba_fspt.images.comparison import compare
from mitsuba_fspt.images.picture import title
from mitsuba_fspt.images.regions import measure, region_mask
from mitsuba_fspt.images.z_test import differences
from mitsuba_fspt.runtime.errors import ImageError

LENS = {"focal_length": 55.0, "f_number": 8.0, "focus_distance": 165.0, "pixel_pitch": 0.0135}
PER_WATT = 0.85 * 600 * 650e-9 / (6.62607015e-34 * 299792458.0)


def cut(image, rows):
    """The rows of an image, which have no mask."""
    return fspt.Image(image.power[rows], None if image.error is None else image.error[rows], metadata=image.metadata)


@pytest.fixture(scope="module")
def true():
    """A ramp from 1 to 2 full wells downwards on its lower half, and of 0.1 to 0.9 on its upper one."""
    levels = np.concatenate([np.linspace(0.1, 0.9, 12), np.linspace(1.1, 2, 12)]) * 1e5
    return fspt.Image(np.outer(levels, np.ones(16)) / PER_WATT, metadata=LENS)


@pytest.fixture(scope="module")
def saturated(true):
    """Exposed and reduced: the lower half is masked."""
    camera = Detector.typical_ccd()
    counts = camera.expose(true, 600, 650).counts
    image = camera.reduce(counts, exposure_time=600, wavelength_nm=650, metadata=LENS)
    assert image.mask[12:].all()
    assert not image.mask[:12].any()
    return image


def numbers(test):
    """The fields of a z-test that are there."""
    return {name: value for name, value in asdict(test).items() if value is not None}


@pytest.mark.parametrize("swapped", [False, True])
def test_a_comparison_leaves_out_what_either_image_masks(true, saturated, swapped):
    """It is that of the other pixels alone. Seen to fail with a ratio of 0.24 for 1."""
    order = (true, saturated) if swapped else (saturated, true)
    found, expected = compare(*order), compare(*(cut(image, slice(12)) for image in order))
    assert found.ratio == pytest.approx(1, abs=0.01)
    assert (found.masked, expected.masked) == (192, 0)
    for name in ("me", "cf", "max_error", "rms", "ratio"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-12)
    assert numbers(found.z_test) == pytest.approx(numbers(expected.z_test), rel=1e-12)
    assert found.profiles[0].index == expected.profiles[0].index
    assert found.to_dict()["masked"] == 192
    assert "masked 192   pixels" in found.render_text()
    assert "masked" not in expected.render_text()
    assert np.isnan(differences(*order)[12:]).all()


def test_bounds_are_compared_on_the_other_pixels_alone():
    """Seen to fail with the masked pixel counted beyond."""
    mask = np.array([[False, False], [False, True]])
    first = fspt.Image([[1.0, 2.0], [3.0, 0.0]], np.full((2, 2), 0.1), metadata={"method": "integral"}, mask=mask)
    second = fspt.Image([[1.0, 2.0], [4.0, 9.0]], np.full((2, 2), 0.1), metadata={"method": "integral"})
    assert compare(first, second).beyond == 1
    assert compare(first, second).max_error == 0.25


def test_nothing_is_left_to_compare():
    image = fspt.Image([[1.0, 2.0]], mask=np.array([[True, False]]))
    other = fspt.Image([[1.0, 2.0]], mask=np.array([[False, True]]))
    with pytest.raises(
        ImageError, match="every pixel is masked in one of the images, 1 in the calculated one and 1 in"
    ):
        compare(image, other)


def test_a_region_measures_the_others(true, saturated):
    """Mean and smallest radiance are those of the pixels that are not masked. Seen to fail with 96 pixels."""
    found = measure(saturated, "2,4,6,16")
    expected = measure(saturated, "2,4,6,8")
    assert (found.masked, expected.masked, found.pixels) == (48, 0, 48)
    assert asdict(found) == pytest.approx(asdict(expected) | {"masked": 48}, rel=1e-12)
    assert found.min_radiance > 0
    with pytest.raises(ImageError, match="region '0,12,4,4': all its 16 pixels are masked"):
        measure(saturated, "0,12,4,4")


def test_a_threshold_refers_to_the_brightest_pixel_that_is_not_masked():
    image = fspt.Image([[1.0, 3.0, 4.0, 100.0]], mask=np.array([[False, False, False, True]]))
    assert region_mask(image, "50%").tolist() == [[False, True, True, False]]


def test_totals_leave_them_out():
    image = fspt.Image([[1.0, 3.0, 100.0]], mask=np.array([[False, False, True]]))
    assert (image.total_power, image.masked) == (4, 1)
    assert title(image) == "total 4 W"
    assert "4 W in all" in repr(image)
    assert "1 pixels, left out of the total" in image._repr_html_()


def test_the_verbs_say_so(run, true, saturated, tmp_path, monkeypatch):
    """A line on stderr for each image, and the number in the record."""
    monkeypatch.chdir(tmp_path)
    true.write("true.npz")
    saturated.write("seen.npz")
    code, out, err = run("compare", "seen.npz", "true.npz", "--json", "--png", "c.png")
    assert (code, json.loads(out)["masked"]) == (0, 192)
    assert "fspt: compare: 192 pixels masked in either image are left out.\n" in err
    code, out, err = run("roi", "seen.npz", "--roi", "2,4,6,16", "--roi", "0,0,2,2", "--json")
    assert (code, [row["masked"] for row in json.loads(out)]) == (0, [48, 0])
    assert err == (
        "fspt: seen.npz, region 2,4,6,16: 48 masked pixels are left out; its numbers are those of the 48 others.\n"
    )
    code, out, err = run("plot", "true.npz", "seen.npz", "--json")
    assert (code, json.loads(out)["masked"]) == (0, [0, 192])
    assert err == "fspt: plot: total powers leave out masked pixels: 192 of seen.npz.\n"


def test_expose_reports_that_masked_pixels_get_no_light(saturated, caplog):
    """Seen to fail: nothing was said, and the counts of masked pixels are those of the dark."""
    again = Detector.typical_ccd().expose(saturated, 600, 650)
    assert "expose: 192 masked pixels have no known power" in caplog.text
    assert again.counts[saturated.mask].max() < 600 < again.counts[~saturated.mask].min()
