"""The scene file made for a phantom: the phantom stands in the middle and fills the film from every side."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small_scenes import SCENES, write_ply

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.formats.ply import write_ply as write_any_ply
from mitsuba_fspt.phantom.framed_scene import camera_lens
from mitsuba_fspt.runtime.errors import ExitanceError, FluxError, OpticsError, SceneError

CYLINDER = SCENES / "nylon_cylinder.ply"
SMALL = {"width": 48, "height": 48, "pixel_pitch": 0.108 * 256 / 48}
DEFAULTS = {"f_number", "view", "rtol", "focal_length", "magnification", "distance", "width", "height", "pixel_pitch"}


def defaults(text):
    """Values of the text's <default> parameters."""
    return {name: float(value) for name, value in re.findall(r'<default name="(\w+)" value="([^"]+)"', text)}


def box(path, size=(20, 8, 60), centre=(100, -40, 7), face=False):
    """PLY of a box, J_n = 1e-3 W/mm² on its vertices or faces."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size + centre
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in squares for triangle in ((a, b, c), (a, c, d))]
    glow = {"face": [1e-3] * 12} if face else {"vertex": [1e-3] * 8}
    return write_ply(path, corners, faces, **glow)


def test_it_is_the_shipped_scene_to_the_last_bit():
    """Seen to fail with the turn clockwise, and with the camera focused on the axis."""
    view = 37
    text = fspt.scene_xml(CYLINDER, focal_length=55, f_number=8, magnification=0.5, **SMALL)
    image = fspt.render(fspt.load(text, view=view, rtol=1e-2))
    shipped = fspt.render(fspt.load(SCENES / "nylon_cylinder.xml", view=view, rtol=1e-2, **SMALL))
    assert shipped.power.max() > 0
    np.testing.assert_array_equal(image.power, shipped.power)


def test_the_text_has_the_defaults_of_the_shipped_scenes():
    text = fspt.scene_xml(CYLINDER, focal_length=50, f_number=1.8, rtol=1e-2)
    assert text.startswith("<?xml")
    assert set(defaults(text)) == DEFAULTS
    found = defaults(text)
    assert (found["focal_length"], found["f_number"], found["view"], found["rtol"]) == (50, 1.8, 0, 1e-2)
    assert found["distance"] == pytest.approx(50 * (1 + 1 / found["magnification"]) + 15, abs=1e-6)  # focus in front


@pytest.mark.parametrize(
    ("focal_length", "size", "film", "side"),
    [(105, (20, 8, 60), (40, 32), 0), (12, (60, 8, 6), (40, 32), 1), (105, (5, 5, 5), (24, 60), 1)],
)
def test_the_phantom_fills_most_of_the_film_and_is_whole_in_every_view(tmp_path, size, film, side, focal_length):
    """Far from the world's origin, too; the widest view reaches 0.8 to 1 of the film's height or width."""
    text = fspt.scene_xml(
        box(tmp_path / "box.ply", size), focal_length=focal_length, width=film[0], height=film[1], pixel_pitch=0.5
    )
    widest = []
    for view in (0, 30, 90, 150):
        image = fspt.render(fspt.load(text, view=view), rtol=0.1)
        lit = image.coverage > 0
        rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
        assert rows[0] > 0
        assert columns[0] > 0
        assert rows[-1] < film[1] - 1
        assert columns[-1] < film[0] - 1
        widest.append((np.ptp(rows) / film[1], np.ptp(columns) / film[0]))
    assert 0.75 < np.max(widest, axis=0)[side] <= 1


@pytest.mark.parametrize(
    "more", [{"pupil_magnification": 0.4}, {"distortion": "1.5, 0"}, {"distortion": "-1.5, 3", "f_number": 8.0}]
)
def test_it_fills_the_film_of_a_real_lens(tmp_path, more):
    """Pincushion and barrel are seen to fail for the thin lens. A pupil magnification moves only what is out of focus:
    in focus the scale is t whatever P is, and the case passes for the thin lens, too.
    """
    film = {"focal_length": 12, "width": 40, "height": 32, "pixel_pitch": 0.5}
    lit = fspt.render(fspt.load(fspt.scene_xml(box(tmp_path / "box.ply"), **film | more), view=30), rtol=1e-2).coverage
    rows = np.flatnonzero((lit > 0).any(axis=1))
    assert 0 < rows[0] < 4
    assert 28 <= rows[-1] < 31


def test_the_bounding_box_stays_in_the_middle(tmp_path):
    """Turned by 180°, a box far from the origin is the mirror image of itself: by the world's axis it were gone."""
    text = fspt.scene_xml(box(tmp_path / "box.ply"), width=32, height=32, pixel_pitch=0.8)
    powers = [fspt.render(fspt.load(text, view=view), rtol=2e-3).power for view in (0, 180)]
    assert powers[0].max() > 0
    np.testing.assert_allclose(powers[1], powers[0], rtol=0, atol=2e-3 * powers[0].max())


