"""The float64 reference of Eq. 9 against closed forms, conservation laws and itself by another way.

Seen to fail: with 1/π, 1/t or one cosine dropped from the pupil form: the closed form, the balance and the pinhole;
with α, cos θ_s, cos θ_d or the bars |cos θ_s| dropped from the surface form: the agreement of the two; with lit backs
or a mirrored x axis: the shadow and the orientation.
"""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from small_scenes import configuration_factor

from references import sampled
from references.camera import look_at
from references.cases import EXITANCE, camera, pose, rms, sheet, uniform, wavy
from references.sampled import collected_power, pupil_form, surface_form
from references.shapes import Cylinder, Disc, Rectangle, Sphere


@pytest.mark.parametrize("distance", [110.0, 165.0, 900.0])
@pytest.mark.parametrize("pixel", ["centre", "area"])
def test_uniform_sheet_meets_the_closed_form(distance, pixel):
    """Rationale: a filled cone of uniform radiance gives P = J_n · A_vd · f, whatever the surface.
    Expected: every pixel to 1e-9; over the pixel's area f itself is averaged, by another Gauss rule.
    """
    lens = camera()
    power, error = pupil_form(lens, [sheet(distance)], uniform, 12 if pixel == "centre" else 8, pixel=pixel)
    node, weight = (np.zeros(1), np.full(1, 2.0)) if pixel == "centre" else np.polynomial.legendre.leggauss(9)
    side = 1.0 * (165 / 55 - 1)  # p/t
    x, y = (side * (np.arange(n)[:, None] + 0.5 + node / 2 - n / 2) for n in (6, 5))
    off_axis = np.hypot(x[None, :, None, :], y[:, None, :, None])
    factor = configuration_factor(55 / 2.8 / 2, 165, off_axis) @ weight @ weight / 4
    np.testing.assert_allclose(power, EXITANCE * side**2 * factor, rtol=1e-9)
    assert error.max() < 1e-4 * power.max()


@pytest.mark.parametrize("focus_distance", [165.0, 230.0])
def test_power_is_conserved_at_every_focus(focus_distance):
    """Rationale: Σ P = ∫_S J_n f dS does not depend on the focus: refocusing conserves the light.
    Expected: to 1e-4, the silhouette's error at 2048 lines of sight a pixel.
    """
    lens = camera(focus_distance=focus_distance, width=26, height=24, pixel_pitch=0.32, to_world=pose())
    ball = Sphere(lens.in_world(np.array([[1.0, -0.5, 190.0]]))[0], 6.0)
    power, _ = pupil_form(lens, [ball], wavy, 2048, "lattice")
    assert power[[0, -1]].max() == power[:, [0, -1]].max() == 0  # the whole image is on the film
    np.testing.assert_allclose(power.sum(), collected_power(lens, ball, wavy, 2**17), rtol=1e-4)


def test_small_patch_on_axis_sends_sin_squared_through_the_pupil():
    """Rationale: Σ P = J_n A sin²θ for a small patch on the axis. Expected: to (patch/distance)²."""
    patch, radius = Disc([0, 0, 190.0], [0, 0, -1], 0.2), 55 / 2.8 / 2
    expected = EXITANCE * np.pi * 0.2**2 * radius**2 / (radius**2 + 190**2)
    assert collected_power(camera(), patch, uniform, 4096) == pytest.approx(expected, rel=3e-6)


def test_power_follows_the_squared_diameter_down_to_the_pinhole():
    """Rationale: P → J_n/π · πD²/4 · A_vd · cos⁴θ/u², the pinhole model, as D → 0.
    Expected: J_n of the one line of sight at every pixel, off by O(D²): 1e-6 at f/500, a quarter at f/1000.
    """
    flat = Rectangle([0, 0, 140.0], [0, 90, 0], [90, 0, 0])
    row, column = np.indices((5, 6))
    virtual = np.stack([(2.5 - column) * 2.0, (2 - row) * 2.0, np.full((5, 6), 165.0)], axis=-1).reshape(-1, 3)
    cos4 = (165 / np.linalg.norm(virtual, axis=1)) ** 4
    off = []
    for f_number in (500.0, 1000.0):
        power, _ = pupil_form(camera(f_number=f_number), [flat], wavy, 8, pixel="centre")
        area = np.pi * (55 / f_number) ** 2 / 4
        pinhole = wavy(virtual * 140 / 165, 0) / np.pi * area * 2.0**2 * cos4 / 165**2
        off.append(np.abs(power.ravel() / pinhole - 1).max())
    assert off[0] < 1e-6
    assert off[0] / off[1] == pytest.approx(4, rel=0.01)


