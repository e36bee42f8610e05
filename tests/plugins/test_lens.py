"""`fspt_lens` as a sensor: light goes where a thin lens sends it, and in the amount that its open pupil lets pass.

The truth is a ray trace through a thin lens and its borders in float64 NumPy, in the camera frame: lens plane z = 0,
object at z > 0, detector at z = -v. It knows neither virtual points nor the discs of the plugin.
"""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt.runtime import backend

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from small_scenes import ball, glow, lens, world_scene  # noqa: E402

import mitsuba_fspt as fspt  # noqa: E402
from mitsuba_fspt.runtime.errors import OpticsError  # noqa: E402

COUNT = 1 << 14
FOCAL, U = 55.0, 165.0
V = FOCAL * U / (U - FOCAL)
PLACE = mi.ScalarTransform4f().translate([7, -4, 2]).rotate([2 / 3, -1 / 3, 2 / 3], 50)

# Each camera with the size of what limits its light, and a film pitch at which nothing misses the film.
CAMERAS = {
    "diaphragm": {"f_number": 2.8},
    "lens border": {"f_number": 2.8, "lens_diameter": 25.0},
    "diaphragm behind": {"f_number": 4.0, "lens_diameter": 22.0, "diaphragm_distance": 20.0},
    "diaphragm in focus": {"f_number": 4.0, "lens_diameter": 22.0, "diaphragm_distance": FOCAL},
    "diaphragm far behind": {"f_number": 8.0, "lens_diameter": 30.0, "diaphragm_distance": 70.0},
    "diaphragm in front": {"f_number": 4.0, "lens_diameter": 22.0, "diaphragm_distance": -25.0},
    "hrrt": {"f_number": 2.8, "model": "hrrt", "lens_diameter": 24.0},
    "pinhole": {"f_number": 8.0, "model": "pinhole"},
    "ripoll": {"f_number": 8.0, "model": "ripoll", "numerical_aperture": 0.06},
}
POINTS = [(0, 0, 165), (4, -3, 150), (-6, 5, 200), (9, 8, 165), (3, 2, 90)]


class ThinLens:
    """Where light of an object point p that meets the lens at a goes, and whether it passes all borders."""

    def __init__(self, settings):
        self.model = settings.get("model", "diaphragm")
        self.aperture = FOCAL / settings["f_number"]
        self.border = settings.get("lens_diameter", np.inf)
        self.distance = settings.get("diaphragm_distance", 0.0)
        self.slope = np.tan(np.arcsin(settings.get("numerical_aperture", 0.0)))

    def trace(self, p, a):
        """Point of the detector plane (n, 2) [mm], and whether the light passes (n,)."""
        p, a = np.asarray(p, float), np.asarray(a, float)
        before = (a - p[..., :2]) / p[..., 2:]  # slope on its way to the lens
        after = before - a / FOCAL
        if self.model == "hrrt":
            return a + V * after, np.hypot(*a.T) <= self.border / 2
        if self.model == "ripoll":
            # The cone stands about the normal of the detector, where it is in focus: in the conjugate plane z = U.
            return a + V * after, np.hypot(*before.T) <= self.slope
        at_diaphragm = a + self.distance * (after if self.distance >= 0 else before)
        open_ = (np.hypot(*at_diaphragm.T) <= self.aperture / 2) & (np.hypot(*a.T) <= self.border / 2)
        return a + V * after, open_

    def solid_angle(self, p):
        """∫ cosθ/d² over the open pupil [sr], on a fine grid of the lens plane; for a pinhole its only line's."""
        if self.model == "pinhole":
            distance = np.linalg.norm(p)
            return np.pi / 4 * self.aperture**2 * p[2] / distance**3
        side, n = 40.0, 700
        step = (np.arange(n) + 0.5) / n * side - side / 2
        a = np.stack([g.ravel() for g in np.meshgrid(step, step)], -1)
        d = np.sqrt(((a - p[:2]) ** 2).sum(1) + p[2] ** 2)
        return np.sum(self.trace(np.broadcast_to(p, (n * n, 3)), a)[1] * p[2] / d**3) * (side / n) ** 2


