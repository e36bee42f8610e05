"""`fspt.render`: what may be asked for, what comes back, and that the error it states is its error."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt.runtime import backend

backend.ensure_variant()

import mitsuba as mi  # noqa: E402
from small_scenes import ball, camera_scene, disk, lens, look_at_crop, world_scene, write_scene  # noqa: E402

import mitsuba_fspt as fspt  # noqa: E402
from mitsuba_fspt.rendering.monte_carlo import standard_error  # noqa: E402
from mitsuba_fspt.runtime.errors import SceneError  # noqa: E402


@pytest.fixture(scope="module")
def scene():
    """Two cameras on one sphere: 0 sees it as in every test here, 1 is stopped down and has another film."""
    second = lens(size=(5, 4), f_number=16.0)
    return mi.load_dict(
        {"type": "scene", "integrator": {"type": "fspt_integral", "rtol": 1e-2}, "a": lens(size=8), "b": second}
        | {"ball": ball(radius=3.0)}
    )


def test_an_image_has_power_error_coverage_and_metadata(scene):
    image = fspt.render(scene)
    assert image.power.shape == image.error.shape == image.coverage.shape == (8, 8)
    assert 0 < image.error.max() < 2e-2 * image.power.max()
    assert image.coverage.min() == 0
    assert image.coverage.max() == pytest.approx(1)
    assert image.power[image.coverage == 0].max() == 0
    told = image.metadata
    assert told["method"] == "integral"
    assert told["rtol"] == 1e-2
    assert told["domain"] == "pupil"
    assert told["nodes"] > 0
    assert told["wall_time"] > 0
    assert told["variant"] == mi.variant()


def test_the_integral_gives_the_same_bits_every_time(scene):
    first, again = fspt.render(scene), fspt.render(scene)
    np.testing.assert_array_equal(first.power, again.power)
    np.testing.assert_array_equal(first.error, again.error)


def test_a_scene_file_may_be_given_in_place_of_a_scene(tmp_path):
    path = write_scene(tmp_path / "s.xml")
    image = fspt.render(str(path), max_nodes=4)
    np.testing.assert_array_equal(image.power, fspt.render(fspt.load(path), max_nodes=4).power)
    assert image.metadata["scene"] == str(path)


def test_settings_overrule_the_scenes_own(scene):
    tight = fspt.render(scene, rtol=1e-3)
    assert tight.metadata["rtol"] == 1e-3
    assert tight.metadata["nodes"] > fspt.render(scene).metadata["nodes"]
    for settings in ({"domain": "surface"}, {"pixel": "centre"}, {"max_nodes": 4}):
        ((name, value),) = settings.items()
        assert fspt.render(scene, **settings).metadata[name] == value
    assert fspt.render(scene).metadata["rtol"] == 1e-2  # the scene is as it was


def test_any_sensor_of_the_scene(scene):
    images = [fspt.render(scene, sensor=number, rtol=1e-2) for number in (0, 1)]
    assert images[1].shape == (4, 5)
    assert images[1].metadata["f_number"] == 16
    assert [image.metadata["sensor"] for image in images] == [0, 1]
    # A quarter of the light through half the aperture.
    assert images[1].power.sum() == pytest.approx(images[0].power.sum() / 4, rel=1e-2)
    for number in (2, -1):
        with pytest.raises(SceneError, match=f"sensor {number} does not exist, the scene has 2"):
            fspt.render(scene, sensor=number)


@pytest.mark.parametrize("method", ["path", "ptracer"])
def test_monte_carlo_repeats_by_its_seed(scene, method):
    options = {"method": method, "spp": 4}
    first, again, other = (fspt.render(scene, seed=seed, **options) for seed in (5, 5, 6))
    # Light tracers add to the film in any order; paths do not.
    np.testing.assert_allclose(first.power, again.power, rtol=1e-6 * (method == "ptracer"))
    assert np.abs(first.power - other.power).max() > 1e-3 * first.power.max()
    assert first.metadata["seed"] == 5
    assert (first.metadata["spp"], first.metadata["passes"]) == (4, 4)
    assert fspt.render(scene, seed=(1 << 32) - 1, **options).metadata["seed"] == (1 << 32) - 1


@pytest.mark.parametrize("method", ["path", "ptracer"])
def test_the_standard_error_of_monte_carlo_is_its_scatter(scene, method):
    """Mean z² between independent images is near 1 (1.07 for errors from 32 passes)."""
    images = [fspt.render(scene, method=method, spp=64, seed=seed) for seed in range(5)]
    assert (images[0].metadata["spp"], images[0].metadata["passes"]) == (64, 32)
    power = np.array([image.power for image in images])
    error = np.array([image.error for image in images])
    lit = (power.min(axis=0) > 0) & (error.min(axis=0) > 1e-3 * power.max())  # leaves out what does not scatter
    assert lit.sum() >= 8
    mean_square = (power[:, lit].var(axis=0, ddof=1) / np.square(error[:, lit]).mean(axis=0)).mean()
    assert 0.6 < mean_square < 1.6


@pytest.mark.parametrize("method", ["path", "ptracer"])
def test_pixels_that_no_sample_met_have_the_error_of_a_single_one(method):
    """Expected: the light that few samples miss on the pixels of the rim is within some errors. Fails with none (0)."""
    scene = world_scene(ball(radius=3.0), sensor=lens(size=48, pixel_pitch=0.1, f_number=2.8))
    exact = fspt.render(scene, rtol=1e-2).power
    missed, error = [], []
    for seed in range(4):
        image = fspt.render(scene, method=method, spp=4, seed=seed)
        dark = (image.power == 0) & (exact > 0)
        missed.append(exact[dark])
        error.append(image.error[dark])
    missed, error = np.concatenate(missed), np.concatenate(error)
    assert len(missed) > 8
    assert (missed < 4 * error).mean() > 0.9


def test_pixels_at_a_border_that_no_sample_missed_have_the_error_of_a_single_miss():
    """Expected: the darkness that few samples find on pixels inside a blurred rim is within some errors.

    Fails for one in twelve of these pixels, by 26 errors, with their scatter alone.
    """
    scene = world_scene(ball(radius=3.0), sensor=lens(size=48, pixel_pitch=0.1, f_number=2.8))
    look_at_crop(scene, 8, 8, 32, 32)
    exact = fspt.render(scene, rtol=3e-3)
    rim = (exact.coverage > 0.9) & (exact.coverage < 0.999)
    off, error = [], []
    for seed in range(4):
        image = fspt.render(scene, method="path", spp=256, seed=seed)
        bright = rim & (image.power > exact.power)
        off.append((image.power - exact.power)[bright])
        error.append(np.hypot(image.error, exact.error)[bright])
    off, error = np.concatenate(off), np.concatenate(error)
    assert len(off) > 50
    assert (off < 4 * error).mean() > 0.98


@pytest.mark.parametrize("expected", [2.0, 5.0, 12.0])
def test_a_few_events_on_a_pixel_are_off_by_the_root_of_how_many_to_expect(expected):
    """Poisson's events, counted in 32 passes. Expected: errors like those of a normal law, but for the skew of few.

    Fails with the scatter of each pixel alone: it is off by 5.5 errors where 5 events are to be expected, by 11 where
    12 are.
    """
    passes, draw = 32, np.random.default_rng(1)
    counts = draw.poisson(expected / passes, (passes, 128, 128)).astype(float)
    mean = counts.mean(axis=0)
    error = standard_error(mean, np.square(counts).mean(axis=0), passes, samples=1 << 10)
    off = mean - expected / passes
    # What no event met has the error of one at least: of two to expect a little too large.
    assert 0.83 < np.mean(off**2) / np.mean(error**2) < 1.05
    assert 0.8 < np.mean((off / error) ** 2) < 1.05
    assert np.abs(off / error).max() < 5


@pytest.mark.parametrize("share", [1e-3, 4e-3])
def test_a_dark_edge_that_no_sample_met_has_the_error_of_one_sample(share):
    """The border of bright and dark checks cuts off a `share` of each pixel of a column; 256 samples a pixel.

    Expected: no pixel is off by more than 5 errors, on either side of the border. Most pixels of the column have no
    sample beyond the border, nor have their neighbours. Fails with the scatter of pixels and neighbours alone, 0.
    """
    passes, each, draw = 32, 8, np.random.default_rng(2)
    for first, second in ((1.0, 0.1), (0.1, 1.0)):
        beyond = np.zeros((64, 64))
        beyond[:, 32:], beyond[:, 31] = 1.0, share
        met = draw.binomial(each, beyond, (passes, 64, 64)) / each
        counts = first + (second - first) * met
        mean = counts.mean(axis=0)
        error = standard_error(mean, np.square(counts).mean(axis=0), passes, samples=passes * each)
        off = np.abs(mean - (first + (second - first) * beyond))[:, 31]
        assert off.max() > 0
        assert (off < 5 * error[:, 31]).all()


def test_samples_may_be_few(scene):
    image = fspt.render(scene, method="path", spp=2)
    assert image.metadata["passes"] == 2
    assert image.error.max() > 0


def test_a_scene_without_integrator_takes_the_integral():
    scene = mi.load_dict({"type": "scene", "lens": lens(), "ball": ball()})
    assert fspt.render(scene, max_nodes=4).metadata["method"] == "integral"


def test_the_scenes_own_monte_carlo_is_taken():
    scene = world_scene(
        ball(), integrator={"type": "path", "max_depth": 1}, sensor=lens(sampler={"type": "independent"})
    )
    image = fspt.render(scene, spp=4)
    assert image.metadata["method"] == "path"
    assert "Independent" in image.metadata["sampler"]
    assert fspt.render(scene, method="integral", max_nodes=4).metadata["method"] == "integral"


@pytest.mark.parametrize("options", [{"max_nodes": 40}, {"method": "path", "spp": 4}])
def test_progress_is_reported(scene, options):
    told = []
    fspt.render(scene, progress=lambda what, share: told.append((what, share)), **options)
    assert {what for what, _ in told} == ({"integrating"} if "max_nodes" in options else {"sampling"})
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert min(shares) >= 0
    assert max(shares) <= 1


def test_exitance_scales_the_image_without_clipping():
    """Twelve decades."""
    sums = [fspt.render(world_scene(ball(j)), max_nodes=4).power.sum() / j for j in (1e-6, 1.0, 1e6)]
    np.testing.assert_allclose(sums, sums[0], rtol=1e-5)


WRONG = {
    "unknown method": ({"method": "raytrace"}, "'method' must be one of integral, path, ptracer, got 'raytrace'"),
    "samples for the integral": ({"spp": 4}, "'spp' = 4 has no meaning for integral"),
    "seed for the integral": ({"seed": 4}, "'seed' = 4 has no meaning for integral"),
    "accuracy for path": ({"method": "path", "rtol": 1e-3}, "'rtol' = 0.001 has no meaning for Monte Carlo"),
    "no samples": ({"method": "path", "spp": 0}, "'spp' must be >= 2 for a standard error, got 0"),
    "one sample": ({"method": "path", "spp": 1}, "'spp' must be >= 2 for a standard error, got 1"),
    "negative seed": ({"method": "path", "seed": -1}, "'seed' must be in 0"),
    "huge seed": ({"method": "ptracer", "seed": 1 << 32}, "'seed' must be in 0"),
    "rtol 0": ({"rtol": 0.0}, "'rtol' must be in (0, 1), got 0"),
    "rtol 1": ({"rtol": 1.0}, "'rtol' must be in (0, 1), got 1"),
    "rtol nan": ({"rtol": float("nan")}, "'rtol' must be in (0, 1), got nan"),
    "domain": ({"domain": "sphere"}, "'domain' must be one of pupil, surface, got 'sphere'"),
    "pixel": ({"pixel": "corner"}, "'pixel' must be one of area, centre, got 'corner'"),
    "rtol as text": ({"rtol": "1e-3"}, "'rtol' must be a number, got '1e-3'. Give for example 1e-3"),
    "rtol beyond floats": ({"rtol": 10**400}, "'rtol' must be in (0, 1), got inf"),
    "rtol in a list": ({"rtol": np.array([1e-3])}, "'rtol' must be a number, got array([0.001]). Give"),
    "half a node": ({"max_nodes": 100.5}, "'max_nodes' must be a whole number, got 100.5. Give for example 65536"),
    "nodes without end": ({"max_nodes": float("inf")}, "'max_nodes' must be a whole number, got inf"),
    "sensor as text": ({"sensor": "0"}, "'sensor' must be a whole number, got '0'. Give for example 0"),
    "half a sample": ({"method": "path", "spp": 16.5}, "'spp' must be a whole number, got 16.5. Give for example 256"),
    "seed as text": ({"method": "path", "seed": "1"}, "'seed' must be a whole number, got '1'. Give for example 1"),
    "max_nodes": ({"max_nodes": 0}, "'max_nodes' must be >= 1, got 0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_settings_without_effect_are_refused(scene, name):
    options, message = WRONG[name]
    with pytest.raises(SceneError) as refused:
        fspt.render(scene, **options)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_numbers_of_numpy_and_arrays_without_axes_are_numbers(scene, tmp_path):
    """Seen to fail when written: an array is no metadata."""
    plain = fspt.render(scene, sensor=1, rtol=0.5, max_nodes=100)
    image = fspt.render(scene, sensor=np.int8(1), rtol=np.array(0.5), max_nodes=np.uint8(100))
    np.testing.assert_array_equal(image.power, plain.power)
    image.write(tmp_path / "a.exr")
    plain.metadata["wall_time"] = image.metadata["wall_time"]
    assert image.metadata == plain.metadata
    plain, image = (fspt.render(scene, method="path", spp=kind(4), seed=kind(3)) for kind in (int, np.array))
    np.testing.assert_array_equal(image.power, plain.power)
    image.write(tmp_path / "a.exr")


def test_a_scene_of_another_variant_has_a_message_of_its_own(scene):
    """Seen to fail: 'Broadcast from type mitsuba.Shape to type mitsuba.Shape failed'."""
    before = mi.variant()
    other = before.replace("rgb", "mono") if "rgb" in before else before.replace("mono", "rgb")
    mi.set_variant(other)
    try:
        with pytest.raises(SceneError, match=rf"in the variant {before}, .* the active one is {other}\. Load"):
            fspt.render(scene)
    finally:
        mi.set_variant(before)
    for wrong in (None, 5, scene.sensors()[0]):
        with pytest.raises(SceneError, match=r"must be a Mitsuba scene or the name of a file, got \w+\. Give"):
            fspt.render(wrong)


def test_only_a_lens_makes_watts():
    scene = mi.load_dict({"type": "scene", "eye": {"type": "perspective"}, "ball": ball()})
    for options in ({}, {"method": "path", "spp": 4}):
        with pytest.raises(SceneError, match=r"power on a pixel needs a lens. Use a sensor of type 'fspt_lens'"):
            fspt.render(scene, **options)


def test_a_dark_image_keeps_the_warning_of_light_left_out(mono):
    """A surface that faces a wall behind it: no light comes straight, some by the wall, and both are reported.

    Seen to fail: that the image is dark took the place of the light left out.
    """
    wall = {**disk(165, 100.0), "bsdf": {"type": "diffuse", "reflectance": 0.8}}
    image = fspt.render(camera_scene(disk(120, 10.0, tilt=180), bodies=[wall]), method="integral")
    assert not image.power.any()
    left_out, dark = image.metadata["warnings"].split("; ")
    assert "which Eq. 9 leaves out" in left_out
    assert dark.startswith("the picture is dark")


def test_a_wall_lit_from_outside_the_image_is_reported(mono):
    """No emitter is in the image: Monte Carlo shows the wall, the integral nothing, and says so.

    Seen to fail: without a pixel that can see an emitter nothing was estimated.
    """
    wall = {**disk(165, 100.0), "bsdf": {"type": "diffuse", "reflectance": 0.8}}
    scene = camera_scene({**ball(), "center": [90.0, 0.0, 140.0]}, bodies=[wall])
    image = fspt.render(scene, method="integral")
    assert not image.power.any()
    assert image.metadata["light_left_out"] == 1
    assert "which Eq. 9 leaves out" in image.metadata["warnings"]
    assert fspt.render(scene, method="path", spp=16, max_depth=2).power.sum() > 0
