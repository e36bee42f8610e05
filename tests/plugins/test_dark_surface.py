"""Surfaces whose J_n is 0 everywhere: an optimiser's start, a dark control. Dark images, and a warning."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from small_scenes import HEIGHT, SIDE, WIDTH, attribute, camera_scene, disk, glow, mi, sphere, write_ply

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import ExitanceError

pytestmark = pytest.mark.usefixtures("mono")
METHODS = {
    "pupil": {"method": "integral", "rtol": 1e-2},
    "surface": {"method": "integral", "domain": "surface", "rtol": 1e-2},
    "path": {"method": "path", "spp": 4},
    "ptracer": {"method": "ptracer", "spp": 4},
}


def by_value(path, level):
    return {**sphere(165, 8), "emitter": glow(float(level))}


def by_bitmap(path, level):
    texels = mi.Bitmap(np.full((8, 8, 1), level, np.float32))
    return {**sphere(165, 8), "emitter": glow({"type": "bitmap", "raw": True, "bitmap": texels})}


def by_attribute(path, level):
    body = trimesh.creation.icosphere(2, radius=8)
    body.apply_translation([0, 0, 165])
    write_ply(path / "body.ply", body.vertices, body.faces, vertex=np.full(len(body.vertices), level))
    settings = {"filename": str(path / "body.ply"), "face_normals": True}
    return {"type": "ply", **settings, "emitter": glow(attribute())}


@pytest.mark.parametrize(
    ("body", "method"),
    [
        *((by_value, method) for method in METHODS),
        (by_bitmap, "ptracer"),
        (by_attribute, "ptracer"),
        (by_bitmap, "pupil"),
        (by_bitmap, "surface"),
        (by_attribute, "surface"),
    ],
)
def test_a_dark_body_gives_a_dark_image_and_a_warning(body, method, tmp_path):
    """Seen to fail: refused; then with `ptracer` drawing points from a distribution without any mass."""
    image = fspt.render(camera_scene(body(tmp_path, 0.0)), **METHODS[method])
    assert image.shape == (HEIGHT, WIDTH)
    assert not image.power.any()
    assert not image.error.any()
    assert "the picture is dark" in image.metadata["warnings"]
    assert "'exitance' is not 0 everywhere" in image.metadata["warnings"]
    if method != "surface":  # which leaves out elements that do not glow
        assert image.coverage.max() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_coverage_counts_dark_faces_of_a_glowing_mesh(domain, tmp_path):
    """A square of which one triangle glows covers all its pixels. Seen to fail: 0 on the dark one's by the surface."""
    corners = [(-9, -9, 165), (9, -9, 165), (9, 9, 165), (-9, 9, 165)]
    write_ply(tmp_path / "square.ply", corners, [(0, 2, 1), (0, 3, 2)], face=[1.0, 0.0])
    settings = {"filename": str(tmp_path / "square.ply"), "face_normals": True}
    square = {"type": "ply", **settings, "emitter": glow(attribute("face_exitance"))}
    image = fspt.render(camera_scene(square), method="integral", domain=domain, rtol=1e-2)
    dark = image.power == 0
    assert (dark & (image.coverage > 0.99)).sum() > 200
    assert (~dark & (image.coverage > 0.99)).sum() > 200
    # 22.5 x 22.5 pixels; by few lines of sight on the pixels of its border.
    assert image.coverage.sum() == pytest.approx((18 / SIDE) ** 2, rel=0.03)


@pytest.mark.parametrize("method", ["surface", "ptracer"])
def test_a_dark_body_beside_a_bright_one_adds_nothing(method):
    bright = {**disk(150, 2, 14), "emitter": glow(1.0)}
    settings = METHODS[method] | ({"spp": 256, "seed": 1} if "spp" in METHODS[method] else {})
    alone = fspt.render(camera_scene(bright), **settings)
    beside = fspt.render(camera_scene(bright, {**sphere(165, 5), "emitter": glow(0.0)}), **settings)
    assert beside.power.sum() == pytest.approx(alone.power.sum(), rel=0.05 if "spp" in settings else 1e-2)
    assert "warnings" not in beside.metadata


@pytest.mark.parametrize("body", [by_value, by_bitmap, by_attribute])
def test_points_of_a_dark_body_are_drawn_all_the_same(body, tmp_path):
    """Seen to fail (NaN) with a distribution without any mass."""
    scene = camera_scene(body(tmp_path, 0.0))
    sample = mi.Point2f(*np.random.default_rng(1).random((2, 100)))
    place, weight = scene.emitters()[0].sample_position(0.0, sample)
    assert np.isfinite(place.p.numpy()).all()
    assert np.isfinite(weight.numpy()).all()
    assert (place.pdf.numpy() > 0).all()
    ray, power = scene.emitters()[0].sample_ray(0.0, 0.5, sample, mi.Point2f(sample.y, sample.x))
    assert np.isfinite(ray.d.numpy()).all()
    assert not power.numpy().any()


def test_light_comes_when_values_do():
    scene = camera_scene(by_value(None, 0.0))
    assert not np.any(mi.render(scene, integrator=mi.load_dict({"type": "ptracer"}), spp=1))
    parameters = mi.traverse(scene)
    parameters["shape_0.emitter.exitance.value"] = 1.0
    parameters.update()
    expected = fspt.render(camera_scene(by_value(None, 1.0)), **METHODS["pupil"])
    np.testing.assert_array_equal(fspt.render(scene, **METHODS["pupil"]).power, expected.power)
    traced = fspt.render(scene, method="ptracer", spp=64, seed=1)
    assert traced.power.sum() == pytest.approx(expected.power.sum(), rel=0.02)


NEGATIVE = [(body, -1e-9) for body in (by_value, by_bitmap, by_attribute)]


@pytest.mark.parametrize(("body", "level"), [*NEGATIVE, (by_value, np.nan), (by_bitmap, np.nan)])
def test_negative_and_missing_values_stay_refused(body, level, tmp_path):
    with pytest.raises(ExitanceError, match=r"must be >= 0 W/mm²|NaN or infinite values"):
        fspt.render(camera_scene(body(tmp_path, level)), rtol=1e-2)
