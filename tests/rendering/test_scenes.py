"""The scenes and the script that makes their data: what the files promise in their comments is so."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from cylinder_diffusion import Phantom, exitance

import mitsuba_fspt as fspt
from mitsuba_fspt.cli import app
from mitsuba_fspt.runtime import backend

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scenes"
NAMES = ("l_shape", "nylon_cylinder", "textured_sphere", "two_spheres", "uniform_disk")

sys.path.insert(0, str(ROOT / "scripts"))

backend.ensure_variant()

import make_scenes  # noqa: E402
import mitsuba as mi  # noqa: E402


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with all data files, made afresh."""
    folder = tmp_path_factory.mktemp("scenes")
    make_scenes.make(folder)
    return folder


@pytest.fixture(scope="module")
def cylinder():
    """Vertices (V, 3), faces (F, 3), J_n (V,) of the committed PLY, float64."""
    mesh = trimesh.load(SCENES / "nylon_cylinder.ply", process=False)
    vertex = mesh.metadata["_ply_raw"]["vertex"]["data"]
    return np.asarray(mesh.vertices), np.asarray(mesh.faces), vertex["exitance_x"].astype(float).ravel()


def read_ply(path):
    """Header (bytes) and trimesh of a PLY."""
    return path.read_bytes().partition(b"end_header\n")[0], trimesh.load(path, process=False)


# --- the data files ---


def test_every_data_file_is_made_by_the_script_and_small(made):
    committed = {path.name for path in SCENES.iterdir() if path.suffix not in (".xml", ".toml")}
    assert committed == {path.name for path in made.iterdir()} | {"nylon_cylinder.ply"}
    assert sum((SCENES / name).stat().st_size for name in committed) < 4e6


def test_script_makes_the_same_bytes_again(made, tmp_path):
    make_scenes.make(tmp_path)
    for path in made.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_committed_mesh_is_what_the_script_makes(made):
    header, mesh = read_ply(SCENES / "l_shape.ply")
    fresh_header, fresh = read_ply(made / "l_shape.ply")
    assert header == fresh_header
    np.testing.assert_array_equal(mesh.faces, fresh.faces)
    np.testing.assert_array_equal(mesh.vertices, fresh.vertices)


def test_committed_image_is_what_the_script_makes():
    with OpenEXR.File(str(SCENES / "textured_sphere.exr")) as file:
        (name,) = file.channels()
        pixels = file.channels()[name].pixels
    assert name == "Y"
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels, make_scenes.sphere_picture())


def test_cylinder_file_is_what_the_command_makes(cylinder, tmp_path):
    """Expected: the same surface, and J_n to 1e-6 but where a vertex lies on the border of two curved cells and is
    found in one or the other as the processor rounds (1.2e-6 seen, at 7 of 45002).
    """
    assert app.run(["flux", "solve", str(SCENES / "nylon_cylinder.toml"), "-o", str(tmp_path / "fresh.ply")]) == 0
    vertices, faces, values = cylinder
    fresh = trimesh.load(tmp_path / "fresh.ply", process=False)
    np.testing.assert_array_equal(faces, fresh.faces)
    np.testing.assert_allclose(vertices, fresh.vertices, atol=1e-9)
    solved = fresh.metadata["_ply_raw"]["vertex"]["data"]["exitance_x"].ravel()
    np.testing.assert_allclose(values, solved, rtol=1e-5)
    assert np.mean(np.abs(values - solved) < 1e-6 * solved) > 0.999


def test_cylinder_file_is_one_that_mitsuba_reads_as_vertex_exitance(cylinder):
    vertices, _, values = cylinder
    header = (SCENES / "nylon_cylinder.ply").read_bytes().partition(b"end_header\n")[0].decode("ascii")
    assert header.startswith("ply\nformat binary_little_endian 1.0\n")
    assert re.findall(r"property double (\w+)", header) == ["x", "y", "z", "exitance_x"]
    assert "comment unit W/mm^2" in header
    assert len(vertices) >= 40_000
    assert values.min() > 0