@pytest.mark.parametrize(
    ("body", "pixel"),
    [(Cylinder([0, 1, 215.0], [0.3, 1, 0.4], 7.0, 16.0), "area")],
)
def test_pupil_form_and_surface_form_are_one_integral(body, pixel):
    """Rationale: dS |cos θ_s|/|r_vd − r|² = dA_a cos θ/|r_vd − a|² turns one into the other, on both sides.
    Expected: within the errors stated, and 5e-3 of the peak, silhouettes included; in the sum 5e-4.
    """
    lens = camera(pixel_pitch=1.6)
    by_pupil, error = pupil_form(lens, [body], wavy, 2**13, "lattice", pixel)
    by_surface, other = surface_form(lens, body, wavy, 2**18, pixel)
    assert np.count_nonzero(by_pupil) > 8
    assert rms(by_surface - by_pupil) < np.hypot(rms(error), rms(other))
    assert np.abs(by_surface - by_pupil).max() < 5e-3 * by_pupil.max()
    assert by_surface.sum() == pytest.approx(by_pupil.sum(), rel=5e-4)


def test_a_dark_back_hides_what_lies_behind():
    """Rationale: a disc in the virtual detector plane is in focus: its shadow has no penumbra."""
    shade = Disc([3.0, 2.0, 165.0], [0, 0, 1], 1.6)  # the pixel in row 1, column 1 and a part of its neighbours
    power, _ = pupil_form(camera(), [sheet(400.0), shade], uniform, 6)
    free, _ = pupil_form(camera(), [sheet(400.0)], uniform, 6)
    beside = [0, 1, 1, 2], [1, 0, 2, 1]
    assert power[1, 1] == 0
    assert np.all(power[beside] < free[beside])
    np.testing.assert_allclose(power[3:], free[3:], rtol=1e-12)
    np.testing.assert_allclose(power[:, 3:], free[:, 3:], rtol=1e-12)


def test_image_is_upright_and_not_mirrored():
    """Rationale: +y of the camera frame is up, +x left, as in Mitsuba; row 0 is at the top."""
    power, _ = pupil_form(camera(), [Sphere([5.0, 4.0, 165.0], 1.0)], uniform, 256, "lattice")
    assert np.unravel_index(power.argmax(), power.shape) == (0, 0)


def test_look_at_sees_the_target_upright():
    """Rationale: from +x, with z up, the world's +y is to the right and +z above: off to the left, -y, and above."""
    lens = camera(to_world=look_at([180, 0, 0], [0, 0, 0], [0, 0, 2]))
    np.testing.assert_allclose(lens.from_world(np.array([[15.0, -5, 4]])), [[5, 4, 165]], atol=1e-12)
    power, _ = pupil_form(lens, [Sphere([15.0, -5, 4], 1.0)], uniform, 256, "lattice")
    assert np.unravel_index(power.argmax(), power.shape) == (0, 0)


@pytest.mark.parametrize(
    ("body", "volume"),
    [(Sphere([1, 2, 3], 4.0), 4 / 3 * np.pi * 64), (Cylinder([1, 2, 3], [1, 1, 0.2], 3.0, 5.0), np.pi * 45)],
)
def test_bodies_agree_with_their_own_surface(body, volume):
    """Rationale: ∮ r·n dS = 3V, and a line down the normal meets the surface where it started."""
    points, area = body.surface(sampled.lattice(2**14, (0.3, 0.6)))
    normal = body.outward(points)
    assert area * np.mean(np.sum(points * normal, axis=1)) == pytest.approx(3 * volume, rel=1e-4)
    np.testing.assert_allclose(body.meet(points + 50 * normal, -normal), 50, atol=1e-9)


def test_impossible_cameras_are_refused():
    with pytest.raises(ValueError, match=r"focus_distance 55\.0"):
        camera(focus_distance=55.0)
    with pytest.raises(ValueError, match="rotation"):
        camera(to_world=np.diag([1.0, 1.0, -1.0, 1.0]))


def test_references_share_no_code_with_what_they_measure():
    """Rationale: a reference that imports the plugins' optics would inherit their errors."""
    allowed = {"__future__", "collections", "dataclasses", "functools", "math", "pathlib", "typing", "numpy", "trimesh"}
    names = ["bodies", "camera", "fans", "meshes", "rows", "sampled", "shapes"]
    folder = Path(sampled.__file__).parent
    assert {path.stem for path in folder.glob("*.py")} - {"__init__", "cases", "random_scenes"} == {
        *names,
        *(path.stem for path in folder.glob("test_*.py")),
    }
    for node in (node for name in names for node in ast.walk(ast.parse((folder / f"{name}.py").read_text()))):
        if isinstance(node, ast.ImportFrom):
            assert node.module in names if node.level else (node.module or "").split(".")[0] in allowed
        elif isinstance(node, ast.Import):
            assert all(alias.name.split(".")[0] in allowed for alias in node.names)
