"""The circular image-plane stop: nothing beside it, exactly the part inside on the pixels that its border cuts."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from small_scenes import (
    FOCUS,
    HEIGHT,
    PITCH,
    RADIUS,
    SIDE,
    WIDTH,
    camera_scene,
    configuration_factor,
    disk,
    glow,
    power,
    sphere,
)

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.thin_lens import Lens
from mitsuba_fspt.runtime.errors import OpticsError

pytestmark = pytest.mark.usefixtures("mono")

STOP = 10.0  # mm, 25 pixels across
SHARP, BLURRED = FOCUS, 110.0  # places of a disk that fills every line of sight [mm]


def inside_stop(stop, function, strips=2000):
    """Mean over every virtual pixel of a function of the distance from the axis [mm], 0 beside the stop.

    Strips of every row of pixels, on each the stretch inside the stop by four Gauss nodes.
    """
    radius = stop * SIDE / PITCH / 2
    node, weight = np.polynomial.legendre.leggauss(4)
    edges = (np.arange(WIDTH + 1) - WIDTH / 2) * SIDE
    means = np.zeros((HEIGHT, WIDTH))
    for row in range(HEIGHT):
        y = (row - HEIGHT / 2 + (np.arange(strips) + 0.5) / strips) * SIDE
        half = np.sqrt(np.maximum(radius**2 - y**2, 0))
        ends = np.clip(edges, -half[:, None], half[:, None])
        length = np.diff(ends)
        x = ends[:, :-1, None] + length[..., None] * (node + 1) / 2
        means[row] = (function(np.hypot(x, y[:, None, None])) @ weight / 2 * length).mean(axis=0) / SIDE
    return means


@cache
def pixels(stop):
    """Pixels wholly inside the stop, and wholly beside it."""
    share = inside_stop(stop, np.ones_like)
    return share > 1 - 1e-9, share < 1e-9


@cache
def truth(stop):
    """Power [W] before a uniform disk of 1 W/mm²: A_vd times the mean configuration factor inside the stop."""
    return SIDE**2 * inside_stop(stop, lambda r: configuration_factor(RADIUS, FOCUS, r))


@pytest.mark.parametrize(("stop", "domain"), [(STOP, "pupil"), (0.5, "pupil"), (STOP, "surface")])
def test_uniform_disk_meets_the_closed_form_on_the_pixels_the_border_cuts(stop, domain):
    """Rationale: ∫ over the part of each pixel inside the stop, whose area and cos⁴ the closed form knows.

    Expected: a tenth of what is asked for at each pixel and in all; the whole power is that of the circle in polar
    coordinates. A stop of 0.5 mm lies in four pixels. Seen to fail with the stop left out in 'surface'.
    """
    image = fspt.render(camera_scene(disk(SHARP, 200.0), image_stop_diameter=stop), rtol=1e-3, domain=domain)
    expected = truth(stop)
    assert (image.power > 0).sum() == (expected > 0).sum()
    np.testing.assert_allclose(image.power, expected, atol=5e-4 * expected.max())
    r = (np.arange(2000) + 0.5) / 2000 * stop * SIDE / PITCH / 2
    whole = np.sum(configuration_factor(RADIUS, FOCUS, r) * 2 * np.pi * r) * r[0] * 2
    assert expected.sum() == pytest.approx(whole, rel=1e-5)
    assert image.power.sum() == pytest.approx(whole, rel=3e-4)


def test_the_error_bounds_the_error_and_more_work_lessens_it():
    """Blurred too, where lines of sight that sample the pixel alone would see a border at random places."""
    expected = truth(STOP)
    worst = []
    for rtol in (1e-2, 1e-4):
        image = fspt.render(camera_scene(disk(BLURRED, 200.0), image_stop_diameter=STOP), rtol=rtol)
        difference = np.abs(image.power - expected)
        assert np.all(difference <= image.error + 1e-6 * expected.max())
        worst.append(difference.max() / expected.max())
    assert worst[1] < 1e-4
    assert worst[0] > 2 * worst[1]


def test_pixels_beside_the_stop_are_dark_and_not_computed():
    """Power, error and coverage 0; as many lines of sight as the pixels around the stop have."""
    inside, beside = pixels(STOP)
    assert beside.sum() > 500
    assert inside.sum() > 400
    for options in ({}, {"domain": "surface"}, {"method": "path", "spp": 4}, {"method": "ptracer", "spp": 4}):
        image = fspt.render(camera_scene(disk(SHARP, 200.0), image_stop_diameter=STOP), **options)
        for plane in (image.power, image.error, image.coverage):
            assert np.all(plane[beside] == 0), options
        assert np.all(image.coverage[inside] > 0.9999), options
        assert image.power[inside].sum() > 0, options
    four = fspt.render(camera_scene(disk(SHARP, 200.0), image_stop_diameter=2.0), max_nodes=4)
    assert four.metadata["nodes"] <= 4 * (2.0 / PITCH + 4) ** 2


def test_monte_carlo_agrees_where_silhouettes_cross_the_border():
    """A blurred sphere beside the axis, partly behind the stop, by a lens whose own border cuts the pupil, too.

    Seen to fail with the stop left out of ptracer.
    """
    borders = {"f_number": 11.0, "lens_diameter": 6.0, "diaphragm_distance": 30.0}
    body = sphere(150.0, 6.0, 7.0, -3.0)
    view = camera_scene(body, image_stop_diameter=STOP, **borders)
    inside, beside = pixels(STOP)
    cut = ~inside & ~beside
    image = fspt.render(view)
    assert (image.power[cut] > 0.05 * image.power.max()).sum() > 10
    for method in ("path", "ptracer"):
        truth = fspt.render(view, method=method, spp=800, seed=4)
        lit = truth.power > 0.02 * truth.power.max()
        z = (truth.power - image.power)[lit] / np.hypot(truth.error, image.error)[lit]
        assert np.abs(z).max() < 4.5, method
        assert image.power.sum() == pytest.approx(truth.power.sum(), rel=5e-3), method
    whole = power(camera_scene(body, **borders), rtol=1e-2)
    assert image.power.sum() < 0.95 * whole.sum()


def test_at_pixel_centres_the_stop_takes_whole_pixels():
    """`pixel = centre` is the value at the centre times the area, in the paper's way."""
    free, stopped = (
        power(camera_scene(disk(SHARP, 200.0), **s), pixel="centre") for s in ({}, {"image_stop_diameter": STOP})
    )
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    open_ = np.hypot(x, y) * PITCH < STOP / 2
    np.testing.assert_allclose(stopped, np.where(open_, free, 0), rtol=1e-5)


