"""Laws of physics that every picture has to obey, with the numbers they predict.

Each says which factor, dropped from the product, it was seen to catch.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from small_scenes import (
    FOCAL,
    FOCUS,
    HEIGHT,
    MAGNIFICATION,
    PITCH,
    RADIUS,
    SIDE,
    WIDTH,
    camera_scene,
    collected,
    disk,
    even_disc,
    filled,
    glow,
    load_scene,
    over_pixels,
    power,
    sphere,
    virtual_pixels,
)

import mitsuba_fspt as fspt

pytestmark = pytest.mark.usefixtures("mono")


def cos4(side=SIDE):
    return over_pixels(lambda x, y: FOCUS**4 / (FOCUS**2 + x**2 + y**2) ** 2, side)


def overlap(r, s, apart):
    """Area that two circles of radii r and s share, `apart` between their centres."""
    apart = np.clip(apart, abs(r - s) + 1e-12, r + s)
    a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
    b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    return r**2 * (a - np.sin(2 * a) / 2) + s**2 * (b - np.sin(2 * b) / 2)


# --- a filled cone ---


@pytest.mark.parametrize("distance", [165, 110, 300])
@pytest.mark.parametrize("pixel", ["centre", "area"])
def test_uniform_disk_meets_the_closed_form(distance, pixel):
    """Rationale: P = J_n A_vd f, f from point to pupil, wherever the disk stands: in focus, in front, behind.

    Expected: 1e-5 of the power at every pixel of the whole field, f/2.8; over the area the mean of f by Gauss nodes.
    Seen to fail with cos⁴θ → cos³θ (3e-2), 1/π dropped, (p/t)² → p² (A_vd without 1/t²), u² → v².
    """
    disk_scene = load_scene("uniform_disk", distance=distance, f_number=2.8)
    side = disk_scene.sensors()[0].camera.pixel_pitch / MAGNIFICATION
    picture = power(disk_scene, rtol=1e-5, pixel=pixel)
    np.testing.assert_allclose(picture, filled(side, 1 if pixel == "centre" else 6), rtol=1e-5)


def lines_of_sight():
    """From points of the pupil's rim (n, 3) to the corners of every pixel (HEIGHT, WIDTH, 4, 3)."""
    turn = 2 * np.pi * np.arange(24) / 24
    rim = np.stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), np.zeros(24)], axis=1)
    x, y, _ = virtual_pixels()
    corner = SIDE / 2 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    points = np.empty((HEIGHT, WIDTH, 4, 3))
    points[..., 0], points[..., 1] = x.T[..., None] + corner[:, 0], y[..., None] + corner[:, 1]
    points[..., 2] = FOCUS
    return rim, points[..., None, :] - rim


def miss_distance(centre, flat=(1, 1, 1)):
    """Largest distance from `centre` of any line of sight of each pixel, in the plane of the unflattened axes."""
    rim, line = lines_of_sight()
    away, line = (rim - centre) * flat, line * flat
    nearest = away - line * (np.sum(away * line, axis=-1) / np.sum(line**2, axis=-1))[..., None]
    return np.linalg.norm(nearest, axis=-1).max(axis=(2, 3))


@pytest.mark.parametrize("centre", [180.0, 230.0])
def test_uniform_sphere_meets_the_closed_form_where_the_cone_is_filled(centre):
    """Rationale: the shape does not matter; a sphere is curved and lies before, in and behind the virtual
    detector plane.

    Expected: as for the disk at the pixels whose every line of sight meets the sphere.
    """
    inside = miss_distance([2.0, -1.0, centre]) < 20.0 * 0.999
    x, y, width, height = crop = (10, 9, 15, 16)
    part = slice(y, y + height), slice(x, x + width)
    inside = inside[part]
    assert inside.mean() > 0.95
    picture = power(camera_scene(sphere(centre, 20.0, 2.0, -1.0), crop=crop), rtol=1e-5)
    np.testing.assert_allclose(picture[inside], filled(nodes=6)[part][inside], rtol=1e-5)


