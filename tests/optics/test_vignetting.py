"""Measured vignetting: every way to the power on a pixel has its share, by values written out here once more."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small_scenes import (
    BALL_XML,
    FOCUS,
    HEIGHT,
    LENS_XML,
    PITCH,
    WIDTH,
    camera_scene,
    disk,
    filled,
    glow,
    lens,
    mi,
    power,
    write_ply,
    write_scene,
)

import mitsuba_fspt as fspt
from mitsuba_fspt.rendering.live_scene import LiveScene
from mitsuba_fspt.runtime.errors import ImageError, SceneError
from mitsuba_fspt.studies.explain import explain
from mitsuba_fspt.validation import direct_summation

pytestmark = pytest.mark.usefixtures("mono")
HEIGHTS, SHARES = (0, 4, 8, 12), (1, 0.95, 0.75, 0.4)
CROP = (14, 10, 12, 10)


@pytest.fixture
def curve(tmp_path):
    rows = "".join(f"{h},{s}\n" for h, s in zip(HEIGHTS, SHARES, strict=True))
    (tmp_path / "curve.csv").write_text(f"mm,share\n{rows}")
    return str(tmp_path / "curve.csv")


@pytest.fixture
def patches(tmp_path):
    """Shares without any symmetry, on the pixels of the small film, as an image and as an EXR of it."""
    shares = np.random.default_rng(3).uniform(0.3, 1.0, (HEIGHT, WIDTH)).astype(np.float32)
    fspt.Image(shares).write(tmp_path / "patches.exr")
    np.save(tmp_path / "patches.npy", shares)
    return shares.astype(np.float64), str(tmp_path / "patches.exr")


def curve_on_pixels(nodes=40):
    """Mean of the curve over each pixel, by many points."""
    steps = (np.arange(nodes) + 0.5) / nodes
    x = ((np.arange(WIDTH)[:, None] + steps).ravel() - WIDTH / 2) * PITCH
    y = ((np.arange(HEIGHT)[:, None] + steps).ravel() - HEIGHT / 2) * PITCH
    fine = np.interp(np.hypot(x[None, :], y[:, None]), HEIGHTS, SHARES)
    return fine.reshape(HEIGHT, nodes, WIDTH, nodes).mean(axis=(1, 3))


@pytest.mark.parametrize("domain", ["pupil", "surface"])
def test_uniform_plane_in_closed_form(domain, curve, patches):
    """P = share · J_n A_vd f on every pixel. Seen to fail without the share in `Solver.solve`."""
    shares, file = patches
    tolerance = 2e-5 if domain == "pupil" else 1e-2
    settings = {"rtol": 1e-4 if domain == "pupil" else 1e-2, "domain": domain}
    found = power(camera_scene(disk(FOCUS, 300.0), vignetting=file), **settings)
    np.testing.assert_allclose(found, shares * filled(), rtol=tolerance)
    if domain == "pupil":
        found = power(camera_scene(disk(FOCUS, 300.0), vignetting=curve), **settings)
        np.testing.assert_allclose(found, curve_on_pixels() * filled(), rtol=1e-4)


def test_a_crop_has_the_shares_of_its_own_pixels(curve, patches):
    x, y, w, h = CROP
    for file, shares in ((curve, curve_on_pixels()), (patches[1], patches[0])):
        found = power(camera_scene(disk(FOCUS, 300.0), vignetting=file, crop=CROP), rtol=1e-4)
        np.testing.assert_allclose(found, (shares * filled())[y : y + h, x : x + w], rtol=1e-4)


def test_an_image_of_a_crop_window_serves_windows_inside_it(patches, tmp_path):
    """It has its place in the metadata, as `reduce` writes it; a window that lies elsewhere is refused."""
    x, y, w, h = CROP
    whole = fspt.render(camera_scene(disk(FOCUS, 300.0)), method="integral", rtol=1e-2)
    part = whole[y : y + h, x : x + w]
    shares = patches[0][y : y + h, x : x + w]
    fspt.Image(shares, metadata=part.metadata).write(tmp_path / "part.exr")
    inside = (x + 1, y + 2, 8, 7)
    found = power(camera_scene(disk(FOCUS, 300.0), vignetting=str(tmp_path / "part.exr"), crop=inside), rtol=1e-4)
    expected = (patches[0] * filled())[inside[1] : inside[1] + 7, inside[0] : inside[0] + 8]
    np.testing.assert_allclose(found, expected, rtol=2e-5)
    with pytest.raises(RuntimeError, match="outside which the scene's lies in part"):
        camera_scene(disk(FOCUS, 300.0), vignetting=str(tmp_path / "part.exr"), crop=(x - 1, y, w, h))


@pytest.mark.parametrize("method", ["path", "ptracer"])
def test_monte_carlo_agrees_with_the_integral(method, patches):
    """z-test over the pixels, and the ratio of the totals. Seen to fail (p < 1e-9, ratio 1.5) without the share in
    `sample_ray` and in `sample_direction`.
    """
    scene = camera_scene(disk(180.0, 9.0, 3.0, 2.0), vignetting=patches[1], crop=CROP)
    image = fspt.render(scene, method="integral", rtol=1e-3)
    found = fspt.compare(image, fspt.render(scene, method=method, spp=1024, seed=2))
    assert found.z_test.p_value > 1e-3
    assert found.ratio == pytest.approx(1, abs=0.01)


def test_the_sum_over_points_has_it(patches):
    clear, dim = (camera_scene(disk(180.0, 9.0), **more) for more in ({}, {"vignetting": patches[1]}))
    powers = [direct_summation.solve(scene, scene.sensors()[0].camera, 400)[0] for scene in (clear, dim)]
    np.testing.assert_allclose(powers[1], patches[0] * powers[0], rtol=1e-12)


def test_the_tolerance_is_that_of_the_dimmed_image(tmp_path):
    """Where the share takes most of the brightest pixels, the others are refined for what is left of them.

    Seen to fail without the second solution.
    """
    shares = np.ones((HEIGHT, WIDTH))
    shares[:, : WIDTH // 2] = 0.02
    np.save(tmp_path / "half.npy", shares)
    bright = {**disk(180.0, 2.0, 3.0), "emitter": glow(20.0)}  # on the dimmed half: +x is to the left
    scene = camera_scene(bright, disk(181.0, 2.0, -3.0), vignetting=str(tmp_path / "half.npy"), crop=CROP)
    image = fspt.render(scene, method="integral", rtol=3e-2)
    assert image.error.max() <= 3e-2 * image.power.max()


def test_the_matrix_and_the_units_have_it(patches, tmp_path, caplog):
    """T @ J is the image; radiances are those of the lens without it, from which the étendue has the share, too.

    Seen to fail with `camera.etendue` in place of `pixel_etendues` in `view_rows`, and without the share in
    `etendue_of`.
    """
    corners = [(0, -9, -9), (0, 9, -9), (0, 9, 9), (0, -9, 9)]
    ply = write_ply(tmp_path / "p.ply", corners, [(0, 1, 2), (0, 2, 3)], vertex=[1.0, 2.0, 3.0, 2.5])
    np.save(tmp_path / "small.npy", patches[0][:16, :16])
    film = {"width": 16, "height": 16, "pixel_pitch": 0.8, "magnification": 0.5, "f_number": 8}
    text = fspt.scene_xml(ply, vignetting=str(tmp_path / "small.npy"), **film)
    scene = fspt.load(text)
    image = fspt.render(scene, rtol=1e-3)
    T = fspt.transport(text, rtol=1e-3)
    np.testing.assert_allclose(
        T.forward([1.0, 2.0, 3.0, 2.5])[0], image.power, rtol=1e-2, atol=2e-3 * image.power.max()
    )
    assert T.metadata["lenses"][0]["vignetting"] == str(tmp_path / "small.npy")
    plain = fspt.render(fspt.scene_xml(ply, **film), rtol=1e-3)
    caplog.clear()
    T.images([image])
    assert not caplog.text
    T.images([plain])
    assert f"image 0 has vignetting = none, its view of the matrix {tmp_path / 'small.npy'}" in caplog.text
    expected = patches[0][:16, :16] * plain.power
    np.testing.assert_allclose(image.power, expected, atol=1e-3 * expected.max())
    with_it, without = (one.to_radiance(660).values for one in (image, plain))
    np.testing.assert_allclose(with_it, without, atol=4e-3 * without.max())
    assert image.roi(None, 660).mean_radiance == pytest.approx(plain.roi(None, 660).mean_radiance, rel=1e-3)


def test_the_light_left_out_counts_with_its_shares(tmp_path):
    """A diffuse wall behind the film's dark half is lit by the disk: of the light on the film, little is left out.

    Seen to fail without the shares, where the wall's light counts in full.
    """
    shares = np.where(np.arange(WIDTH) < WIDTH // 2, 0.01, 1.0) * np.ones((HEIGHT, 1))
    np.save(tmp_path / "half.npy", shares)
    place = mi.ScalarTransform4f().translate([18.0, 0.0, 190.0]).rotate([0, 1, 0], 180).scale(15.0)
    wall = {"type": "disk", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.9}}
    lamp = {"type": "sphere", "center": [0.0, 0.0, 175.0], "radius": 3.0}
    found = {}
    for name, more in (("clear", {}), ("dim", {"vignetting": str(tmp_path / "half.npy")})):
        scene = camera_scene(lamp, bodies=(wall,), **more)
        image = fspt.render(scene, method="integral", rtol=1e-2)
        found[name] = image.metadata["light_left_out"]
    assert found["clear"] > 3 * found["dim"] > 0


def test_drafts_of_the_viewer_have_it_and_explain_names_it(curve, tmp_path):
    more = f'<string name="vignetting" value="{curve}"/>\n        <transform name="to_world">'
    write_scene(tmp_path / "dim.xml", sensor=LENS_XML.replace('<transform name="to_world">', more))
    write_scene(tmp_path / "clear.xml")
    dim, clear = (LiveScene(tmp_path / f"{name}.xml") for name in ("dim", "clear"))
    x, y = (np.arange(8) - 3.5) * 0.8, (np.arange(6) - 2.5)[:, None] * 0.8
    shares = np.interp(np.hypot(x, y), HEIGHTS, SHARES)
    one, other = dim.draft({}), clear.draft({})
    np.testing.assert_allclose(one.power, shares * other.power, atol=4e-3 * other.power.max())
    rows = {row.what: row for row in explain(tmp_path / "dim.xml", rtol=1e-1)}
    assert (rows["measured vignetting"].left_out, rows["measured vignetting"].why) == (False, curve)
    assert rows["distortion"].left_out


def test_derivatives_have_it(curve):
    """Of the f-number: shares times those without, since the tolerance is that of the same image."""
    more = f'<string name="vignetting" value="{curve}"/>\n        <transform name="to_world">'
    dim, clear = (
        f'<scene version="3.0.0"><default name="f_number" value="8"/><default name="distance" value="165"/>'
        f'<integrator type="fspt_integral"/>{text}{BALL_XML}</scene>'
        for text in (LENS_XML.replace('<transform name="to_world">', more), LENS_XML)
    )
    one, other = (fspt.derivatives(text, ["f_number"], rtol=2e-3)["f_number"] for text in (dim, clear))
    x, y = (np.arange(8) - 3.5) * 0.8, (np.arange(6) - 2.5)[:, None] * 0.8
    shares = np.interp(np.hypot(x, y), HEIGHTS, SHARES)
    assert np.abs(other.value).max() > 0
    peak = np.abs(other.value).max()
    np.testing.assert_allclose(one.value, shares * other.value, atol=2e-3 * peak)


def test_a_scene_file_names_a_file_beside_itself(tmp_path, monkeypatch):
    """And a changed file makes new images; an image whose file has changed gives no radiance."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "v.csv").write_text("0,1\n9,1\n")
    more = '<string name="vignetting" value="v.csv"/>\n        <transform name="to_world">'
    write_scene(folder / "s.xml", sensor=LENS_XML.replace('<transform name="to_world">', more))
    monkeypatch.chdir(tmp_path)
    first = fspt.sweep("scenes/s.xml", {"f_number": [8]}, "o", rtol=1e-2)
    image = fspt.render("scenes/s.xml", rtol=1e-2)
    assert image.to_radiance(660).values.max() > 0
    (folder / "v.csv").write_text("0,0.5\n9,0.5\n")
    second = fspt.sweep("scenes/s.xml", {"f_number": [8]}, "o", rtol=1e-2)
    assert not second[0].reused
    assert second[0].power == pytest.approx(first[0].power / 2, rel=1e-6)
    with pytest.raises(ImageError, match="is not the file that the image was made with"):
        image.to_radiance(660)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,1\n5,1.2\n20,0.5\n", "a share must be > 0 and at most 1, got 1.2 at 5 mm"),
        ("0,1\n5,nan\n20,0.5\n", "a share must be > 0 and at most 1, got nan at 5 mm"),
        ("0,1\n20,0\n", "a share must be > 0 and at most 1, got 0 at 20 mm"),
        ("0,1\n8,0.9\n5,0.8\n", "the image heights must ascend, got 5 mm in row 3"),
        ("1,1\n20,0.9\n", "begins at an image height of 1 mm"),
        ("-1,1\n20,0.9\n", "begins at an image height of -1 mm"),
        ("0,1\n", "has one row"),
        ("0,1\n5,0.9\n", "ends at an image height of 5 mm, the film's corner lies at"),
        ("0,1,2\n5,0.9,1\n", "has 3 columns, must have 2"),
    ],
)
def test_curves_that_the_lens_refuses(rows, message, tmp_path):
    (tmp_path / "v.csv").write_text(rows)
    refused({"vignetting": str(tmp_path / "v.csv"), "size": 40}, message)


