"""Methods that share nothing but the scene: the integral, Mitsuba's path and ptracer, and a float64 NumPy reference.

Monte Carlo is judged pixel by pixel in units of its own standard error. Of N such numbers the largest counts, so each
is held to the level 1 − (1 − 0.01)^(1/N) of Student's t (Šidák): all of them together raise a false alarm for 1 of 100
seeds, and the seeds are fixed.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh
from references.camera import ReferenceCamera
from references.cases import rms
from references.meshes import TriangleMesh, mesh_truth
from references.sampled import pupil_form
from references.shapes import Sphere
from scipy.stats import t as student
from small_scenes import (
    F_NUMBER,
    FOCAL,
    FOCUS,
    HEIGHT,
    PITCH,
    WIDTH,
    attribute,
    camera_scene,
    disk,
    glow,
    load_scene,
    power,
    sphere,
)

import mitsuba_fspt as fspt

pytestmark = pytest.mark.usefixtures("mono")

WHOLE_SPHERE = (4, 6, 24, 24)  # crop window
LEVEL = 0.01
PASSES = 16
MODELS = {
    "cone": {"model": "ripoll", "numerical_aperture": 0.06},
    "stop behind": {"f_number": 11.0, "lens_diameter": 6.0, "diaphragm_distance": 30.0},
    "stop before": {"f_number": 11.0, "lens_diameter": 6.0, "diaphragm_distance": -30.0},
}


def phantom(name):
    """The scene made anew: kernels hold a branch for each emitter alive, and are not shared where those differ."""
    if name in MODELS:
        return camera_scene(sphere(180.0, 8.0, 3.0, -2.0), crop=WHOLE_SPHERE, **MODELS[name])
    return load_scene(name, f_number=2.8)


@cache
def passes(name, method, spp=160, seed=1):
    """Independent images [W], (PASSES, h, w): their scatter is all that is known of their noise."""
    import mitsuba as mi

    of = phantom(name)
    sensor = of.sensors()[0]
    integrator = mi.load_dict({"type": method, "max_depth": 1})
    pictures = [integrator.render(of, sensor, seed=1000 * seed + k, spp=spp) for k in range(PASSES)]
    return np.array([np.array(picture) for picture in pictures], np.float64)[..., 0]


@cache
def integral(name):
    """Image by the integral to 1e-3 [W], (h, w)."""
    return fspt.render(phantom(name), method="integral", rtol=1e-3).power


def groups(pictures, bright):
    """Every bright pixel, blocks of 8 × 8 with the faint ones, and the sum of all, (…, N)."""
    parts = bright.shape[0] // 8, 8, bright.shape[1] // 8, 8
    blocks = pictures.reshape(*pictures.shape[:-2], *parts).sum((-3, -1))
    lit = np.any(bright.reshape(parts), axis=(1, 3))
    total = pictures.sum((-2, -1))[..., None]
    return np.concatenate([pictures[..., bright], blocks[..., lit], total], axis=-1)


def limit(count, freedom):
    return student.isf((1 - (1 - LEVEL) ** (1 / count)) / 2, freedom)


def noise(samples):
    return samples.std(0, ddof=1) / np.sqrt(len(samples))


def assert_agrees(pictures, picture, rtol):
    """No pixel, block nor the sum is farther from the deterministic `picture` than rtol plus what chance allows.

    Faint pixels are hit too rarely for a normal law and count in their block only.
    """
    bright = picture > 0.05 * picture.max()
    assert bright.sum() > 50
    mean, sigma, truth = (groups(p, bright) for p in (pictures.mean(0), pictures, picture))
    sigma = noise(sigma)
    error = np.full(picture.shape, (rtol * picture.max()) ** 2)
    chance = limit(len(truth), len(pictures) - 1) * sigma
    reach = chance + np.sqrt(groups(error, bright))
    assert np.median(reach[: bright.sum()] / truth[: bright.sum()]) < 0.1  # else nothing is tested
    assert reach[-1] < 4e-3 * truth[-1]
    np.testing.assert_array_less(np.abs(mean - truth) / reach, 1)


@pytest.mark.parametrize("method", ["path", "ptracer"])
@pytest.mark.parametrize(("name", "spp"), [("nylon_cylinder", 64), ("two_spheres", 128)])
def test_integral_agrees_with_monte_carlo(name, spp, method):
    """Rationale: lines of sight from the pixel, and light from the surface ∝ J_n, estimate what Eq. 9 integrates.

    Expected: within the noise, a few per cent a pixel and 3e-3 in all, on a mesh with J_n at its vertices and where
    one body hides part of another. Seen to fail with cos⁴θ → cos³θ in the line of sight (against ptracer), with the
    1/π of the radiance dropped (against ptracer, whose positions know J_n alone) and with the near sphere left out.
    """
    assert_agrees(passes(name, method, spp=spp), integral(name), 1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_path_agrees_with_ptracer_for_every_model_of_the_lens(name):
    """Rationale: ptracer turns the pupil's area into a solid angle by dA_a/dA_ρ, which path never needs.

    Expected: within the noise. Seen to fail with that factor dropped and with the second border ignored by one.
    """
    forward, backward = passes(name, "ptracer", spp=96), passes(name, "path")
    mean = backward.mean(0)
    bright = mean > 0.03 * mean.max()
    first, second = groups(forward, bright), groups(backward, bright)
    sigma = np.hypot(noise(first), noise(second))
    t = (first.mean(0) - second.mean(0)) / sigma
    assert np.median(sigma / second.mean(0)) < 0.03
    assert sigma[-1] < 1e-3 * second[:, -1].mean()
    assert np.abs(t).max() < limit(len(t), len(forward) - 1)


@pytest.mark.parametrize("name", MODELS)
def test_integral_agrees_with_path_for_every_model_of_the_lens(name):
    """Expected: within the noise; a border that cuts the pupil is one more jump of the integrand."""
    assert_agrees(passes(name, "path"), integral(name), 1e-3)


def test_render_gives_the_standard_error_of_its_mean(monkeypatch):
    """Rationale: `error` under Monte Carlo is what independent repetitions scatter by.

    Expected: over 8 seeds and 100 pixels on silhouettes the same variance within 20 %. Seen to fail with √passes
    dropped and with the same seed for every pass.
    """
    monkeypatch.setattr("mitsuba_fspt.rendering.render.PASSES", 8)
    images = [fspt.render(phantom("two_spheres"), method="path", spp=64, seed=seed) for seed in range(8)]
    stack, error = np.array([i.power for i in images]), np.array([i.error for i in images])
    jumpy = error.mean(0) > 0.01 * stack.max()
    assert jumpy.sum() > 30
    scatter = stack.std(0, ddof=1)[jumpy]
    assert np.mean(scatter**2) == pytest.approx(np.mean(error[:, jumpy] ** 2), rel=0.2)


# --- the reference in float64 ---


MIDDLE = (WIDTH // 2 - 6, HEIGHT // 2 - 5, 12, 10)


def camera(width, height):
    return ReferenceCamera(FOCAL, F_NUMBER, FOCUS, PITCH, width, height)


def test_integral_agrees_with_the_reference_where_one_body_hides_another():
    """Rationale: the reference shares no code, no ray tracer and no float32 with the integral.

    Expected: to the accuracy asked for plus the reference's own error (2e-3 at worst), in the middle of the film, where
    the near sphere, out of focus, covers the edge of the far one. Seen to fail with the near sphere left out, cos⁴θ →
    cos³θ, 1/π dropped.
    """
    objects = [(sphere(180.0, 8.0, -6.5), 1.0), (sphere(140.0, 2.0, 1.0, -0.5), 2.0)]
    shapes = [{**shape, "emitter": glow(exitance)} for shape, exitance in objects]
    picture = power(camera_scene(*shapes, crop=MIDDLE), rtol=1e-3)
    balls = [Sphere(shape["center"], shape["radius"]) for shape, _ in objects]
    truth, error = pupil_form(
        camera(*MIDDLE[2:]), balls, lambda p, i: np.full(len(p), (1.0, 2.0)[i]), 1 << 14, "lattice"
    )
    assert error.max() < 6e-3 * truth.max()
    assert rms(picture - truth) < 1e-3 * truth.max()
    np.testing.assert_allclose(picture, truth, atol=1e-3 * truth.max() + error.max())


def test_integral_agrees_with_the_reference_on_a_mesh_with_exitance_at_its_vertices(tmp_path):
    """Rationale: as above; the reference draws the mesh with a depth buffer and traces no ray.

    Expected: to the accuracy asked for, plus the reference's own standard error.
    """
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=4.0)
    mesh.apply_translation([0.3, -0.2, 172.0])
    x, y, z = mesh.vertices.T
    exitance = 1 + 0.6 * np.sin(0.8 * x + 1.1 * y) * np.cos(0.5 * z)
    mesh.vertex_attributes["exitance_x"] = exitance.astype(np.float32)
    mesh.export(tmp_path / "ball.ply")
    ball = {"type": "ply", "filename": str(tmp_path / "ball.ply"), "face_normals": True, "emitter": glow(attribute())}
    picture = power(camera_scene(ball, crop=MIDDLE), rtol=1e-3)
    body = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), exitance[mesh.faces])
    truth, error = mesh_truth(camera(*MIDDLE[2:]), body, levels=((512, 3),))
    assert error.max() < 1.5e-3 * truth.max()
    np.testing.assert_allclose(picture, truth, atol=1e-3 * truth.max() + 3 * error.max())


def test_integral_agrees_with_path_where_the_lens_border_cuts_the_pupil():
    """Rationale: path draws lens points everywhere and drops what the border stops, the integral never leaves it.

    Expected: the accuracy asked for, beside the noise. Seen to fail, by 3.5e-2, with nodes that pass the border by.
    """
    vignetted = camera_scene(
        disk(FOCUS, 200.0), f_number=5.6, lens_diameter=22.0, diaphragm_distance=20.0, pixel_pitch=1.0
    )
    picture = power(vignetted, rtol=5e-3)
    path = fspt.render(vignetted, method="path", spp=512, seed=1)
    assert picture.min() < 0.8 * picture.max()
    np.testing.assert_allclose(picture, path.power, atol=5e-3 * picture.max() + 4 * path.error.max())