# --- the meshes ---


def test_cylinder_is_closed_and_outward(cylinder):
    vertices, faces, _ = cylinder
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    # The inscribed surface falls short by (1 - sin x / x) of about x²/6, x = half the angle of a column.
    shortfall = (0.5 / 15) ** 2
    assert 1 - shortfall < mesh.volume / (np.pi * 15**2 * 30) < 1
    assert 1 - shortfall < mesh.area / (2 * np.pi * 15 * (15 + 30)) < 1


def test_l_is_flat_faces_x_and_is_no_mirror_image_of_itself():
    _, mesh = read_ply(SCENES / "l_shape.ply")
    assert mesh.area == pytest.approx(16 * 24 - 10 * 18, rel=1e-6)
    np.testing.assert_allclose(mesh.face_normals, np.broadcast_to([1.0, 0, 0], mesh.faces.shape), atol=1e-6)
    np.testing.assert_allclose(mesh.bounds, [[0, -8, -12], [0, 8, 12]], atol=1e-6)
    # The empty corner is at the top (+z) on the right (+y): the centroid lies to the left and below.
    y, z = mesh.area_faces @ mesh.triangles_center[:, 1:] / mesh.area
    assert (y, z) == pytest.approx((-180 * 3 / 204, -180 * 3 / 204), rel=1e-6)


def test_sphere_image_has_the_f_on_longitude_0_stem_west():
    picture = make_scenes.sphere_picture()
    assert picture.shape == (256, 512)
    centred = np.roll(picture, 256, axis=1)  # longitude 0 in the middle
    rows, columns = np.nonzero(centred == 40)
    letter = (centred == 40)[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    coarse = letter[8::17, 8::17].astype(int)  # one look into each box of 12°
    np.testing.assert_array_equal(coarse, [[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0]])
    assert centred[128, 128] == 20  # longitude -90
    assert np.all(picture[:20] == 10)  # north
    assert np.all(picture[-20:] == 2)


# --- the exitance of the cylinder ---


def surface_rule(phantom):
    """Gauss rule on the true cylinder: points, outward normals (N, 3), weights (N,) [mm²]."""
    angle = (np.arange(96) + 0.5) * 2 * np.pi / 96
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(96)])
    x, weight = np.polynomial.legendre.leggauss(32)
    half, full = phantom.height / 2, 2 * np.pi / 96
    side = phantom.radius * ring[:, None] + half * x[:, None] * np.array([0, 0, 1])
    side_weight = np.broadcast_to(full * phantom.radius * half * weight, (96, 32))
    r, r_weight = (x + 1) / 2 * phantom.radius, weight / 2 * phantom.radius
    top = r[:, None] * ring[:, None] + np.array([0, 0, half])
    cap_weight = np.broadcast_to(full * r_weight * r, (96, 32))
    axis = np.broadcast_to([0.0, 0, 1], top.shape)
    normals = np.broadcast_to(ring[:, None], side.shape), axis, -axis
    parts = [side, top, top * (1, 1, -1)]
    weights = np.concatenate([w.ravel() for w in (side_weight, cap_weight, cap_weight)])
    return (
        np.vstack([p.reshape(-1, 3) for p in parts]),
        np.vstack([n.reshape(-1, 3) for n in normals]),
        weights,
    )


def reciprocity(phantom, points, normals, weights, values, source=None):
    """∫ J_n (ψ + ∂ψ/∂n / h) dS over ψ at the source, for waves ψ = exp(k s·r) in several directions s; all 1.

    Green's second identity: ∇²ψ = k²ψ inside and ∂φ/∂n = -h φ leave no other J_n of a source of 1 W. `source`
    (N, 3): points the light comes from in equal parts; the phantom's own sphere where left out.
    """
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
    wave = np.exp(phantom.decay * points @ directions.T)
    integrand = wave * (1 + phantom.decay * (normals @ directions.T) / phantom.slope)
    if source is None:
        light = np.exp(phantom.decay * directions @ [phantom.source_x, 0, phantom.source_z]) * phantom.ball
    else:
        light = np.exp(phantom.decay * source @ directions.T).mean(axis=0)
    return (weights * values) @ integrand / light


