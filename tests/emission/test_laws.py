"""The laws of emission: each carries J_n, and all of Mitsuba's calls for the radiance give the same law."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.boundary import haskell_a
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.errors import ExitanceError

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

FRESNEL = {"emission": "fresnel", "int_ior": 1.37}
MUA, MUSP = 0.0138, 0.91


def sloping(at, slope, half=60.0, cells=16):
    """A volume of the cube of ±`half` mm: fluence `at` in the middle, changing by `slope` per mm, without error."""
    middle = (np.arange(cells) + 0.5) * (2 * half / cells) - half
    z, y, x = np.meshgrid(middle, middle, middle, indexing="ij")
    values = at + slope[0] * x + slope[1] * y + slope[2] * z
    box = mi.ScalarTransform4f().translate([-half] * 3).scale(2 * half)
    grid = mi.VolumeGrid(values[..., None].astype(np.float32))
    return {"type": "gridvolume", "grid": grid, "to_world": box, "accel": False}


def last_flight(at, slope, **changes):
    law = {"emission": "last_flight", "int_ior": 1.37, "mua": MUA, "musp": MUSP}
    return law | {"fluence": sloping(at, slope)} | changes


# Dark enough on one side of the sphere that the law differs from all others by tens of percent.
SLOPING = (1.0, (0.015, 0.01, -0.006))
STEEP = (1.0, (0.12, 0.1, -0.06))
LAWS = (lambda: {}, lambda: FRESNEL, lambda: last_flight(*SLOPING))
NAMES = ["lambert", "fresnel", "last_flight"]


def emitting(law, exitance=1.0):
    return {"type": "fspt_surface", "exitance": exitance, **law}


def glowing_sphere(law, exitance=2e-3):
    """A scene of one sphere, radius 3, with a camera that sees it all, and its emitter (alive while the scene is)."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "sensor": {
                "type": "fspt_lens",
                "focal_length": 55.0,
                "f_number": 2.8,
                "magnification": 0.5,
                "pixel_pitch": 0.35,
                "to_world": mi.ScalarTransform4f().look_at([90, 110, 80], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 12, "height": 12, "pixel_format": "luminance"},
            },
            "sphere": {
                "type": "sphere",
                "radius": 3.0,
                "emitter": emitting(law, exitance),
            },
        }
    )
    return scene, scene.emitters()[0]


def transmittance(mu, n):
    """Unpolarised Fresnel transmittance into index n at the outer cosine, and the inner cosine; from Snell's law."""
    inner = np.sqrt(1 - (1 - mu**2) / n**2)
    s = (mu - n * inner) / (mu + n * inner)
    p = (n * mu - inner) / (n * mu + inner)
    return 1 - (s**2 + p**2) / 2, inner


def profile(mu, n):
    """L/J_n [1/sr] of the Fresnel law in float64, A from the demand that the hemisphere carry J_n."""
    x, w = np.polynomial.legendre.leggauss(200)
    x, w = (x + 1) / 2, w / 2
    t, inner = transmittance(x**2, n)
    flux = t * x**2 / n**2 * 2 * x * w / 2  # T µ/(2 n²) dµ with µ = x²
    a = (1 - 3 * (inner * flux).sum()) / (2 * flux.sum())
    t, inner = transmittance(mu, n)
    return (2 * a + 3 * inner) * t / (4 * np.pi * n**2), a


def seen(points, directions):
    """Surface records at points (3, N) of the sphere, seen from unit vectors (3, N)."""
    points, directions = np.broadcast_arrays(points, directions)
    si = dr.zeros(mi.SurfaceInteraction3f, points.shape[1])
    si.p, si.n = mi.Point3f(points), mi.Normal3f(points / 3)
    si.uv = mi.Point2f(np.arctan2(points[1], points[0]) / (2 * np.pi) % 1, np.arccos(points[2] / 3) / np.pi)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.to_local(mi.Vector3f(directions))
    return si


def towards(mu, azimuth=0.3):
    """Records at the top of the sphere (normal +z), seen from directions of the given outer cosines."""
    sine, azimuth = np.sqrt(1 - mu**2), np.broadcast_to(azimuth, mu.shape)
    return seen(np.array([[0.0], [0.0], [3.0]]), np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), mu]))