def camera_of(settings, size=64, pitch=1.0, film=None):
    """A lens at `PLACE`, alive by the scene it comes with."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance"} | (film or {})
    return mi.load_dict(lens(pitch=pitch, to_world=PLACE, film=film, **settings))


def world(p):
    return mi.Transform4f(PLACE) @ mi.Point3f(*(mi.Float(np.broadcast_to(x, COUNT).astype(np.float32)) for x in p))


def in_camera(points):
    """World points of Dr.Jit as (n, 3) in the camera frame."""
    return (mi.Transform4f(PLACE).inverse() @ mi.Point3f(points)).numpy().T.astype(float)


def numbers(seed, rows=4):
    return [mi.Float(row) for row in np.random.default_rng(seed).random((rows, COUNT), np.float32)]


def even_points():
    """Points that cover the unit square evenly, off any circle (Roberts's sequence)."""
    n = np.arange(COUNT) + 0.5
    return mi.Point2f(
        *(mi.Float((n * step % 1).astype(np.float32)) for step in (0.7548776662466927, 0.5698402909980532))
    )


@pytest.fixture(scope="module", params=CAMERAS)
def settings(request):
    return CAMERAS[request.param]


# --- from the object to the film ---


@pytest.mark.parametrize("p", POINTS)
def test_light_of_a_point_arrives_where_the_thin_lens_sends_it(settings, p):
    camera, truth = camera_of(settings), ThinLens(settings)
    it = dr.zeros(mi.Interaction3f, COUNT)
    it.p = world(p)
    u = numbers(1)
    ds, weight = camera.sample_direction(it, mi.Point2f(u[0], u[1]))
    weight = weight[0].numpy()
    a = in_camera(ds.p)
    np.testing.assert_allclose(a[:, 2], 0, atol=1e-4)
    q, passes = truth.trace(np.broadcast_to(p, (COUNT, 3)), a[:, :2])
    lit = weight > 0
    np.testing.assert_allclose(ds.uv.numpy().T[lit], 32 + q[lit] / 1.0, atol=2e-4)
    # Light that just grazes a border may fall on either side of it in float32.
    assert np.mean(lit != passes) < 2e-3 if settings.get("model") != "pinhole" else lit.all()


@pytest.mark.parametrize("p", POINTS)
def test_the_weight_is_the_solid_angle_of_the_open_pupil(settings, p):
    """∫ cosθ/d² dA; seen to fail with d² for d² / cosθ, and without the growth of a pupil that moves with x."""
    camera, truth = camera_of(settings), ThinLens(settings)
    it = dr.zeros(mi.Interaction3f, COUNT)
    it.p = world(p)
    ds, weight = camera.sample_direction(it, even_points())
    weight = weight[0].numpy().astype(float)
    assert weight.mean() * 64**2 == pytest.approx(truth.solid_angle(np.array(p, float)), rel=5e-3)
    lit = weight > 0
    np.testing.assert_allclose((weight * 64**2 * ds.pdf.numpy())[lit], 1, rtol=1e-4)
    np.testing.assert_allclose((it.p + ds.dist * ds.d).numpy(), ds.p.numpy(), atol=1e-4)


def test_nothing_arrives_from_behind_or_beside_the_film(settings):
    camera = camera_of(settings, size=8, pitch=0.1)
    it = dr.zeros(mi.Interaction3f, COUNT)
    u = numbers(2)
    for p in ((0, 0, -50), (100, 0, 165), (0, -100, 165)):
        it.p = world(p)
        ds, weight = camera.sample_direction(it, mi.Point2f(u[0], u[1]))
        assert np.all(weight[0].numpy() == 0)
        assert np.all(ds.pdf.numpy() == 0)


# --- from the film to the object ---


@pytest.mark.parametrize("depth", [60.0, 165.0, 300.0])
def test_a_line_of_sight_leads_back_to_its_pixel(settings, depth):
    """Off the axis too: any point of the ray, sent back through the thin lens, meets the film where the ray began."""
    camera, truth = camera_of(settings), ThinLens(settings)
    u = numbers(3)
    ray, weight = camera.sample_ray(0.5, 0.5, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]))
    a, d = in_camera(ray.o), in_camera(ray.o + ray.d) - in_camera(ray.o)
    q, passes = truth.trace(a + d * (depth / d[:, 2:]), a[:, :2])
    np.testing.assert_allclose(32 + q / 1.0, 64 * np.stack([u[0].numpy(), u[1].numpy()], -1), atol=5e-3)
    lit = weight[0].numpy() > 0
    assert np.mean(lit != passes) < 2e-3 if settings.get("model") != "pinhole" else lit.all()
    assert np.all(ray.time.numpy() == 0.5)


