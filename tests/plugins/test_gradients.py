"""Gradients of `mi.render` by what is behind `exitance`: against the transport matrix and differences of images."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from small_scenes import attribute, ball, by_elements, glow, lens, mi, world_scene, write_ply

import mitsuba_fspt as fspt
from mitsuba_fspt.integral.rows import exitance_rows
from mitsuba_fspt.runtime.errors import SceneError

import drjit as dr  # isort: skip  # after the package, which chooses its LLVM

pytestmark = pytest.mark.usefixtures("mono")
ROOT = Path(__file__).resolve().parents[2]
SIZE = (16, 12)
RTOL = 4e-3
BODY = trimesh.creation.icosphere(2, radius=4.0)  # 162 vertices, 320 faces
SMOOTH = np.exp(-((BODY.vertices - [4, 1, 1]) ** 2).sum(axis=1) / 20).astype(np.float32)
VALUES = {"vertex": SMOOTH, "face": SMOOTH[BODY.faces].mean(axis=1)}
WAVE = np.sin(np.arange(SIZE[0]) / 2 + np.arange(SIZE[1])[:, None] / 3)[..., None].astype(np.float32)


def mesh_scene(folder, on, values=None, rtol=RTOL, sensor=None):
    """An icosphere out of focus before the lens, with its J_n on vertices or faces."""
    path = write_ply(folder / f"{on}.ply", BODY.vertices, BODY.faces, **{on: VALUES[on] if values is None else values})
    body = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute(f"{on}_exitance"))}
    integrator = {"type": "fspt_integral", "rtol": rtol}
    sensor = sensor or lens(SIZE, distance=172.0, f_number=2.8)
    return world_scene(body, sensor=sensor, integrator=integrator)


def bitmap_scene(texels, rtol=RTOL, **more):
    """A sphere with its J_n from a bitmap of these texels (h, w)."""
    texels = mi.Bitmap(np.asarray(texels, np.float32)[..., None])
    body = {"type": "sphere", "radius": 4.0, "emitter": glow({"type": "bitmap", "raw": True, "bitmap": texels})}
    return world_scene(body, sensor=lens(SIZE, **more), integrator={"type": "fspt_integral", "rtol": rtol})


def attached(scene, key):
    """Parameters of a scene, with gradients of one enabled."""
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[key])
    parameters.update()
    return parameters


def backward(scene, key, gradient=WAVE):
    """Gradient of Σ gradient · image by one parameter."""
    parameters = attached(scene, key)
    dr.clear_grad(parameters[key])
    dr.backward(dr.sum(mi.render(scene, parameters) * mi.TensorXf(gradient), axis=None))
    return np.array(dr.grad(parameters[key]))


def forward(scene, key, tangent):
    """Tangent (h, w, 1) of the image for that of one parameter."""
    parameters = attached(scene, key)
    dr.set_grad(parameters[key], type(parameters[key])(tangent))
    return np.array(dr.forward_to(mi.render(scene, parameters)))


def moved(scene, key, change):
    """Image (h, w, 1) [W] with a parameter changed by so much."""
    parameters = mi.traverse(scene)
    old = type(parameters[key])(dr.detach(parameters[key]))
    parameters[key] = old + change
    parameters.update()
    picture = np.array(mi.render(scene), np.float64)
    parameters[key] = old
    parameters.update()
    return picture


@pytest.mark.parametrize("behind", ["mesh", "bitmap"])
def test_vignetting_is_in_both_modes(behind, tmp_path):
    """Shares of the pixels multiply the tangent, and the gradient by the image. Seen to fail without either."""
    shares = np.random.default_rng(5).uniform(0.3, 1.0, SIZE[::-1])
    np.save(tmp_path / "v.npy", shares)
    texels = np.random.default_rng(6).uniform(1, 2, (4, 4))

    def scene(**more):
        if behind == "bitmap":
            return bitmap_scene(texels, rtol=1e-2, **more)
        return mesh_scene(tmp_path, "vertex", sensor=lens(SIZE, distance=172.0, f_number=2.8, **more))

    key, tangent = {
        "mesh": ("shape_0.vertex_exitance", SMOOTH),
        "bitmap": ("shape_0.emitter.exitance.data", texels[..., None]),
    }[behind]
    dim, clear = scene(vignetting=str(tmp_path / "v.npy")), scene()
    expected = shares[..., None] * forward(clear, key, tangent)
    np.testing.assert_allclose(forward(dim, key, tangent), expected, rtol=2e-5, atol=1e-6 * expected.max())
    weighted = backward(clear, key, (WAVE * shares[..., None]).astype(np.float32))
    np.testing.assert_allclose(backward(dim, key), weighted, rtol=1e-4, atol=1e-6 * np.abs(weighted).max())


@pytest.mark.parametrize("on", ["vertex", "face"])
def test_reverse_mode_is_the_transpose_of_the_transport_matrix(on, tmp_path):
    """To single precision of the matrix of the same rtol, to rtol of a ten times finer one. Faces are small.

    Seen to fail without the exit law's 1/π, and with the gradient of the next pixel.
    """
    scene = mesh_scene(tmp_path, on)
    found = backward(scene, f"shape_0.{on}_exitance")
    for rtol, bound in ((RTOL, 1e-6), (RTOL / 10, RTOL)):
        T = fspt.transport(scene, on=on, rtol=rtol)
        expected = T.T @ WAVE.ravel()
        assert np.linalg.norm(found - expected) <= bound * np.linalg.norm(expected)
        assert np.abs(found - expected).max() <= 3 * bound * np.abs(expected).max()
    assert (found[~T.seen] == 0).all()


def test_a_number_and_an_attribute_on_two_meshes(tmp_path):
    """The derivative of the sum of all pixels by the J_n of one of them is its power on the film at 1 W/mm².

    Seen to fail with the columns of the two meshes swapped.
    """
    shapes = []
    for k, (radius, exitance) in enumerate(((3.0, 1e-3), (4.0, attribute("face_exitance")))):
        shift = np.array([0.0, 10.0 * k - 5, 0.0])
        path = write_ply(tmp_path / f"{k}.ply", BODY.vertices * radius / 4 + shift, BODY.faces, face=VALUES["face"])
        shapes.append({"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(exitance)})
    scene = world_scene(*shapes, sensor=lens(SIZE), integrator={"type": "fspt_integral", "rtol": RTOL})
    T = fspt.transport(scene, on="face", rtol=RTOL / 10)
    first, second = (T.sensitivity[part] for part in T.parts.values())
    ones = np.ones_like(WAVE)
    assert backward(scene, "shape_0.emitter.exitance.value", ones) == pytest.approx(first.sum(), rel=RTOL)
    assert backward(scene, "shape_1.face_exitance", ones).sum() == pytest.approx(second.sum(), rel=RTOL)
    assert first.sum() < 0.8 * second.sum()


def test_a_dark_surface_has_its_gradient(tmp_path):
    dark = backward(mesh_scene(tmp_path, "vertex", 0 * SMOOTH), "shape_0.vertex_exitance")
    bright = backward(mesh_scene(tmp_path, "vertex"), "shape_0.vertex_exitance")
    assert np.abs(bright).max() > 0
    np.testing.assert_allclose(dark, bright, atol=1e-5 * np.abs(bright).max())  # the order of sums varies


def test_a_number(monkeypatch):
    """The image is linear in it, so that the derivative is the image of 1 W/mm², by however few lines of sight.

    Seen to fail without the exit law's 1/π, and without the factors on the rows.
    """
    monkeypatch.setattr(exitance_rows, "LEAST_LINES", 1)
    monkeypatch.setattr(exitance_rows, "MOST_LINES", 1 << 10)
    scene = world_scene(ball(2e-3), sensor=lens(SIZE))
    key = "shape_0.emitter.exitance.value"
    expected = np.vdot(WAVE, moved(scene, key, 1.0) - moved(scene, key, 0.0))
    assert abs(expected) > 0
    assert backward(scene, key) == pytest.approx(expected, rel=2 * RTOL)


def test_texels_of_a_bitmap():
    """Differences of two images are exact, for the image is linear."""
    texels = 1e-3 * (1.5 + np.sin(np.arange(8) + np.arange(6)[:, None]))
    scene = bitmap_scene(texels, rtol=8e-4)
    key = "shape_0.emitter.exitance.data"
    found = backward(scene, key).reshape(texels.shape)
    largest = float(np.abs(found).max())
    dark = moved(scene, key, 0.0)
    for texel in ((3, 0), (2, 7), (3, 4)):
        change = np.zeros((*texels.shape, 1), np.float32)
        change[texel] = 1.0
        expected = np.vdot(WAVE, moved(scene, key, mi.TensorXf(change)) - dark)
        assert found[texel] == pytest.approx(expected, abs=2 * RTOL * largest)
    assert found[3, 4] == 0  # turned away from the lens
    assert found[3, 0] != 0


def test_forward_mode_is_the_image_of_the_tangent(tmp_path):
    """By elements of the surface, which find the steps between small faces more exactly."""
    on = "vertex"
    scene = mesh_scene(tmp_path, on)
    key = f"shape_0.{on}_exitance"
    tangent = VALUES[on][::-1].copy()
    expected = by_elements(mesh_scene(tmp_path, on, tangent), rtol=RTOL / 2)
    off = np.abs(forward(scene, key, tangent)[..., 0] - expected.power)
    assert (off - expected.error).max() <= RTOL * expected.power.max()


def dot_test(scene, key, size):
    """Assert ⟨g, ∂P t⟩ = ⟨∂Pᵀ g, t⟩ for a signed tangent t; forward and reverse mode."""
    tangent = np.random.default_rng(1).standard_normal(size).astype(np.float32)
    value = mi.traverse(scene)[key]
    ahead, back = forward(scene, key, tangent.reshape(np.shape(value))), backward(scene, key)
    length = float(np.linalg.norm(WAVE) * np.linalg.norm(ahead))
    assert np.vdot(WAVE.astype(np.float64), ahead) == pytest.approx(np.vdot(back, tangent), abs=1e-6 * length)
    return ahead, back


def test_forward_and_reverse_mode_are_transposes(tmp_path, monkeypatch):
    """On a mesh, and of a bitmap over several batches of lines of sight, too."""
    dot_test(mesh_scene(tmp_path, "vertex"), "shape_0.vertex_exitance", len(SMOOTH))
    scene, key = bitmap_scene(np.ones((4, 6))), "shape_0.emitter.exitance.data"
    ahead, back = dot_test(scene, key, 24)
    monkeypatch.setattr(exitance_rows, "BATCH", 1 << 15)
    np.testing.assert_allclose(dot_test(scene, key, 24)[0], ahead, atol=1e-5 * np.abs(ahead).max())
    np.testing.assert_allclose(backward(scene, key), back, atol=1e-5 * np.abs(back).max())


@pytest.mark.parametrize("on", ["vertex", "bitmap"])
def test_latent_numbers_and_several_batches(tmp_path, monkeypatch, on):
    """J_n = s · J with a factor s: the chain from s to the image stands through all batches of reverse mode."""
    monkeypatch.setattr(exitance_rows, "BATCH", 1 << 15)
    if on == "vertex":
        scene, key = mesh_scene(tmp_path, on), "shape_0.vertex_exitance"
    else:
        scene, key = bitmap_scene(1e-3 * np.ones((4, 6))), "shape_0.emitter.exitance.data"
    parameters, factor = mi.traverse(scene), mi.Float(2.0)
    dr.enable_grad(factor)
    parameters[key] = factor * type(parameters[key])(parameters[key])
    parameters.update()
    picture = mi.render(scene, parameters)
    dr.backward(dr.sum(picture, axis=None))
    total = float(np.array(picture, np.float64).sum())
    assert dr.grad(factor)[0] == pytest.approx(total / 2, rel=RTOL)


def test_an_optimisation_recovers_a_bitmap():
    """By mi.ad.Adam, from a dark surface; what the lens does not see stays dark."""
    truth = 1e-3 * (1.5 + np.sin(2 * np.arange(8) + np.arange(4)[:, None]))
    goal = mi.render(bitmap_scene(truth, rtol=1e-2))
    scene, key = bitmap_scene(0 * truth, rtol=1e-2), "shape_0.emitter.exitance.data"
    parameters, losses = mi.traverse(scene), []
    optimiser = mi.ad.Adam(lr=4e-4, params={key: parameters[key]})
    unit = float(np.max(goal))
    for _ in range(40):
        optimiser[key] = dr.maximum(optimiser[key], 0)
        parameters.update(optimiser)
        loss = dr.mean(dr.square((mi.render(scene, parameters) - goal) / unit), axis=None)
        dr.backward(loss)
        optimiser.step()
        losses.append(float(loss.array[0]))
    found = np.array(optimiser[key])[..., 0]
    assert losses[-1] < 1e-2 * losses[0]
    # The four middle texels of the near side fill most of the image.
    near = np.s_[1:3, [0, 7]]
    np.testing.assert_allclose(found[near], truth[near], rtol=0.15)
    assert not found[:, 3:5].any()


@pytest.mark.parametrize("name", ["camera.f_number", "shape_0.bsdf.reflectance.value", "shape_0.to_world"])
def test_other_gradients_are_refused(name):
    scene = world_scene({**ball(), "id": "shape_0"}, sensor=lens(8))
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[name])
    with pytest.raises(SceneError, match=f"parameter '{name}' has gradients enabled"):
        mi.render(scene, parameters)


def test_vertex_positions_are_refused(tmp_path):
    scene = mesh_scene(tmp_path, "vertex")
    parameters = attached(scene, "shape_0.vertex_positions")
    with pytest.raises(SceneError, match="'exitance' alone"):
        mi.render(scene, parameters)


INSIDE = """
import mitsuba_fspt
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_mono")
film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance"}
numbers = {"focal_length": 55.0, "f_number": 8.0, "magnification": 0.5, "pixel_pitch": 0.8}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "fspt_integral"}, "camera": {"type": "fspt_lens", "film": film, **numbers},
    "body": {"type": "sphere", "center": [0, 0, 165], "emitter": {"type": "fspt_surface", "exitance": 1.0}},
})
parameters = mi.traverse(scene)
dr.enable_grad(parameters["camera.f_number"])
mi.render(scene, parameters)
"""


def test_the_last_line_is_the_reason():
    done = subprocess.run([sys.executable, "-c", INSIDE], capture_output=True, text=True, check=False, cwd=ROOT)
    *_, last = done.stderr.splitlines()
    assert last.startswith("mitsuba_fspt.runtime.errors.SceneError: fspt_integral: parameter 'camera.f_number' has")


def pane():
    """A pane of glass that the light of a body at the origin passes."""
    place = mi.ScalarTransform4f().translate([20, 0, 0]).rotate([0, 1, 0], 90).scale(30)
    return {"type": "rectangle", "bsdf": {"type": "thindielectric"}, "to_world": place}


def test_light_of_a_mesh_through_glass_has_gradients(tmp_path):
    """Seen to fail with lines of sight that end at the glass, where the gradient is 0."""
    path = write_ply(tmp_path / "b.ply", BODY.vertices, BODY.faces, vertex=SMOOTH)
    body = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute())}
    scene = world_scene(body, pane(), sensor=lens(8), integrator={"type": "fspt_integral", "rtol": 1e-2})
    gradient = np.ones((8, 8, 1), np.float32)
    expected = fspt.transport(scene, rtol=1e-2).sensitivity
    np.testing.assert_allclose(backward(scene, "shape_0.vertex_exitance", gradient), expected, rtol=1e-5, atol=1e-12)
    assert expected.max() > 0


def test_light_through_glass_is_refused_where_lines_of_sight_are_fixed():
    scene = world_scene(ball(), pane(), sensor=lens(8))
    parameters = attached(scene, "shape_0.emitter.exitance.value")
    with pytest.raises(SceneError, match="which gradients do not follow"):
        mi.render(scene, parameters)