@pytest.mark.parametrize("n", [1.0, 1.1, 1.37, 1.53, 2.4])
def test_fresnel_law_carries_the_exitance(n):
    """∫ L µ dΩ = J_n to float32; A found from that demand alone is Haskell's. With T or n² left out: off by > 3 %."""
    _scene, emitter = glowing_sphere({"emission": "fresnel", "int_ior": n}, exitance=1.0)
    x, w = np.polynomial.legendre.leggauss(64)
    x, w = (x + 1) / 2, w / 2
    mu = x**2
    radiance = emitter.eval(towards(mu)).numpy()[0]
    assert 2 * np.pi * (radiance * mu * 2 * x * w).sum() == pytest.approx(1, abs=1e-6)
    expected, a = profile(mu, n)
    assert a == pytest.approx(haskell_a(n), rel=1e-7)
    np.testing.assert_allclose(radiance, expected, rtol=2e-5, atol=2e-5)


def test_fresnel_law_at_the_paper_s_index():
    """A = 2.7586; face-on 1.1068 × J_n/π by hand: (2A + 3)(1 − (0.37/2.37)²)/(4 n²)."""
    _scene, emitter = glowing_sphere(FRESNEL, exitance=1.0)
    assert haskell_a(1.37) == pytest.approx(2.7586, abs=5e-5)
    assert emitter.eval(towards(np.ones(1)))[0, 0] * np.pi == pytest.approx(1.1068, abs=1e-4)
    assert emitter.eval(towards(np.full(1, 0.05)))[0, 0] * np.pi < 0.4
    assert emitter.eval(towards(np.full(1, -0.5)))[0, 0] == 0


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_every_question_gets_the_same_radiance(law):
    """eval, eval_direction, sample_direction, sample_ray and sample_wavelengths, from all round the sphere.

    With the profile left out of any one of them, or taken towards the local instead of the world's direction in
    sample_wavelengths, the Fresnel case fails.
    """
    _scene, emitter = glowing_sphere(law())
    rng = np.random.default_rng(4)
    sample = mi.Point2f(rng.random((2, 500)))

    def radiance_towards(point, direction):
        point = point.numpy()
        return emitter.eval(seen(3 * point / np.linalg.norm(point, axis=0), direction.numpy())).numpy()[0]

    it = dr.zeros(mi.Interaction3f, 500)
    it.p = mi.Point3f(rng.normal(scale=9, size=(3, 500)))
    ds, weight = emitter.sample_direction(it, sample)
    expected = radiance_towards(ds.p, -ds.d)
    pdf = ds.pdf.numpy()
    assert (expected > 0).sum() > 100
    np.testing.assert_allclose(weight.numpy()[0] * pdf, np.where(pdf > 0, expected, 0), rtol=2e-4, atol=1e-9)
    np.testing.assert_allclose(emitter.eval_direction(it, ds).numpy()[0], expected, rtol=2e-4, atol=1e-8)

    ps, area = emitter.sample_position(0, sample)
    si = mi.SurfaceInteraction3f(ps, mi.Color0f())
    si.wi = -ds.d  # of the world, as ptracer has it
    told = emitter.sample_wavelengths(si, 0.5)[1].numpy()[0]
    np.testing.assert_allclose(told, radiance_towards(ps.p, -ds.d), rtol=2e-4, atol=1e-8)

    ray, power = emitter.sample_ray(0, 0.5, sample, mi.Point2f(rng.random((2, 500))))
    radiance = radiance_towards(ray.o, ray.d)
    np.testing.assert_allclose(power.numpy()[0], radiance * np.pi * area.numpy(), rtol=1e-3)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_power_of_sampled_rays(law):
    """The mean weight of `sample_ray` is the power, J_n times the area."""
    _scene, emitter = glowing_sphere(law())
    rng = np.random.default_rng(1)
    _, power = emitter.sample_ray(0, 0.5, mi.Point2f(rng.random((2, 400_000))), mi.Point2f(rng.random((2, 400_000))))
    power = power.numpy()[0]
    assert abs(power.mean() - 2e-3 * 36 * np.pi) < 4 * power.std() / np.sqrt(power.size) + 1e-6


@pytest.mark.parametrize("law", LAWS[1:], ids=NAMES[1:])
def test_three_independent_ways_agree(law):
    """Integral, path and ptracer, per pixel: no |z| > 5, no bias in the sum."""
    scene = glowing_sphere(law())[0]
    exact = fspt.render(scene, method="integral")
    assert exact.power.sum() > 0
    for method, spp in (("path", 256), ("ptracer", 1024)):
        sampled = fspt.render(scene, method=method, spp=spp, seed=3)
        seen = sampled.error > 0
        z = (sampled.power - exact.power)[seen] / np.hypot(sampled.error, exact.error)[seen]
        assert np.abs(z).max() < 5, method
        sums = sampled.power.sum(), np.sqrt((sampled.error**2).sum())
        assert abs(sums[0] - exact.power.sum()) < 4 * sums[1], method