def test_the_weight_of_a_line_of_sight_makes_watts():
    """Mean over the pupil for radiance 1: A_vd π f, f the configuration factor of the pupil (closed form).

    Seen to fail with cos³ for cos⁴, and without 1/t² in A_vd.
    """
    camera = camera_of({"f_number": 2.8})
    radius = FOCAL / 2.8 / 2
    for x in ((0.5, 0.5), (0.9, 0.3), (1.0, 0.0)):
        _, weight = camera.sample_ray(0.0, 0.5, mi.Point2f(*x), even_points())
        offset = np.hypot(*(np.array(x) - 0.5)) * 64 * 1.0 / 0.5
        z = U**2 + radius**2 + offset**2
        factor = (1 - (z - 2 * radius**2) / np.sqrt(z**2 - 4 * radius**2 * offset**2)) / 2
        truth = (1.0 / 0.5) ** 2 * np.pi * factor
        assert weight[0].numpy().astype(float).mean() == pytest.approx(truth, rel=1e-4)


def test_a_crop_window_is_a_part_of_the_film():
    crop = {"crop_offset_x": 10, "crop_offset_y": 20, "crop_width": 30, "crop_height": 12}
    whole, part = camera_of({}), camera_of({}, film=crop)
    u = numbers(5)
    x, y = u[0].numpy(), u[1].numpy()
    ray, weight = part.sample_ray(0.0, 0.5, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]))
    at = mi.Point2f(mi.Float((10 + 30 * x) / 64), mi.Float((20 + 12 * y) / 64))
    same, same_weight = whole.sample_ray(0.0, 0.5, at, mi.Point2f(u[2], u[3]))
    np.testing.assert_allclose(ray.d.numpy(), same.d.numpy(), atol=1e-6)
    np.testing.assert_allclose(weight[0].numpy(), same_weight[0].numpy(), rtol=1e-6)
    it = dr.zeros(mi.Interaction3f, COUNT)
    outside = mi.Point2f(u[1], u[0])
    wide, _ = whole.sample_ray(0.0, 0.5, outside, mi.Point2f(u[2], u[3]))
    it.p = wide.o + wide.d * 120
    (there, light), (here, share) = (c.sample_direction(it, mi.Point2f(u[2], u[3])) for c in (whole, part))
    uv, light, share = there.uv.numpy(), light[0].numpy(), share[0].numpy()
    inside = (uv[0] >= 10) & (uv[0] < 40) & (uv[1] >= 20) & (uv[1] < 32)
    assert 0.05 < inside.mean() < 0.15
    np.testing.assert_array_equal(share > 0, inside & (light > 0))
    np.testing.assert_allclose(here.uv.numpy()[:, inside] + [[10], [20]], uv[:, inside], atol=1e-3)
    np.testing.assert_allclose(share[inside] * 30 * 12, light[inside] * 64 * 64, rtol=1e-5)


# --- images ---


def pictures(settings, spp=2000):
    """Integral, path and ptracer of a sphere, off the axis, and the Monte Carlo errors.

    The sums of 2,000 samples a pixel still determine the ratio to 1e-2.
    """
    scene = world_scene(ball(2e-3, center=(6, 1.5, -1)), sensor=lens(size=12, pitch=0.9, **settings))
    return [
        fspt.render(scene),
        *(fspt.render(scene, method=m, spp=spp, seed=3) for m in ("path", "ptracer")),
    ]


@pytest.mark.parametrize("name", ["diaphragm behind", "pinhole", "ripoll"])
def test_three_methods_agree_for_every_kind_of_camera(name):
    """Per pixel, in units of the standard error; the plain diaphragm has tests of its own."""
    integral, *monte_carlo = pictures(CAMERAS[name])
    assert integral.power.max() > 0
    for image in monte_carlo:
        result = fspt.compare(integral, image)
        assert result.z_test.p_value > 1e-3
        assert result.ratio == pytest.approx(1, rel=1e-2)


@pytest.mark.parametrize("method", ["integral", "path", "ptracer"])
def test_a_crop_window_is_cut_out_of_the_image(method):
    options = {} if method == "integral" else {"spp": 500}
    crop = {"crop_offset_x": 4, "crop_offset_y": 7, "crop_width": 5, "crop_height": 3}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "pixel_format": "luminance"}
    images = []
    for window in ({}, crop):
        scene = world_scene(ball(center=(0, 1.5, -1)), sensor=lens(pitch=0.9, film=film | window))
        images.append(fspt.render(scene, method=method, **options))
    whole, part = images
    assert part.shape == (3, 5)
    cut = np.s_[7:10, 4:9]
    margin = 5 * np.hypot(part.error, whole.error[cut]) + 1e-3 * whole.power.max()
    assert np.all(np.abs(part.power - whole.power[cut]) < margin)
    np.testing.assert_allclose(part.coverage, whole.coverage[cut], atol=0.1)