@pytest.mark.parametrize(
    "phantom",
    [
        Phantom(),
        Phantom(index=1.53, source_z=3, source_x=5),
        Phantom(mua=0.1, musp=1.5, height=20, source_x=0),
    ],
)
def test_exitance_obeys_green_s_identity(phantom):
    """Rationale: the identity holds for every wave and needs no modes or Bessel functions.

    Expected: 1 to the accuracy of the series. Seen to fail with the h of the side's denominator dropped, the
    wall's part of the caps dropped, source_z of the wrong sign on one cap, and `ball` = 1.
    """
    points, normals, weights = surface_rule(phantom)
    values = exitance(phantom, points)
    np.testing.assert_allclose(reciprocity(phantom, points, normals, weights, values), 1, rtol=1e-9)


def test_cylinder_file_obeys_green_s_identity(cylinder):
    """As above, of the file: a cylinder of light, 1 mm long and of 1 mm radius. Finite elements leave some 1e-3."""
    vertices, faces, values = cylinder
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    weights, values = mesh.area_faces, values[faces].mean(1)
    rho, turn, z = np.meshgrid(np.sqrt((np.arange(20) + 0.5) / 20), np.arange(24) * np.pi / 12, np.arange(20) / 20)
    source = np.stack([8 + rho * np.cos(turn), rho * np.sin(turn), z + 0.025 - 1.5], axis=-1).reshape(-1, 3)
    ratio = reciprocity(Phantom(), mesh.triangles_center, mesh.face_normals, weights, values, source)
    np.testing.assert_allclose(ratio, 1, rtol=2e-3)


def test_exitance_agrees_with_monte_carlo_of_photon_transport():
    """Exit fractions of 5e6 photons, g = 0, isotropic point at mid-height; diffusion meets them within 0.3 %.

    Its peak is a mean over 0.5 mm²; this near to the source diffusion is 5 % low.
    """
    for index, fraction, peak in ((1.37, 0.3133, 1.20e-3), (1.53, 0.2892, 1.05e-3)):
        phantom = Phantom(index=index, source_z=0, source_diameter=0)
        points, _, weights = surface_rule(phantom)
        assert weights @ exitance(phantom, points) == pytest.approx(fraction, rel=3e-3)
        assert exitance(phantom, np.array([[15.0, 0, 0]])) == pytest.approx(peak, rel=0.06)


def test_exitance_peaks_beside_the_source(cylinder):
    vertices, _, values = cylinder
    np.testing.assert_allclose(vertices[values.argmax()], [15, 0, -1], atol=0.2)


@pytest.mark.parametrize("sign", [1, -1])
def test_exitance_of_side_and_caps_agree_on_the_rim(sign):
    """Two different series, here 30 nm apart."""
    angle = np.linspace(0, 2 * np.pi, 25)
    rim = 15 * np.column_stack([np.cos(angle), np.sin(angle), np.full(25, sign)])
    inside = rim * [1 - 2e-6, 1 - 2e-6, 1]
    np.testing.assert_allclose(exitance(Phantom(), inside), exitance(Phantom(), rim), rtol=1e-4)


# --- the XML ---