def test_fresnel_pixels_over_lambert_pixels():
    """In the middle of the image their ratio is the profile's."""
    exact, lambert = (fspt.render(glowing_sphere(law)[0], method="integral", max_nodes=16) for law in (FRESNEL, {}))
    tilt = np.sqrt(1 - 2 * 0.7**2 / 3 / 9)  # the mean over a pixel of 0.7 mm beside the middle
    ratio = exact.power[5:7, 5:7] / lambert.power[5:7, 5:7]
    np.testing.assert_allclose(ratio, np.pi * float(profile(tilt, 1.37)[0]), rtol=1e-3)


def test_last_flight_over_a_slope():
    """Over a linear fluence the integral along the line is exact: L ∝ T (Φ − ∇Φ·ω_i/µt), the rest is carrying J_n.

    With the direction not refracted, or T left out, off by more than 3 %.
    """
    at, slope = SLOPING
    _scene, emitter = glowing_sphere(last_flight(at, slope), exitance=1.0)
    x, w = np.polynomial.legendre.leggauss(40)
    mu, w = ((x + 1) / 2) ** 2, (x + 1) / 2 * w  # µ = x²; w = dµ
    azimuth = np.arange(12) * 2 * np.pi / 12
    mu, azimuth = (a.ravel() for a in np.meshgrid(mu, azimuth, indexing="ij"))
    w = np.repeat(w, 12) * 2 * np.pi / 12
    t, inner = transmittance(mu, 1.37)
    sine = np.sqrt(1 - mu**2) / 1.37
    climb = slope[0] * sine * np.cos(azimuth) + slope[1] * sine * np.sin(azimuth) + slope[2] * inner
    expected = t * (at + 3 * slope[2] - climb / (MUA + MUSP))  # at the top of the sphere, 3 mm up
    expected /= (expected * mu * w).sum()
    radiance = emitter.eval(towards(mu, azimuth)).numpy()[0]
    assert (radiance * mu * w).sum() == pytest.approx(1, abs=2e-4)
    np.testing.assert_allclose(radiance, expected, rtol=3e-4, atol=1e-4)


def test_last_flight_on_a_half_space_is_the_fresnel_law():
    """With the slope of the boundary condition, Φ + 2AD ∂Φ/∂n = 0, the two laws are one: 1/(D µt) = 3."""
    diffusion = 1 / (3 * (MUA + MUSP))
    top = 2.0  # Φ at the top of the sphere, z = 3
    slope = -top / (2 * haskell_a(1.37) * diffusion)
    mu = np.linspace(0.02, 1, 60)
    _one, flight = glowing_sphere(last_flight(top - 3 * slope, (0, 0, slope)))
    _two, fresnel = glowing_sphere(FRESNEL)
    told, expected = (emitter.eval(towards(mu)).numpy()[0] for emitter in (flight, fresnel))
    np.testing.assert_allclose(told, expected, rtol=3e-4)


def carried(emitter, si, count):
    """∫ L µ dΩ by a fine rule at surface records that hold each of `count` points once a direction."""
    local, weight = hemisphere()
    si.wi = mi.Vector3f(np.tile(local, count))
    return emitter.eval(si).numpy()[0].reshape(count, weight.size) @ weight


def hemisphere():
    """Directions (3, N) about the normal and their weights for ∫ f µ dΩ."""
    x, w = np.polynomial.legendre.leggauss(24)
    mu, w = ((x + 1) / 2) ** 2, (x + 1) / 2 * w
    cosine, azimuth = (a.ravel() for a in np.meshgrid(mu, np.arange(10) * 2 * np.pi / 10, indexing="ij"))
    sine = np.sqrt(1 - cosine**2)
    return np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine]), cosine * np.repeat(w, 10) * np.pi / 5


def test_last_flight_carries_the_exitance_everywhere():
    """∫ L µ dΩ = J_n all over the sphere, between the points where it was tabulated too."""
    points = np.random.default_rng(2).normal(size=(3, 50))
    points *= 3 / np.linalg.norm(points, axis=0)
    _scene, emitter = glowing_sphere(last_flight(*SLOPING), exitance=1.0)
    si = seen(np.repeat(points, hemisphere()[1].size, axis=1), np.ones((3, 1)))
    np.testing.assert_allclose(carried(emitter, si, 50), 1, rtol=1e-3)