def test_a_phantom_that_is_no_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"must be the name of a PLY file, got Phantom\. .* write it"):
        fspt.scene_xml(fspt.Phantom.read(box(tmp_path / "box.ply")))


@pytest.mark.parametrize("face", [False, True])
def test_exitance_on_vertices_or_faces_is_recognised(tmp_path, face):
    text = fspt.scene_xml(box(tmp_path / "box.ply", face=face), width=12, height=12, pixel_pitch=2)
    assert ('value="face_exitance"' in text) is face
    assert fspt.render(fspt.load(text)).power.max() > 0


def test_a_magnification_or_a_distance_alone_keeps_the_front_in_focus(tmp_path):
    path = box(tmp_path / "box.ply", (6, 8, 3))  # 5 mm from its axis to its edges
    found = [
        defaults(fspt.scene_xml(path, focal_length=50, **given))
        for given in ({"magnification": 0.25}, {"distance": 255}, {"focus_distance": 250}, {"image_distance": 62.5})
    ]
    assert [one["distance"] for one in found] == pytest.approx([255] * 4)
    assert [one["magnification"] for one in found] == pytest.approx([0.25] * 4)
    both = defaults(fspt.scene_xml(path, focal_length=50, magnification=0.5, distance=300))
    assert (both["magnification"], both["distance"]) == (0.5, 300)


def test_further_numbers_of_the_lens_reach_it():
    text = fspt.scene_xml(CYLINDER, model="hrrt", lens_diameter=22.0)
    optics = fspt.load(text).sensors()[0].camera.lens
    assert (optics.model.name, optics.lens_diameter) == ("hrrt", 22)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"f_number": -2}, OpticsError, "'f_number' must be > 0"),
        ({"focal_length": "long"}, SceneError, "'focal_length' must be a number, got 'long'"),
        ({"pixel_pitch": 0}, SceneError, "'pixel_pitch' must be > 0 mm and finite, got 0"),
        ({"width": 0}, SceneError, "'width' must be >= 1 pixel, got 0"),
        ({"height": 2.5}, SceneError, "'height' must be a whole number, got 2.5"),
        ({"view": float("nan")}, SceneError, "'view' must be finite"),
        ({"distance": 60}, SceneError, "'distance' must be > 65 mm and finite, got 60"),
        ({"distance": 15, "magnification": 1}, SceneError, "'distance' must be > 15 mm"),
        ({"magnification": 1, "focus_distance": 100}, OpticsError, "exactly one of"),
        ({"pixel_pitch": 1e-12}, OpticsError, "no magnification"),
    ],
)
def test_invalid_cameras(given, error, message):
    with pytest.raises(error, match=re.escape(message)) as caught:
        fspt.scene_xml(CYLINDER, **given)
    assert "\n" not in str(caught.value)