def test_uniform_cylinder_meets_the_closed_form_where_the_cone_is_filled():
    """As the sphere, for an upright cylinder that the virtual detector plane cuts."""
    inside = miss_distance([1.0, 0.0, 168.0], flat=(1, 0, 1)) < 11.0 * 0.999
    x, y, width, height = crop = (10, 0, 17, HEIGHT)
    part = slice(y, y + height), slice(x, x + width)
    assert inside[part].all()
    assert not inside.all()
    cylinder = {"type": "cylinder", "p0": [1.0, -90.0, 168.0], "p1": [1.0, 90.0, 168.0], "radius": 11.0}
    picture = power(camera_scene(cylinder, crop=crop), rtol=1e-5)
    np.testing.assert_allclose(picture, filled(nodes=6)[part], rtol=1e-5)


def test_light_falls_off_with_the_fourth_power_of_the_cosine():
    """Rationale: stopped down, f → R² cos⁴θ/u². Expected: to (R/u)² = 3e-6 at f/100.

    Seen to fail with cos⁴θ → cos³θ.
    """
    picture = power(camera_scene(disk(FOCUS), f_number=100.0), pixel="centre")
    falloff = cos4()
    assert falloff.min() < 0.98
    centre = picture[HEIGHT // 2, WIDTH // 2] / falloff[HEIGHT // 2, WIDTH // 2]
    np.testing.assert_allclose(picture / centre, falloff, rtol=4e-6)


# --- energy ---


@pytest.mark.parametrize("focus", [140.0, 165.0, 200.0])
def test_all_power_through_the_pupil_arrives_whatever_the_focus(focus):
    """Rationale: Σ P = ∫ J_n f dS contains no focus; refocusing moves light and never makes or loses any.

    Expected: to 1e-4, in front of, at and behind a sphere of 8 mm at 180 mm, pitch changed along so that it fits.
    Seen to fail with cos⁴θ → cos³θ (2e-3), 1/π dropped, A_vd without 1/t², and the 1/24 of the pixel's bend.
    """
    pitch = 0.8 * FOCAL / (focus - FOCAL)
    picture = power(camera_scene(sphere(180.0, 8.0), focus_distance=focus, pixel_pitch=pitch))
    assert picture[[0, -1]].max() == picture[:, [0, -1]].max() == 0  # the whole image is on the film
    assert picture.sum() == pytest.approx(collected(8.0, 180.0), rel=1e-4)


# --- proportions ---


def test_one_full_stop_is_half_the_power():
    """Rationale: P ∝ D² for small D (paper, Fig. 7). Expected: 2 to (R/u)²/2 = 3.4e-6 at f/64.

    Seen to fail with D → D² in Eq. 3 and with the pupil area left out of the étendue.
    """
    stops = [power(camera_scene(disk(FOCUS), f_number=64 * np.sqrt(2) ** k), rtol=1e-6) for k in (0, 1, 2)]
    np.testing.assert_allclose(stops[0] / stops[1], 2, rtol=5e-6)
    np.testing.assert_allclose(stops[0] / stops[2], 4, rtol=1e-5)


def test_power_is_linear_in_the_exitance():
    """Expected: the same bits if the exitance is a power of two, else float32 rounding and the places of jumps that it
    moves, at exitances of bioluminescence; two objects add where neither hides the other.

    Seen to fail with J_n^1.01 for J_n.
    """
    two = [sphere(180.0, 5.0, 7.0), sphere(150.0, 4.0, -7.0)]
    bright = power(camera_scene(*two, f_number=8.0), rtol=1e-2)
    for faint, rounding in ((2.0**-28, 1e-12), (3.7e-9, 2e-5)):
        dim = power(camera_scene(*two, f_number=8.0, exitance=faint), rtol=1e-2)
        np.testing.assert_allclose(dim / faint, bright, atol=rounding * bright.max())
    dark = [{**body, "emitter": glow(1e-12)} for body in two]
    single = [power(camera_scene(*pair, f_number=8.0), rtol=1e-2) for pair in ((two[0], dark[1]), (dark[0], two[1]))]
    np.testing.assert_allclose(sum(single), bright, atol=2e-2 * bright.max())
    assert min(picture.max() for picture in single) > 0.5 * bright.max()


@pytest.mark.parametrize("scale", [0.01, 2.0, 1000.0])
def test_power_scales_with_the_square_of_all_lengths(scale):
    """Rationale: radiance and directions stay, areas grow with scale². Expected: float32 rounding of rays.

    Seen to fail with 1/u² dropped from the étendue and with (p/t)² → p/t.
    """
    pictures = [
        power(
            camera_scene(sphere(180.0 * s, 8.0 * s, 3.0 * s, -2.0 * s), focal_length=FOCAL * s, pixel_pitch=0.5 * s),
            rtol=1e-2,
        )
        for s in (1.0, scale)
    ]
    np.testing.assert_allclose(pictures[1] / scale**2, pictures[0], atol=1e-3 * pictures[0].max())
    inside = slice(14, 18), slice(14, 18)
    np.testing.assert_allclose(pictures[1][inside] / scale**2, pictures[0][inside], rtol=2e-6)


# --- models of the lens ---


def test_pinhole_is_one_line_of_sight():
    """Rationale: P = J_n/π · πD²/4 · A_vd cos⁴θ/u² (Schulz), whatever D. Expected: float32 rounding."""
    picture = power(camera_scene(disk(FOCUS), model="pinhole"), pixel="centre")
    np.testing.assert_allclose(picture, RADIUS**2 * SIDE**2 * cos4() / FOCUS**2, rtol=2e-6)


def test_small_diaphragm_tends_to_the_pinhole():
    """Rationale: D → 0 is the pinhole model, silhouettes included. Expected: the accuracy asked for.

    Seen to fail with the pupil area left out of the étendue of one of the two.
    """
    body = sphere(150.0, 6.0, 3.0, -2.0)
    pinhole = power(camera_scene(body, f_number=1e4, model="pinhole"), rtol=3e-3)
    stopped = power(camera_scene(body, f_number=1e4), rtol=3e-3)
    assert (pinhole > 0).sum() > 100
    np.testing.assert_allclose(stopped, pinhole, atol=3e-3 * pinhole.max())
    wide = power(camera_scene(body, f_number=2.0), rtol=3e-2)
    assert np.abs(wide / wide.max() - pinhole / pinhole.max()).max() > 0.1  # where the focus does matter


BLUR_RTOL = 6e-4  # half of it takes three times as long; neighbours in D differ by 3e-5 of the peak with either


def over_etendue(diameter, **lens):
    """Where a sphere covers part of another, their picture over a pixel's étendue: the mean of cos⁴θ L.

    On nine pixels, which the upper edge of the near sphere crosses and the left one of the far sphere.
    """
    far, near = sphere(180.0, 8.0, -6.5), sphere(140.0, 2.0, 1.0, -0.5)
    near["emitter"] = glow(2.0)
    picture = power(camera_scene(far, near, f_number=FOCAL / diameter, crop=(17, 13, 3, 3), **lens), rtol=BLUR_RTOL)
    return picture / (SIDE**2 * np.pi * (diameter / 2) ** 2 / FOCUS**2)


def test_diaphragm_tends_to_the_pinhole_through_five_decades_without_a_jump():
    """Rationale: lim D → 0 is the pinhole model; what refines a picture, and float32, must not show on the way.

    Expected: of the peak, 6e-4 and what the blur changes in truth, ∝ D² here, 0.0055 (D/mm)² at most; and 6e-4 between
    two D that differ by 1e-4 of themselves, silhouettes and covered silhouettes included.
    Seen to fail with a pupil 0.2 mm wider in radius than its étendue, and with D² → D^1.9999 in that.
    """
    pinhole = over_etendue(13.75, model="pinhole")
    assert pinhole.max() > 1.5 / np.pi
    for decade in (0, 2, 5):
        diameter = 13.75 / 10**decade
        first, second = over_etendue(diameter), over_etendue(diameter * 0.9999)
        assert np.abs(first - second).max() < BLUR_RTOL * pinhole.max(), diameter
        assert np.abs(first - pinhole).max() < (BLUR_RTOL + 0.006 * diameter**2) * pinhole.max(), diameter


def test_diaphragm_tends_to_hrrt_as_it_opens_to_the_lens_border():
    """Rationale: lim D → lens diameter is the model without a diaphragm.

    Expected: of the peak, 6e-4 and what the blur changes in truth, ∝ what is left to open, 0.42 times here.
    Seen to fail with the border 0.02 mm wider than it is: 0.01 mm changes it by 0.42 · 0.02/20 = 4e-4 only.
    """
    open_ = over_etendue(20.0, model="hrrt", lens_diameter=20.0)
    for decade in (1, 4):
        left = 10.0**-decade
        stopped = over_etendue(20.0 * (1 - left), lens_diameter=20.0)
        difference = np.abs(stopped - open_).max() / open_.max()
        assert difference < BLUR_RTOL + 0.5 * left, left
        assert difference > 0.2 * left or left < 1e-3  # there is something to tend to


@pytest.mark.parametrize("diameter", [20.0, 13.75])
def test_hrrt_is_a_diaphragm_as_wide_as_the_lens(diameter):
    """Rationale: without a diaphragm the lens border stops the light. Expected: the same bits."""
    body = sphere(180.0, 8.0)
    hrrt = power(camera_scene(body, model="hrrt", lens_diameter=diameter, f_number=8.0), rtol=1e-2)
    np.testing.assert_array_equal(hrrt, power(camera_scene(body, f_number=FOCAL / diameter), rtol=1e-2))


@pytest.mark.parametrize("aperture", [0.05, 0.6])
def test_ripoll_s_detector_takes_the_same_cone_everywhere(aperture):
    """Rationale: ∫ cosθ dω/π over a cone about the normal is sin²: P = J_n A_vd NA² at every pixel, no cos⁴ left.

    Expected: to 1e-5. Seen to fail with tan for sin, and with u² → (u cosθ)².
    """
    picture = power(
        camera_scene(disk(FOCUS, 400.0), model="ripoll", numerical_aperture=aperture), rtol=1e-5, pixel="centre"
    )
    np.testing.assert_allclose(picture, SIDE**2 * aperture**2, rtol=1e-5)


def behind_two_circles(stop, lens, distance, x, y):
    """∫ cos⁴θ dA / u² over what entrance pupil and lens border leave open to points (x, y) of the virtual
    detector plane.

    A diaphragm s behind the lens appears sF/(F − s) behind it, magnified F/(F − s); one in front as it is. A line from
    x meets the plane d behind the lens at a(1 + d/u) − x d/u, so that the lens border shows up there magnified.
    """
    behind = distance * FOCAL / (FOCAL - distance) if distance > 0 else distance
    pupil = stop / 2 * (behind / distance if distance > 0 else 1)
    growth, u = abs(1 + behind / FOCUS), FOCUS + behind
    count, falloff = 0, 0
    for a, b in pupil * even_disc(4096).T:
        inside = np.hypot(a + x * behind / FOCUS, b + y * behind / FOCUS) <= lens / 2 * growth
        count, falloff = count + inside, falloff + inside * (1 + ((a - x) ** 2 + (b - y) ** 2) / u**2) ** -2.0
    area = overlap(lens / 2 * growth, pupil, np.hypot(x, y) * abs(behind) / FOCUS)
    return area * falloff / np.maximum(count, 1) / u**2


@pytest.mark.parametrize(
    ("stop", "lens", "distance", "pitch"),
    [
        (4.4, 4.0, 25.0, PITCH),
        (4.4, 4.0, -30.0, PITCH),
        (FOCAL / 2.8, 20.77, 5.68, 1.0),
        (FOCAL / 4, 22.0, 20.0, 1.0),
        (FOCAL / 8, 7.7, 7.35, 1.0),
    ],
)
def test_diaphragm_off_the_lens_vignettes_like_two_circles(stop, lens, distance, pitch):
    """Rationale: off axis, lens border and entrance pupil cover each other only in part, at first but for a crescent.

    Expected: J_n A_vd/π · ∫ cos⁴θ dA/u². Seen to fail with F/(F − s) dropped and with the sign of the shift turned;
    by 2e-3 on the crescents where the border was looked for by transects.
    """
    borders = {"f_number": FOCAL / stop, "lens_diameter": lens, "diaphragm_distance": distance}
    side = pitch / MAGNIFICATION
    expected = side**2 / np.pi * over_pixels(partial(behind_two_circles, stop, lens, distance), side)
    picture = power(camera_scene(disk(FOCUS, 400.0), pixel_pitch=pitch, **borders), pixel="centre", rtol=1e-3)
    assert expected.min() < 0.8 * expected.max()
    np.testing.assert_allclose(picture, expected, atol=1e-4 * expected.max())


def test_diaphragm_in_the_rear_focal_plane_is_ripoll_s_detector():
    """Rationale: it stops directions, not places; |slope| ≤ (D/2)/F. Expected: the same picture, silhouettes too."""
    body = sphere(180.0, 8.0, 3.0)
    aperture = np.sin(np.arctan(1 / 16))  # D = F/8
    cone = power(camera_scene(body, model="ripoll", numerical_aperture=aperture), rtol=1e-2)
    telecentric = power(camera_scene(body, f_number=8.0, lens_diameter=200.0, diaphragm_distance=FOCAL), rtol=1e-2)
    np.testing.assert_allclose(telecentric, cone, atol=1e-3 * cone.max())


# --- geometry of the picture ---


def moments(picture):
    """Sum, centroid (x, y) and mean squared distance from it, in pixels from the film's upper left corner."""
    total = picture.sum()
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    cx, cy = (picture * x).sum() / total, (picture * y).sum() / total
    return total, cx, cy, (picture * ((x - cx) ** 2 + (y - cy) ** 2)).sum() / total


def test_sharp_image_is_the_object_times_the_magnification():
    """Rationale: a disk of radius r at (x, y, u) is a disk of r t/p pixels at W/2 − x t/p, H/2 − y t/p.

    Expected: area, centre and mean squared radius R²/2 + 1/6 (the pixel's own), to the cos⁴ falloff across it (1e-3)
    at f/22. Seen to fail with t → 1/t, t → 1 and with x → −x.
    """
    picture = power(camera_scene(disk(FOCUS, 4.0, 5.0, -3.0), f_number=22.0))
    total, cx, cy, spread = moments(picture / power(camera_scene(disk(FOCUS), f_number=22.0)))
    r = 4.0 * MAGNIFICATION / PITCH
    assert total == pytest.approx(np.pi * r**2, rel=1e-3)
    assert (cx, cy) == pytest.approx((WIDTH / 2 - 5.0 / SIDE, HEIGHT / 2 + 3.0 / SIDE), abs=5e-3)
    assert spread == pytest.approx(r**2 / 2 + 1 / 6, rel=1e-3)


@pytest.mark.parametrize("depth", [110.0, 230.0])
def test_blur_disc_has_the_radius_of_similar_triangles(depth):
    """Rationale: a point at z spreads over D/2 · |u − z|/z on the virtual detector plane, nearer or farther alike.

    Expected: mean squared radius (B² + r²)/2 + 1/6 pixels² with r the disk's own image; f/4, to the cos⁴θ of its rim,
    2 (4/110)² = 2.6e-3.
    Seen to fail with the pupil radius doubled and with u − z → u + z.
    """
    picture = power(camera_scene(disk(depth, 4.0), f_number=4.0))
    blur = FOCAL / 8 * abs(FOCUS - depth) / depth / SIDE
    image = 4.0 * FOCUS / depth / SIDE
    _, cx, cy, spread = moments(picture)
    assert (cx, cy) == pytest.approx((WIDTH / 2, HEIGHT / 2), abs=5e-3)
    assert spread == pytest.approx((blur**2 + image**2) / 2 + 1 / 6, rel=3e-3)


@pytest.mark.parametrize("depth", [110.0, 230.0])
def test_body_smaller_than_its_blur_is_the_overlap_of_two_circles(depth):
    """Rationale: a disk of radius r is seen from a virtual point h off the axis through a circle of the pupil, radius
    r u/|u − z|, h z/|u − z| off its middle: P = J_n/π · A_vd · (what the circles share) cos⁴θ/u².

    Expected: the accuracy asked for; the cone to the small disk is so thin that cos⁴θ of its axis will do (3e-4).
    Two silhouettes cross most lines through this pupil, and many lines miss both.
    """
    radius, pupil, pitch = 0.8, FOCAL / 16, 0.1

    def seen(x, y):
        h = np.hypot(x, y)
        shared = overlap(pupil, radius * FOCUS / abs(FOCUS - depth), h * depth / abs(FOCUS - depth))
        return shared / (1 + h**2 / (FOCUS - depth) ** 2) ** 2

    side = pitch / MAGNIFICATION
    expected = side**2 / (np.pi * FOCUS**2) * over_pixels(seen, side, 40)
    rows = slice(15, 17)
    blurred = camera_scene(disk(depth, radius), f_number=8.0, pixel_pitch=pitch, crop=(0, 15, WIDTH, 2))
    picture = power(blurred, rtol=3e-3)
    assert (expected[rows] == 0).any()
    np.testing.assert_allclose(picture, expected[rows], atol=3.3e-3 * expected.max())


@pytest.mark.parametrize("method", ["integral", "path", "ptracer"])
def test_letter_l_is_upright_and_unmirrored(method):
    """Rationale: the bar stands on the left, the foot points to the right below, under every method.

    Expected: light on the middle of both bars, none in the open corner. Letter 16 × 24 mm, bars 6 mm, at t = 1/2:
    9.3 × 13.9 pixels about the middle of the film. Seen to fail with the sign of x or y turned in the lens.
    """
    letter = load_scene("l_shape")
    sampling = {} if method == "integral" else {"spp": 32, "seed": 1}
    picture = fspt.render(letter, method=method, **sampling).power
    pixels_per_mm = MAGNIFICATION / letter.sensors()[0].camera.pixel_pitch

    def lit(right, up):
        column, row = int(WIDTH / 2 + right * pixels_per_mm), int(HEIGHT / 2 - up * pixels_per_mm)
        return picture[row, column] > 0.5 * picture.max()

    assert lit(-5, 9)  # top of the bar
    assert lit(-5, -9)  # the corner
    assert lit(5, -9)  # tip of the foot
    assert not lit(5, 9)
    assert not lit(5, 0)
    assert not lit(-12, 0)


@pytest.mark.parametrize("crop", [(5, 7, 22, 13), (17, 12, 8, 9)])
def test_crop_window_is_a_part_of_the_whole_image(crop):
    """Expected: the accuracy asked for, by either of the two pictures."""
    body = sphere(180.0, 8.0, 3.0, -2.0)
    x, y, width, height = crop
    whole = fspt.render(camera_scene(body, pixel_pitch=0.5), rtol=3e-3)
    part = fspt.render(camera_scene(body, pixel_pitch=0.5, crop=crop), rtol=3e-3)
    assert part.shape == (height, width)
    expected = whole.power[y : y + height, x : x + width]
    assert (expected == 0).any()
    assert (expected > 0).any()
    np.testing.assert_allclose(part.power, expected, atol=3e-3 * whole.power.max())
    corner = fspt.render(camera_scene(body, pixel_pitch=0.5, crop=(0, 0, 3, 2)))
    assert corner.shape == (2, 3)
    assert not corner.power.any()