def test_last_flight_carries_the_exitance_on_a_mesh():
    """Likewise on the faces of a cube, each with thousands of table entries; one off by an entry: 1e-2 away."""
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(3)}
    scene = mi.load_dict({"type": "scene", "cube": cube | {"emitter": emitting(last_flight(*STEEP))}})
    where = np.random.default_rng(3).uniform(-2.9, 2.9, (2, 50))
    where = np.repeat(where, hemisphere()[1].size, axis=1)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(where[0], where[1], 9.0), mi.Vector3f(0, 0, -1)))
    np.testing.assert_allclose(carried(scene.emitters()[0], si, 50), 1, rtol=2e-4)


def test_last_flight_is_the_same_in_both_domains():
    """Over a steep fluence the radiance differs with the azimuth, too. Seen to fail, by 0.2 of the brightest pixel,
    with directions told in the frame of another point than they are looked up in.
    """
    scene, _emitter = glowing_sphere(last_flight(*STEEP))
    accuracy = {"method": "integral", "rtol": 1e-2}
    pupil, surface = (fspt.render(scene, domain=domain, **accuracy) for domain in ("pupil", "surface"))
    assert (np.abs(pupil.power - surface.power) <= 3 * (pupil.error + surface.error)).all()
    assert surface.power.sum() == pytest.approx(pupil.power.sum(), rel=1e-3)


def test_fluence_updated_by_itself_is_followed():
    """Expected: the image of a scene that had it from the start. Seen to fail where J_n alone is evaluated again."""
    scene, emitter = glowing_sphere(last_flight(*STEEP))
    fspt.render(scene, method="integral", rtol=0.3)
    turned = sloping(1.0, (-0.1, 0.05, 0.1))
    values = mi.traverse(emitter.surface.law.fluence)
    values["data"] = mi.traverse(mi.load_dict(turned))["data"]
    values.update()
    anew = glowing_sphere(last_flight(1.0, (0, 0, 0), fluence=turned))[0]
    pictures = [fspt.render(each, method="integral", rtol=0.3).power for each in (scene, anew)]
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ({"emission": "phong"}, "'emission' must be one of fresnel, lambert, last_flight, got 'phong'"),
        ({"emission": "fresnel"}, "emission 'fresnel' needs 'int_ior'"),
        ({"emission": "fresnel", "int_ior": 0.9}, "'int_ior' must be >= 1 and at most 100, got 0.9"),
        ({"emission": "fresnel", "int_ior": float("inf")}, "'int_ior' must be >= 1 and at most 100, got inf"),
        ({"emission": "last_flight", "int_ior": 1.37, "mua": 0.1, "musp": 1.0}, "needs 'fluence'.*as a volume"),
        ({"emission": "last_flight", "int_ior": 1.37, "mua": 0.1}, "needs 'musp'"),
        (
            {"emission": "last_flight", "int_ior": 1.37, "mua": -0.1, "musp": 1.0, "fluence": {"type": "constvolume"}},
            "'mua' must be >= 0",
        ),
    ],
)
def test_bad_laws_are_refused(law, message):
    with pytest.raises((ExitanceError, RuntimeError), match=message):
        glowing_sphere(law)


@pytest.mark.parametrize(("musp", "told"), [(4.6, 0), (9.1, 1)])
def test_coefficients_in_1_cm_are_told(musp, told, caplog):
    """Rationale: 9.1 1/cm, given as they stand, shorten the last flight to a tenth, without a word."""
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        glowing_sphere(last_flight(*SLOPING, musp=musp))
    assert caplog.text.count("fspt_surface: 'musp' = 9.1 1/mm is more than soft tissue has") == told


def test_fluence_that_does_not_fit_the_shape_is_refused():
    small = sloping(1.0, (0, 0, 0)) | {"to_world": mi.ScalarTransform4f().translate([-2, -2, -2]).scale(4)}
    scene = glowing_sphere(last_flight(1.0, (0, 0, 0), fluence=small))[0]
    with pytest.raises(ExitanceError, match=r"'fluence', from \(-2, -2, -2\) to \(2, 2, 2\) mm, does not hold"):
        fspt.render(scene, method="integral")
    scene = glowing_sphere(last_flight(0.0, (1, 0, 0)))[0]
    with pytest.raises(ExitanceError, match="'fluence' has values <= 0"):
        fspt.render(scene, method="integral")