def test_a_file_without_exitance_is_refused(tmp_path):
    with pytest.raises(ExitanceError, match=r"l_shape\.ply.*must have one property with J_n.*flux import"):
        fspt.scene_xml(SCENES / "l_shape.ply")
    with pytest.raises(FluxError, match="no such file"):
        fspt.scene_xml(tmp_path / "none.ply")
    with pytest.raises(SceneError, match=r"has a \$ in its path"):
        fspt.scene_xml(box(tmp_path / "a$b.ply"))


def test_a_file_with_another_name_of_the_exitance_gives_the_same_image(tmp_path):
    """Seen to fail with the attribute vertex_exitance, which that file does not have."""
    phantom = fspt.Phantom.read(box(tmp_path / "own.ply"))
    write_any_ply(tmp_path / "other.ply", phantom.vertices, phantom.faces, {"jn_x": phantom.exitance}, phantom.per, {})
    own, other = (
        fspt.render(fspt.scene_xml(tmp_path / f"{name}.ply", rtol=0.1, **SMALL)).power for name in ("own", "other")
    )
    assert own.any()
    np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("name", ["a & b.ply", 'quote"s.ply', "a--b.ply", "ü.ply"])
def test_any_name_of_a_file(tmp_path, name):
    assert fspt.load(fspt.scene_xml(box(tmp_path / name))).shapes()[0].id() == "phantom"


def test_the_lens_of_a_camera_file(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text('[lens]\nname = "50 mm"\nfocal_length = 50\nf_number = 1.8\nwidth = 64\n[detector]\ngain = 2.0\n')
    assert camera_lens(path) == {"focal_length": 50, "f_number": 1.8, "width": 64}
    assert defaults(fspt.scene_xml(CYLINDER, **camera_lens(path)))["width"] == 64


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[detector]\ngain = 1\n", "has no table [lens]"),
        ("lens = 3\n", "has no table [lens]"),
        ("[lens]\nf_number = [1, 2]\n", "'f_number' must be a number or a text, got [1, 2]"),
        ("[lens\n", "is no TOML file"),
        (None, "cannot be read"),
    ],
)
def test_camera_files_that_cannot_be_used(tmp_path, content, message):
    path = tmp_path / "camera.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SceneError, match=re.escape(message)):
        camera_lens(path)


def test_a_front_out_of_focus_is_reported(tmp_path, run):
    """A plate 60 mm wide and 8 thick: in view 0 its front is 26.3 mm behind the plane through its edges, 30.3 mm from
    the axis. With the magnification that the line gives, a point of the front is imaged to a point.
    """
    path, film = box(tmp_path / "plate.ply", (8, 60, 6)), {"width": 60, "height": 40, "pixel_pitch": 0.4}
    text = fspt.scene_xml(path, **film)
    told = re.search(
        r"In view 0 the front lies ([\d.]+) mm behind .* magnification = (\S+) with distance = (\S+) f", text
    )
    gap, magnification, distance = map(float, told.groups())
    assert gap == pytest.approx(np.hypot(30, 4) - 4, abs=0.05)
    assert distance == pytest.approx(defaults(text)["distance"])
    sharp = fspt.scene_xml(path, **film, magnification=magnification, distance=distance)
    assert "In view" not in sharp
    lens = fspt.load(sharp).sensors()[0].camera.lens
    assert lens.focus_distance == pytest.approx(distance - 4, rel=1e-3)
    assert "In view" not in fspt.scene_xml(path, **film, view=90)
    options = [text for name, value in film.items() for text in ("-D", f"{name}={value}")]
    options += ["-D", "rtol=0.5", "--view", "0,90"]
    code, _, err = run("render", path, *options, "-o", tmp_path / "o.npz", "--quiet")
    assert code == 0
    assert re.fullmatch(r"fspt: \S+o_view0.npz: In view 0 the front lies 26.3 mm behind the virtual .*\n", err)
