"""Regions of interest: their pixels, the light from them, and what is no region."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import tifffile
from small_scenes import SIDE, camera_scene, disk

import mitsuba_fspt as fspt
from mitsuba_fspt.images.regions import Measurement, measure, region_mask
from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.runtime.errors import ImageError

PER_JOULE = 660e-9 / (6.62607015e-34 * 299792458.0)


@pytest.fixture(scope="module")
def image(mono):
    """A disk of radius 9 mm in focus, 2 W/mm²."""
    return fspt.render(camera_scene(disk(165, 9.0), exitance=2.0), method="integral", rtol=1e-4)


def test_the_flux_of_a_disk_is_its_power(image):
    """All its pixels: π L A = J_n π r² in photons. Seen to fail with 4π for π."""
    found = measure(image, light=Light.given(660))
    assert found.total_flux == pytest.approx(2.0 * math.pi * 81 * PER_JOULE, rel=1e-4)
    assert found.power == pytest.approx(image.power.sum())
    assert found.pixels == image.power.size
    assert found.area == pytest.approx(image.power.size * SIDE**2 / 100)


def test_radiance_within_the_disk(image):
    found = measure(image, "circle:20,16,8", Light.given(660))
    expected = 200 / math.pi * PER_JOULE
    assert (found.mean_radiance, found.max_radiance) == pytest.approx((expected, expected), rel=1e-4)
    assert found.min_radiance <= found.mean_radiance <= found.max_radiance
    assert found.sd_radiance < 1e-4 * expected
    assert found.area == pytest.approx(math.pi * (8 * SIDE) ** 2 / 100, rel=0.04)
    assert 0 < found.mean_radiance_error < 1e-3 * expected
    assert found.total_flux_error == pytest.approx(math.pi * found.area * found.mean_radiance_error)
    by_mask = measure(image, region_mask(image, "circle:20,16,8"), Light.given(660))
    assert by_mask == found


def test_errors_of_monte_carlo_add_up_in_squares_and_bounds_add_up(image):
    lens = {key: image.metadata[key] for key in ("focal_length", "f_number", "focus_distance", "pixel_pitch")}
    flat = {}
    for method in ("integral", "path"):
        plain = fspt.Image(np.full((5, 5), 1e-9), np.full((5, 5), 1e-11), metadata=lens | {"method": method})
        flat[method] = measure(plain, light=Light.given(660))
    assert flat["integral"].mean_radiance_error == pytest.approx(0.01 * flat["integral"].mean_radiance, rel=1e-3)
    assert flat["path"].mean_radiance_error == pytest.approx(0.01 / 5 * flat["path"].mean_radiance, rel=1e-3)
    assert measure(fspt.Image(np.ones((2, 2)), metadata=lens), light=Light.given(660)).total_flux_error is None


def test_the_gain_error_of_counts_does_not_average_out(image):
    """2 % of each of 900 pixels by noise and 5 % of all of them by the gain: 5.0 % of the flux, it was 0.07 %."""
    lens = {key: image.metadata[key] for key in ("focal_length", "f_number", "focus_distance", "pixel_pitch")}
    power = np.full((30, 30), 1e-9)
    found = measure(fspt.Image(power, 0.02 * power, metadata=lens | {"gain_error": 0.05}), light=Light.given(660))
    share = np.hypot(0.02 / 30, 0.05)
    assert found.total_flux_error == pytest.approx(share * found.total_flux, rel=1e-3)
    assert found.mean_radiance_error == pytest.approx(share * found.mean_radiance, rel=1e-3)


def test_pixels_of_regions():
    """By hand, on a ramp of 4 × 5 pixels."""
    ramp = fspt.Image(np.arange(1.0, 21.0).reshape(4, 5))
    assert np.argwhere(region_mask(ramp, "1,2,3,1")).tolist() == [[2, 1], [2, 2], [2, 3]]
    assert np.argwhere(region_mask(ramp, "circle:2.5,1.5,1")).tolist() == [[0, 2], [1, 1], [1, 2], [1, 3], [2, 2]]
    assert ramp.power[region_mask(ramp, "90%")].tolist() == [18, 19, 20]


def test_a_mask_of_another_program(tmp_path):
    ramp = fspt.Image(np.arange(1.0, 21.0).reshape(4, 5))
    drawn = np.zeros((4, 5), np.uint8)
    drawn[1, 2:] = 255
    tifffile.imwrite(tmp_path / "mask.tif", drawn)
    assert ramp.power[region_mask(ramp, str(tmp_path / "mask.tif"))].tolist() == [8, 9, 10]
    outside = np.where(drawn > 0, 1, np.nan).astype(np.float32)  # seen to count as inside
    tifffile.imwrite(tmp_path / "nan.tif", outside)
    assert ramp.power[region_mask(ramp, str(tmp_path / "nan.tif"))].tolist() == [8, 9, 10]
    tifffile.imwrite(tmp_path / "small.tif", drawn[:2])
    tifffile.imwrite(tmp_path / "empty.tif", np.zeros((4, 5), np.uint8))
    (tmp_path / "text.tif").write_text("no picture")
    for name, message in (
        ("small.tif", r"a mask of shape \(2, 5\) does not fit the image of 5 x 4 pixels"),
        ("empty.tif", "no pixel of the image lies in it"),
        ("text.tif", "is damaged, or no TIFF file"),
        ("gone.tif", "there is no such file"),
    ):
        with pytest.raises(ImageError, match=message):
            region_mask(ramp, str(tmp_path / name))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3", "must be x,y,width,height, circle:x,y,radius, 25% or mask.tif, in pixels"),
        ("a,b,c,d", "must be x,y,width,height"),
        ("circle:1,2", "must be x,y,width,height"),
        ("", "must be x,y,width,height"),
        ("0,0,1.5,1", "a rectangle has whole pixels"),
        ("-1,0,2,2", "a rectangle has whole pixels, x and y from 0"),
        ("0,0,0,1", "a rectangle has whole pixels"),
        ("3,0,3,1", "reaches beyond the image of 5 x 4 pixels"),
        ("circle:50,50,2", "no pixel of the image lies in it"),
        ("0%", "a threshold is above 0% and at most 100%"),
        ("101%", "a threshold is above 0% and at most 100%"),
        ("nan%", "must be x,y,width,height"),
    ],
)
def test_texts_that_are_no_region(text, message):
    with pytest.raises(ImageError, match=re.escape(message)) as caught:
        region_mask(fspt.Image(np.arange(1.0, 21.0).reshape(4, 5)), text)
    assert "\n" not in str(caught.value)


def test_the_verb(image, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image.write("a.h5")
    image.write("b.exr")
    words = ("roi", "a.h5", "b.exr", "--wavelength-nm", "660", "--roi", "circle:20,16,8", "--roi", "50%")
    code, out, err = run(*words, "--json")
    assert (code, err) == (0, "")
    rows = json.loads(out)
    assert [(row["image"], row["region"]) for row in rows] == [
        (name, region) for name in ("a.h5", "b.exr") for region in ("circle:20,16,8", "50%")
    ]
    expected = measure(fspt.read("a.h5"), "circle:20,16,8", Light.given(660))
    assert Measurement(**{key: value for key, value in rows[0].items() if key not in ("image", "region")}) == expected
    code, out, err = run(*words)
    assert (code, err) == (0, "")
    heading, *lines = out.splitlines()
    assert heading.startswith("image,region,total_flux [photons/s],total_flux_error [photons/s],mean_radiance [")
    assert len(lines) == 4
    assert float(lines[0].split('",')[1].split(",")[0]) == pytest.approx(expected.total_flux, rel=1e-5)
    assert run(*words, "-o", "roi.csv", "--quiet") == (0, "", "")
    assert (tmp_path / "roi.csv").read_text() == out
    for more, message in (
        (("--roi", "7"), "region '7': must be x,y,width,height"),
        (("-o", "roi.txt"), "must end in .csv"),
    ):
        code, out, err = run(*words, *more)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert message in err
    code, out, err = run("roi", "b.exr")
    assert (code, out) == (2, "")
    assert "photons need a wavelength" in err


def test_render_in_photons(run, tmp_path, monkeypatch):
    """What is written and printed is in the unit, the total stays in W. Nothing is written of what is refused."""
    from small_scenes import write_scene

    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "s.xml")
    words = ("render", "s.xml", "--rtol", "1e-2", "-o", "a.npz", "--unit")
    code, out, err = run(*words, "p/s/cm2/sr", "--wavelength-nm", "660", "--json")
    assert (code, err) == (0, "")
    (told,) = json.loads(out)["images"]
    assert told["unit"] == "photons/s/cm²/sr"
    with np.load("a.npz") as file:
        assert float(file["radiance"].max()) == pytest.approx(told["peak"], rel=1e-6)
    assert told["peak"] == pytest.approx(100 * 1e-3 / math.pi * PER_JOULE, rel=1e-3)
    for more, message in (
        (("photons/s",), "photons need a wavelength"),
        (("lux",), "'unit' must be one of"),
        (("W", "--wavelength-nm", "660"), "has no meaning for watts"),
    ):
        (tmp_path / "a.npz").unlink(missing_ok=True)
        code, out, err = run(*words, *more)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert message in err
        assert not (tmp_path / "a.npz").exists()
