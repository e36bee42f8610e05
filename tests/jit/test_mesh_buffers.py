"""The names and shapes of mesh buffers in Mitsuba 3.9, which is installed, and in 3.10, which the tests imitate."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mitsuba_fspt  # before Mitsuba: it selects the LLVM

ROOT = Path(__file__).resolve().parents[2]
POSITIONS = np.float32([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 2, 0]])
FACES = np.uint32([[0, 1, 2], [1, 3, 2]])


class NewMesh:
    """A mesh of Mitsuba 3.10: made from tensors, six vertices of which two share their positions with others."""

    def __init__(self, name, faces=None, positions=None, props=None):
        self.values = {"positions": positions, "faces": faces + 2}  # vertices are not positions
        self.triangles, self.attributes = faces, {}

    def geometric_faces(self):
        return self.triangles

    def add_attribute(self, name, values):
        self.attributes[name] = values


@pytest.fixture
def new(mono, monkeypatch):
    """`mesh_buffers` as it sees Mitsuba 3.10."""
    from mitsuba_fspt.jit import mesh_buffers

    names = ("Float", "UInt32", "TensorXf", "TensorXu", "Properties", "Shape", "Mesh")
    imitated = SimpleNamespace(**{name: getattr(mono, name) for name in names})
    imitated.Mesh, imitated.traverse = NewMesh, lambda mesh: mesh.values
    monkeypatch.setattr(mesh_buffers, "mi", imitated)
    return mesh_buffers


def test_a_mesh_of_3_9_has_the_triangles_that_it_was_given(mono):
    from mitsuba_fspt.jit import mesh_buffers

    mesh = mesh_buffers.new_mesh("m", POSITIONS.ravel(), FACES.ravel())
    mesh_buffers.add_attribute(mesh, "face_exitance", np.float32([1, 2]))
    for read in (mesh_buffers.buffers, mesh_buffers.triangles):
        positions, faces = read(mesh)
        np.testing.assert_array_equal(positions, POSITIONS.ravel())
        np.testing.assert_array_equal(faces, FACES.ravel())
    assert list(mesh_buffers.motions_of(mono.traverse(mesh))) == ["vertex_positions", "vertex_normals"]
    np.testing.assert_array_equal(mono.traverse(mesh)["face_exitance"], [1, 2])


def test_a_mesh_of_3_10_is_made_from_tensors_and_read_by_its_geometric_faces(new, mono):
    """Seen to fail with `faces` in place of `geometric_faces()`."""
    mesh = new.new_mesh("m", POSITIONS.ravel(), FACES.ravel())
    assert mesh.values["positions"].shape == (4, 3)
    assert mesh.triangles.shape == (2, 3)
    new.add_attribute(mesh, "vertex_exitance", np.float32([1, 2, 3, 4]))
    assert mesh.attributes["vertex_exitance"].shape == (4, 1)
    for read in (new.buffers, new.triangles):
        positions, faces = read(mesh)
        np.testing.assert_array_equal(positions, POSITIONS.ravel())
        np.testing.assert_array_equal(faces, FACES.ravel())
    parameters = {"body.positions": mesh.values["positions"], "body.normals": mono.TensorXf(POSITIONS)}
    assert new.motions_of(parameters, "body.") == {"body.positions": 1.0, "body.normals": 0.0}
    moved = new.shaped_like(parameters["body.positions"], POSITIONS.ravel() + 1)
    assert moved.shape == (4, 3)
    np.testing.assert_array_equal(moved, POSITIONS + 1)


def test_only_one_file_uses_these_names():
    """Of the package, and no script; `vertex_exitance` is a name of this package."""
    names = r"vertex_positions|vertex_normals|positions_buffer|faces_buffer|\bmi\.Mesh\(|\.add_attribute\("
    files = [*Path(mitsuba_fspt.__file__).parent.rglob("*.py"), *(ROOT / "scripts").glob("*.py")]
    using = {path.name for path in files if re.search(names, path.read_text(encoding="utf-8"))}
    assert using == {"mesh_buffers.py"}