def refused(settings, message):
    scene = {"type": "scene", "camera": lens(**settings), "ball": {"type": "sphere"}}
    with pytest.raises(SceneError, match=re.escape(message)) as caught:
        fspt.load(scene)
    assert "\n" not in str(caught.value)


def test_images_that_the_lens_refuses(tmp_path):
    for name, values, message in (
        ("wide", np.ones((8, 16)), "has 16 × 8 pixels, the film 16 × 16. Give an image of the film's shape"),
        ("twice", np.ones((32, 32)), "has 32 × 32 pixels, the film 16 × 16"),
        ("dark", np.zeros((16, 16)), "a share must be > 0 and at most 1, got 0 at row 0, column 0 and 255 others"),
        ("nan", np.where(np.eye(16), np.nan, 1), "got nan at row 0, column 0"),
        ("stack", np.ones((3, 16, 16)), "must have the shape (h, w), got (3, 16, 16)"),
        ("text", np.full((16, 16), "a"), "must hold numbers"),
    ):
        np.save(tmp_path / f"{name}.npy", values)
        refused({"vignetting": str(tmp_path / f"{name}.npy")}, message)
    (tmp_path / "broken.exr").write_bytes(b"no image")
    refused({"vignetting": str(tmp_path / "broken.exr")}, "is no readable OpenEXR file")
    refused({"vignetting": "gone.exr"}, "is no file")
    refused({"vignetting": 0.5}, "must be the name of a CSV file or image, got 0.5")