@pytest.mark.parametrize("name", NAMES)
def test_scene_file_names_its_parameters_and_its_data(name):
    path = SCENES / f"{name}.xml"
    text, root = path.read_text(encoding="utf-8"), ET.parse(path).getroot()
    comment = re.match(r"<\?xml [^>]*\?>\n<!--\n(.*?)-->", text, re.S).group(1)
    assert f"fspt render scenes/{name}.xml" in comment
    assert "W/mm^2" in comment
    defaults = {element.get("name"): element.get("value") for element in root.iter("default")}
    shared = {"f_number", "view", "rtol", "focal_length", "magnification", "distance"}
    assert shared | {"width", "height", "pixel_pitch"} <= set(defaults)
    used = set(re.findall(r"\$(\w+)", text[text.index("<scene") :]))
    assert used == set(defaults)
    assert root.find("boolean[@name='embree_use_robust_intersections']").get("value") == "true"
    for filename in root.iterfind(".//string[@name='filename']"):
        assert (SCENES / filename.get("value")).is_file()


@pytest.mark.parametrize("name", NAMES)
def test_scene_has_the_paper_s_lens_and_watts_in_float32(name):
    root = ET.parse(SCENES / f"{name}.xml").getroot()
    defaults = {element.get("name"): element.get("value") for element in root.iter("default")}
    assert float(defaults["focal_length"]) == 55
    assert float(defaults["f_number"]) == 8
    assert float(defaults["magnification"]) == 0.5
    assert float(defaults["pixel_pitch"]) * int(defaults["width"]) == pytest.approx(2048 * 0.0135)
    sensor = root.find("sensor")
    assert sensor.get("type") == "fspt_lens"
    film = {element.get("name"): element.get("value") for element in sensor.find("film")}
    assert film["component_format"] == "float32"
    assert film["pixel_format"] == "luminance"
    assert sensor.find("film/rfilter").get("type") == "box"
    assert root.find("integrator").get("type") == "fspt_integral"
    for shape in root.iter("shape"):
        emitter = shape.find("emitter[@type='fspt_surface']")
        assert emitter.find("*[@name='exitance']") is not None
        assert shape.findall("transform/rotate")[-1].attrib == {"z": "1", "angle": "$view"}


# Not mirror_rig, whose two mirrors plain Mitsuba merges into one mesh.
@pytest.mark.parametrize("path", sorted(SCENES.glob("[!m]*.xml")), ids=lambda path: path.stem)
def test_keys_of_a_scene_are_the_same_in_every_run_and_with_plain_mitsuba(path):
    """Objects without an id are called by their address in memory, object_94762123089456."""
    plain = list(mi.traverse(mi.load_file(str(path))).keys())
    assert plain == list(mi.traverse(fspt.load(path)).keys())
    assert "camera.f_number" in plain
    assert not [key for key in plain if re.search(r"\d{5}", key)]


def test_all_scenes_are_listed_here():
    assert sorted(path.stem for path in SCENES.glob("*.xml")) == sorted([*NAMES, "nylon_cylinder_tissue", "mirror_rig"])


@pytest.mark.parametrize(("distance", "tilt"), [(165, 0), (100, 0), (370, 0), (165, 55), (165, -55)])
def test_uniform_disk_fills_the_image_from_the_whole_pupil(distance, tilt):
    """Lines from the edge of the f/2.8 pupil through the image's corners meet the front of the disk."""
    u, half = 165.0, 256 * 0.108  # mm; half of the virtual detector = 128 pixels of 0.108 mm / 0.5
    corner = half * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    turn = np.linspace(0, 2 * np.pi, 73)
    pupil = 55 / 2.8 / 2 * np.column_stack([np.cos(turn), np.sin(turn)])
    # Camera frame as in the scene: the lens at x = distance, looking to -x; y and z across.
    start = np.insert(pupil, 0, distance, axis=1)[:, None]
    ray = np.insert(corner, 0, distance - u, axis=1) - start
    normal = np.array([np.cos(np.radians(tilt)), np.sin(np.radians(tilt)), 0])
    assert np.all(ray @ normal < 0)
    hit = start - ray * ((start @ normal) / (ray @ normal))[..., None]
    assert np.linalg.norm(hit, axis=-1).max() < 100  # mm, its radius
