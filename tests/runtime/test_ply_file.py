"""PLY files that end early or name vertices that do not exist are refused wherever they are read."""

from __future__ import annotations

import re
import struct

import pytest
from small_scenes import write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import FluxError, SceneError

CORNERS = [(3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -3, 0), (0, 0, 3), (0, 0, -3)]
FACES = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
SHAPE = """
    <shape type="ply"><string name="filename" value="m.ply"/>
        <emitter type="fspt_surface"><texture type="mesh_attribute" name="exitance">
            <string name="name" value="vertex_exitance"/></texture></emitter></shape>"""


def header(form="ascii", vertices=6):
    return (
        f"ply\nformat {form} 1.0\ncomment octahedron\nelement vertex {vertices}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "exitance_x"))
        + "element face 8\nproperty list uchar int vertex_indices\nend_header\n"
    )


def text_ply(faces=FACES):
    lines = [f"{x} {y} {z} 1e-3" for x, y, z in CORNERS] + [f"3 {a} {b} {c}" for a, b, c in faces]
    return (header() + "\n".join(lines) + "\n").encode()


def binary_ply(faces=FACES, order="<"):
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    vertices = b"".join(struct.pack(f"{order}4f", *corner, 1e-3) for corner in CORNERS)
    return header(form).encode() + vertices + b"".join(struct.pack(f"{order}B3i", 3, *face) for face in faces)


WRONG = [*FACES[:-1], (0, 3, 6)]
DAMAGED = {
    "a line short": (
        text_ply()[: text_ply().rindex(b"3 0 3 5")],
        "ends early: its header tells of 8 face lines, there are 7",
    ),
    "vertices short": (text_ply()[: text_ply().index(b"0 3 0 1e-3")], "tells of 6 vertex lines, there are 2"),
    "a vertex that is not there": (text_ply(WRONG), "face 7 has the vertices 0, 3, 6, there are 6"),
    "a vertex before the first": (text_ply([(0, 2, -1), *FACES[1:]]), "face 0 has the vertices 0, 2, -1"),
    "binary, a byte short": (binary_ply()[:-1], r"ends early: its header tells of 6 vertices and 8 faces, which take"),
    "binary, a vertex that is not there": (binary_ply(WRONG), "face 7 has the vertices 0, 3, 6, there are 6"),
    "big endian likewise": (binary_ply(WRONG, ">"), "face 7 has the vertices 0, 3, 6, there are 6"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_ply_is_refused_everywhere(tmp_path, monkeypatch, name):
    """Seen to be drawn in part (a line short), or to crash Mitsuba (a vertex that is not there)."""
    content, message = DAMAGED[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.ply").write_bytes(content)
    for read in (fspt.import_flux, fspt.scene_xml, fspt.Phantom.read):
        with pytest.raises(FluxError, match=re.escape(message)):
            read("m.ply")
    with pytest.raises(SceneError) as refused:
        fspt.load(write_scene(tmp_path / "s.xml", shapes=SHAPE))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "content", [text_ply(), text_ply().replace(b"\n", b"\r\n"), binary_ply(), binary_ply(order=">")]
)
def test_a_whole_ply_is_read(tmp_path, content):
    (tmp_path / "m.ply").write_bytes(content)
    assert len(fspt.Phantom.read(tmp_path / "m.ply").faces) == 8
    fspt.load(write_scene(tmp_path / "s.xml", shapes=SHAPE))


def test_a_text_without_its_last_line_break_is_read_with_a_warning(tmp_path, caplog):
    """Programs that join lines leave it out; of a file that was cut there, the last number may lack digits."""
    (tmp_path / "m.ply").write_bytes(text_ply()[:-1])
    assert len(fspt.Phantom.read(tmp_path / "m.ply").faces) == 8
    assert "m.ply' ends without a line break: its last number may be cut off" in caplog.text


def test_a_vertex_far_away_is_framed_or_refused(tmp_path):
    """Seen to divide by zero: its distance from the axis was lost in that of the lens."""
    far = text_ply().replace(b"3 0 0 1e-3", b"3e30 0 0 1e-3")
    (tmp_path / "m.ply").write_bytes(far)
    with pytest.raises(fspt.FsptError, match="no magnification from 1e-06 to 1e\\+06 fills the film"):
        fspt.scene_xml(tmp_path / "m.ply")