def test_a_stop_wider_than_the_film_changes_no_bit():
    body, quarter = sphere(150.0, 6.0), (10, 8, 10, 8)
    for domain in ("pupil", "surface"):
        free, wide = (
            power(camera_scene(body, crop=quarter, **s), domain=domain, rtol=0.1)
            for s in ({}, {"image_stop_diameter": 100.0})
        )
        assert free.any()
        np.testing.assert_array_equal(free, wide)


def test_a_crop_window_is_stopped_like_the_film():
    crop = (2, 3, 12, 20)
    whole, part = (power(camera_scene(disk(SHARP, 200.0), image_stop_diameter=STOP, crop=c)) for c in (None, crop))
    np.testing.assert_allclose(part, whole[3:23, 2:14], atol=1e-3 * whole.max())
    assert (part == 0).any()


def test_the_stop_can_be_updated_and_stands_in_the_header():
    import mitsuba as mi

    view = camera_scene(disk(SHARP, 200.0), image_stop_diameter=STOP)
    parameters = mi.traverse(view)
    parameters["sensor.image_stop_diameter"] = 4.0
    parameters.update()
    image = fspt.render(view)
    assert image.metadata["image_stop_diameter"] == 4.0
    np.testing.assert_allclose(image.power, truth(4.0), atol=5e-4 * image.power.max())


@pytest.mark.parametrize("diameter", [0.0, -3.0, np.inf, np.nan])
def test_a_stop_that_cannot_be_is_refused(diameter):
    with pytest.raises(OpticsError, match=r"'image_stop_diameter' must be > 0 and finite, got .*example 20"):
        Lens(55.0, 8.0, 165.0, image_stop_diameter=diameter)


def test_the_stop_is_as_much_larger_on_the_virtual_plane_as_the_pixels():
    assert Lens.focused(55.0, 8.0, magnification=0.5, image_stop_diameter=STOP).seen_field == pytest.approx(STOP)
    assert Lens(55.0, 8.0, 165.0).seen_field == np.inf


def test_a_stop_below_a_pixel_is_refused():
    """The first lines of sight of a pixel would all miss it."""
    with pytest.raises(RuntimeError, match=r"image_stop_diameter.* = 0.3 mm is below a pixel. Give at least 0.4 mm"):
        camera_scene(disk(SHARP, 200.0), image_stop_diameter=0.3)


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_narrow_light_on_a_pixel_that_the_stop_cuts_is_in_the_error(domain):
    """Rationale: the surface form ignores the stop, and lines of sight may miss a spot of a tenth of a pixel; then
    the pixel was 0 with an error of 0, and another one the brightest.
    """
    place = np.array([5.6, 0.2]) * SIDE  # on a pixel that the border cuts, inside the stop
    spot = {**disk(SHARP, 0.08 * SIDE, *place), "emitter": glow(1.0)}
    wide = {**disk(SHARP, 1.2 * SIDE), "emitter": glow(1e-2)}
    stopped, free = (
        fspt.render(camera_scene(spot, wide, **stop), rtol=1e-2, domain=domain)
        for stop in ({"image_stop_diameter": 12.0 * PITCH}, {})
    )
    bright = free.power == free.power.max()
    assert np.abs(stopped.power - free.power)[bright] <= 2 * stopped.error[bright]