@pytest.mark.parametrize(
    ("method", "size"),
    [("integral", (1, 1)), ("integral", (7, 1)), ("integral", (2, 2)), ("path", (1, 7)), ("ptracer", (7, 1))],
)
def test_films_of_a_row_a_column_or_one_pixel(method, size):
    """A sheet in focus that fills every line of sight: J_n A_vd sin²θ on each pixel near the axis."""
    place = mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale([15, 15, 1])
    scene = world_scene(
        {"type": "rectangle", "to_world": place, "emitter": glow(1e-3)}, sensor=lens(size=size, pitch=2.0)
    )
    options = {"rtol": 1e-2} if method == "integral" else {"spp": 5_000}
    image = fspt.render(scene, method=method, **options)
    assert image.shape == size[::-1]
    assert np.all(image.coverage == 1)
    radius = FOCAL / 8 / 2
    truth = 1e-3 * (2.0 / 0.5) ** 2 * radius**2 / (radius**2 + U**2)
    np.testing.assert_allclose(image.power, truth, atol=4 * image.error.max() + 2e-2 * truth)
    assert image.error.max() < 0.1 * truth


# --- what a scene may change ---

CHANGES = {
    "f_number": 2.8,
    "focal_length": 35.0,
    "magnification": 0.4,
    "pixel_pitch": 0.6,
    "to_world": mi.ScalarTransform4f().look_at([150, 20, 5], [0, 1, 0], [0, 0.1, 1]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_an_updated_parameter_changes_the_image_as_in_a_fresh_scene(name):
    value = CHANGES[name]
    scene, fresh = (world_scene(ball(), sensor=lens(size=12, pitch=1.0, **s)) for s in ({}, {name: value}))
    before = fspt.render(scene, max_nodes=4)
    parameters = mi.traverse(scene)
    parameters[f"camera.{name}"] = mi.Transform4f(value) if name == "to_world" else value
    parameters.update()
    for options in ({"max_nodes": 4}, {"method": "path", "spp": 4}):
        changed, wanted = fspt.render(scene, **options), fspt.render(fresh, **options)
        assert np.abs(changed.power - before.power).max() > 0.1 * before.power.max()
        np.testing.assert_allclose(changed.power, wanted.power, rtol=1e-4, atol=1e-5 * wanted.power.max())
        assert name == "to_world" or changed.metadata[name] == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("focus", [{"focus_distance": U}, {"image_distance": V}, {"magnification": 0.5}])
def test_the_focus_may_be_given_in_three_ways(focus):
    (name, value), *_ = focus.items()
    camera = mi.load_dict(lens(**{"magnification": None, **focus}))
    assert camera.camera.lens.focus_distance == pytest.approx(U)
    parameters = mi.traverse(camera)
    parameters[name] = value * 1.1
    parameters.update()
    assert camera.camera.lens.focus_distance != pytest.approx(U)


def test_a_film_that_is_updated_by_itself_is_followed():
    """Mitsuba does not inform a sensor of it. Seen to fail with the camera of the film before."""
    camera = mi.load_dict(lens())
    film = mi.traverse(camera.film())
    film["crop_offset"], film["crop_size"] = [3, 2], [10, 5]
    film.update()
    assert camera.camera.film.crop_offset == (3, 2)
    assert camera.camera.film.shape == (5, 10)


def test_an_impossible_update_is_refused():
    camera = mi.load_dict(lens())
    parameters = mi.traverse(camera)
    parameters["f_number"] = -1.0
    with pytest.raises(OpticsError, match="'f_number' must be > 0"):
        parameters.update()


def test_the_lens_owns_its_film_and_brings_a_sampler():
    """Whatever film the scene asks for: float32 watts, one number a pixel, gathered by that pixel alone."""
    film = {
        "type": "hdrfilm",
        "width": 7,
        "height": 5,
        "component_format": "float16",
        "pixel_format": "rgb",
        "rfilter": {"type": "gaussian"},
    }
    camera = mi.load_dict(lens(film=film))
    text = str(camera.film())
    for part in ("size = [7, 5]", "BoxFilter", "pixel_format = y", "component_format = float32"):
        assert part in text
    assert "Multijitter" in camera.sampler().class_name()
    own = mi.load_dict(lens(sampler={"type": "independent", "sample_count": 9}))
    assert own.sampler().sample_count() == 9


def test_to_string_lists_every_parameter():
    settings = {"lens_diameter": 30.0, "diaphragm_distance": 5.0}
    text = str(mi.load_dict(lens(**settings)))
    for name in ("model = diaphragm", "focal_length = 55", "f_number = 8", "magnification = 0.5", "pixel_pitch = 0.8"):
        assert name in text
    assert "lens_diameter = 30" in text
    assert "diaphragm_distance = 5" in text
    assert "exitance" in str(world_scene({"type": "sphere", "emitter": glow()}).emitters()[0])
