"""Meshes that glow on the wrong side are reported by every route, once for each state of the mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from small_scenes import SCENES, glow, lens, mi, world_scene, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.integral.lines import mesh_faults

TURNED = 27  # of 80 faces: a third of the power is missing
MIXED = "edges the two faces point to opposite sides; 35 % of its area points inward"
INSIDE_OUT = "is a closed surface that is inside out"
FILM = {"size": 8, "pitch": 1.8}
COARSE = '<integrator type="fspt_integral"><float name="rtol" value="0.5"/></integrator>'


def sphere(path, turned=0, inverted=False, radius=5.0):
    """File of an icosphere about the origin, some of whose faces are turned over, or all."""
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    faces = np.array(mesh.faces)
    some = np.random.default_rng(1).permutation(len(faces))[: len(faces) if inverted else turned]
    faces[some] = faces[some, ::-1]
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(path)
    return {"type": "ply", "filename": str(path), "emitter": glow(), "face_normals": True}


def told(shape, **settings):
    """The warnings about an image of one shape, "" without any."""
    scene = world_scene(shape, sensor=lens(**FILM))
    return fspt.render(scene, **(settings or {"rtol": 0.5})).metadata.get("warnings", "")


@pytest.fixture
def mixed_xml(tmp_path):
    """A scene file with a mesh whose faces turn both ways."""
    sphere(tmp_path / "mixed.ply", TURNED)
    shape = '<shape type="ply" id="phantom"><string name="filename" value="mixed.ply"/>'
    emitter = '<emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter></shape>'
    return write_scene(tmp_path / "s.xml", shapes=shape + emitter, integrator=COARSE)


@pytest.mark.parametrize("settings", [{}, {"method": "path", "spp": 4}])
def test_faces_of_both_orientations_are_reported(tmp_path, settings):
    """A third of the faces points inward, and as much of the power is missing."""
    assert MIXED in told(sphere(tmp_path / "mixed.ply", TURNED), **settings)
    assert told(sphere(tmp_path / "right.ply"), **settings) == ""


@pytest.mark.parametrize(
    ("shape", "inside_out"),
    [
        ({}, False),
        ({"flip_normals": True}, True),
        ({"to_world": mi.ScalarTransform4f().scale([-1, 1, 1])}, True),  # a mirror image turns the faces over
        ({"inverted": True}, True),
        ({"inverted": True, "flip_normals": True}, False),
    ],
)
def test_a_closed_surface_inside_out_is_reported(tmp_path, shape, inside_out):
    ball = sphere(tmp_path / "ball.ply", inverted=shape.pop("inverted", False))
    scene = world_scene(ball | shape, sensor=lens(**FILM))
    found = mesh_faults.mesh_faults(scene, scene.sensors()[0].camera)
    assert [INSIDE_OUT in text for text in found] == [True] * inside_out


def test_the_walls_of_a_cavity_around_the_lens_are_right(tmp_path):
    """An integrating sphere glows inward, to the lens within."""
    scene = world_scene(sphere(tmp_path / "wall.ply", inverted=True, radius=280.0), sensor=lens(**FILM))
    assert mesh_faults.mesh_faults(scene, scene.sensors()[0].camera) == []


def test_a_mesh_in_metres_is_reported(tmp_path):
    assert "If its mesh is in m, scale it by 1000" in told(sphere(tmp_path / "ball.ply", radius=0.01))
    assert mesh_faults.size_fault(1e5) == (
        "what glows is 1e+05 mm from corner to corner, unusual for a phantom: one unit of length is 1 mm"
    )


def test_a_mesh_is_examined_once(tmp_path, monkeypatch):
    """Images through another lens, and with another J_n, do not repeat the work."""
    calls = []
    once = mesh_faults.closure
    monkeypatch.setattr(mesh_faults, "closure", lambda *mesh: calls.append(mesh) or once(*mesh))
    scene = world_scene(sphere(tmp_path / "ball.ply"), sensor=lens(**FILM))
    parameters = mi.traverse(scene)
    for f_number in (8.0, 4.0):
        parameters["camera.f_number"] = f_number
        parameters["shape_0.emitter.exitance.value"] = 1e-3 / f_number
        parameters.update()
        fspt.render(scene, rtol=0.5)
    assert len(calls) == 1


@pytest.mark.parametrize(
    "verb",
    [
        ("render", "-o", "{out}/o.exr"),
        ("matrix", "-o", "{out}/t.npz"),
        ("sweep", "-D", "f_number=8,4", "-o", "{out}/sweep"),
        ("explain",),
    ],
)
def test_every_verb_reports_it_in_one_line(run, tmp_path, mixed_xml, verb):
    name, *options = verb
    code, _, warned = run(name, mixed_xml, *(text.format(out=tmp_path) for text in options))
    assert code == 0
    assert MIXED in warned
    assert warned.count("\n") == 1


def test_plain_mitsuba_logs_it_once(mixed_xml, capfd):
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Warn)
    try:
        scene = mi.load_file(str(mixed_xml))
        for _ in range(2):
            mi.render(scene)
    finally:
        mi.set_log_level(level)
    assert "".join(capfd.readouterr()).count(MIXED) == 1


def test_the_scenes_of_the_package_have_no_fault():
    for name in ("nylon_cylinder", "l_shape"):
        scene = fspt.load(SCENES / f"{name}.xml")
        assert mesh_faults.mesh_faults(scene, scene.sensors()[0].camera) == []
