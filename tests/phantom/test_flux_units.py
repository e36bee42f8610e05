"""Importing J_n: what a value means, in which unit, and what is refused."""

import json
import os
import re

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from mitsuba_fspt.cli import run as cli
from mitsuba_fspt.cli.flux import app
from mitsuba_fspt.phantom.flux_import import import_flux
from mitsuba_fspt.phantom.formats.ply import write_ply
from mitsuba_fspt.runtime.errors import BackendError, ExitanceError, FluxError

BOX = trimesh.creation.box((2.0, 3.0, 4.0))
VERTICES, FACES = np.array(BOX.vertices), np.array(BOX.faces)
MESH = (VERTICES, FACES)


@pytest.mark.parametrize(
    ("a", "n", "expected"),
    [
        ("haskell", 1.37, 2.7586),
        ("haskell", 1.53, 3.846),
        ("robin", 1.37, 2.5701),
        ("robin", 1.53, 3.5706),
        ("robin", None, 2.5701),
        (2.7, None, 2.7),
        ("2.7", None, 2.7),
    ],
)
def test_uniform_fluence_leaves_area_phi_over_2a(a, n, expected):
    """Power = area · phi/(2A), A as published (Haskell 1994; NIRFAST). Fails without the 2, or with A = 1."""
    phantom = import_flux(MESH, np.full(8, 0.4), a=a, n=n)
    assert phantom.power == pytest.approx(52 * 0.4 / (2 * expected), rel=2e-4)
    assert phantom.provenance["boundary_factor"].startswith(f"{expected:.4g}"[:4])


@pytest.mark.parametrize(("unit", "millimetres"), [("cm", 10.0), ("m", 1000.0)])
def test_length_unit_goes_for_the_mesh_and_its_values(unit, millimetres):
    """The same body in cm or m has the same power: W per (length unit)². Fails where only lengths scale."""
    exitance = np.linspace(0.1, 0.8, 8)
    expected = import_flux(MESH, exitance)
    phantom = import_flux((VERTICES / millimetres, FACES), exitance * millimetres**2, length_unit=unit)
    assert phantom.power == pytest.approx(expected.power, rel=1e-12)
    assert phantom.area == pytest.approx(52)
    np.testing.assert_allclose(phantom.exitance, exitance)


@pytest.mark.parametrize(
    ("size", "unit", "suggested"),
    [
        (80, "mm", None),
        (5, "mm", None),
        (900, "mm", None),
        (8, "cm", None),
        (0.08, "mm", "m"),  # a mouse in metres
        (2.4, "mm", "cm"),
        (300, "m", "mm"),
        (250, "cm", "mm"),
        (1e6, "mm", ""),
    ],
)
def test_a_size_that_suggests_another_unit_draws_a_warning(size, unit, suggested):
    """`size` from corner to corner in the file's unit; '' for one that no unit makes usual."""
    scaled = VERTICES / np.linalg.norm(np.ptp(VERTICES, axis=0)) * size
    report = import_flux((scaled, FACES), np.ones(8), length_unit=unit).report()
    if suggested is None:
        assert "warning" not in report
    elif suggested:
        assert report["warning"].endswith(f"If that is right give --length-unit {suggested}.")
    else:
        assert report["warning"].endswith("Check --length-unit, or scale the mesh.")


def test_cli_prints_the_box_and_warns_of_the_unit(tmp_path, capfd):
    box = BOX.copy()
    box.apply_scale(1e-2)
    box.export(tmp_path / "box.off")
    np.save(tmp_path / "jn.npy", np.ones(8))
    arguments = ["flux", "import", tmp_path / "box.off", "--values", tmp_path / "jn.npy", "-o", tmp_path / "b.ply"]
    assert cli(list(map(str, arguments))) == 0
    out, err = capfd.readouterr()
    low, high = BOX.bounds
    numbers = [" ".join(f"{x / 100:.6g}" for x in corner) for corner in (low, high)]
    assert f"bounding box    {numbers[0]} to {numbers[1]} mm\n" in out
    assert err.count("\n") == 1
    assert err.startswith(f"fspt: {tmp_path / 'b.ply'}: the mesh is ")
    assert err.endswith("give --length-unit m.\n")
    assert cli(list(map(str, [*arguments, "--length-unit", "m", "--json"]))) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert np.allclose(json.loads(out)["bounding_box"], 10 * BOX.bounds)


def test_power_per_vertex_is_the_integral_of_linear_exitance():
    """Σ A · mean of the corners; for a linear J_n that is the face's J_n at its centroid, exactly."""
    law = lambda points: 1 + points @ np.array([0.1, 0.05, 0.02])  # noqa: E731
    on_vertices = import_flux(MESH, law(VERTICES))
    on_faces = import_flux(MESH, law(VERTICES[FACES].mean(axis=1)))
    assert (on_vertices.per, on_faces.per) == ("vertex", "face")
    assert on_vertices.power == pytest.approx(on_faces.power, rel=1e-12)
    assert on_vertices.power == pytest.approx(52.0)  # the box is centred: the slopes cancel
    uneven = import_flux(MESH, np.where(VERTICES[:, 2] > 0, 3.0, 0.0))
    assert uneven.power == pytest.approx(3 * 6 + (52 - 12) * 1.5)  # top 2 × 3 at 3 W/mm², sides at 1.5 on average


def test_negative_values_need_clip_and_clip_reports_their_power():
    values = np.full(12, 0.5)
    values[np.flatnonzero(np.isclose(BOX.area_faces, 3.0))[0]] = -0.01  # half of a 2 × 3 side
    with pytest.raises(ExitanceError, match=r"1 of 12 values are negative, down to -0.01 .*-0.03 W .*--clip"):
        import_flux(MESH, values)
    report = import_flux(MESH, values, clip=True).report()
    assert (report["negatives"], report["zeros"], report["min"]) == (1, 1, 0.0)
    assert report["removed_power"] == pytest.approx(0.03)
    assert report["power"] == pytest.approx(0.5 * 49)
    assert report["removed_percent"] == pytest.approx(100 * 0.03 / 24.5)


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_and_inf_are_refused_always(bad, clip):
    values = np.ones(8)
    values[5] = bad
    with pytest.raises(ExitanceError, match=r"1 of 8 values are NaN or inf, the first on vertex 5"):
        import_flux(MESH, values, clip=clip)


CHECK = "Check the field's name if it should glow."


@pytest.mark.parametrize("values", [np.zeros(8), np.full(8, -1.0)])
def test_a_dark_phantom_is_taken_with_a_warning(values):
    """A control without light; of values that are all clipped nothing remains to compare with."""
    phantom = import_flux(MESH, values, clip=True)
    assert not phantom.exitance.any()
    assert phantom.provenance["warning"].endswith("exitance is 0 everywhere, the phantom is dark. " + CHECK)
    assert phantom.report()["removed_percent"] == (None if values.any() else 0)


def test_inside_out_is_refused_until_flipped():
    with pytest.raises(FluxError, match=r"inside out.*Give --flip"):
        import_flux((VERTICES, FACES[:, ::-1]), np.ones(8))
    with pytest.raises(FluxError, match=r"Leave out --flip"):
        import_flux(MESH, np.ones(8), flip=True)
    phantom = import_flux((VERTICES, FACES[:, ::-1]), np.arange(8.0), flip=True)
    assert np.array_equal(phantom.faces, FACES)
    assert np.array_equal(phantom.exitance, np.arange(8.0))


def test_faces_that_contradict_each_other_are_refused():
    twisted = FACES.copy()
    twisted[3] = twisted[3, ::-1]
    with pytest.raises(FluxError, match=r"on 3 edges .* opposite sides"):
        import_flux((VERTICES, twisted), np.ones(8))


def test_an_open_surface_is_accepted_with_a_warning():
    report = import_flux((VERTICES, FACES[2:]), np.ones(10)).report()
    assert (report["watertight"], report["outward"]) == (False, None)


def test_vertices_that_no_face_uses_do_not_count():
    values = np.append(np.ones(8), np.nan)
    phantom = import_flux((np.vstack([VERTICES, [[9, 9, 9]]]), FACES), values)
    assert len(phantom.vertices) == 8


@pytest.mark.parametrize(
    ("values", "options", "largest"),
    [
        (np.full(8, 1e308), {}, r"1e\+308"),
        (np.linspace(-1e308, 1, 8), {"clip": True}, r"1e\+308"),
        (np.full(8, 1e-40), {}, "1e-40"),
        (np.ones(8), {"a": 1e-320}, "inf"),
        (np.full(8, 1e-40), {"length_unit": "m"}, "1e-46"),
    ],
)
def test_values_beyond_single_precision_are_refused(values, options, largest):
    """Rationale: J_n = 1e308 was written, and its power told as inf; Mitsuba counts in 32 bits."""
    with pytest.raises(ExitanceError, match=rf"largest value is {largest} W/mm\^2, the renderer holds 1.2e-38 to 3.4e"):
        import_flux(MESH, values, **options)
    assert import_flux(MESH, np.full(8, 1e38)).power == pytest.approx(52e38)


def test_vertices_beyond_single_precision_are_refused():
    with pytest.raises(FluxError, match=r"a vertex lies at 2e\+39 mm, the renderer holds 3.4"):
        import_flux((VERTICES * 1e39, FACES), np.ones(8))


TETRAHEDRON = (np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


@pytest.mark.parametrize(
    ("mesh", "values", "options", "message"),
    [
        (MESH, np.ones(9), {}, r"9 values fit nothing, arrays with values has 8 vertices, 12 faces"),
        (MESH, np.ones(12), {"per": "vertex"}, r"asked for per vertex"),
        (TETRAHEDRON, np.ones(4), {}, r"4 values fit vertices and faces\. Give --per"),
        (MESH, np.ones((8, 2)), {}, r"which of its 2 columns\?.*'1', '2'"),
        (MESH, np.ones((8, 2, 2)), {}, r"shape \(N,\) or \(N, columns\)"),
        (MESH, np.ones(8) * 1j, {}, r"real numbers"),
        (MESH, None, {}, r"needs 'values'"),
        (MESH, np.ones(8), {"length_unit": "inch"}, r"'length_unit' must be one of mm, cm, m, got 'inch'"),
        (MESH, np.ones(8), {"per": "edge"}, r"'per' must be vertex or face, got 'edge'"),
        (MESH, np.ones(8), {"format": "mose"}, r"'format' must be one of auto, mmc, .*got 'mose'"),
        (MESH, np.ones(8), {"format": "obj"}, r"reads files"),
        (MESH, np.ones(8), {"a": "exact"}, r"'a' must be robin, haskell or a number > 0, got 'exact'"),
        (MESH, np.ones(8), {"a": "robin", "n": 0.9}, r"n must be >= 1"),
        (MESH, np.ones(8), {"a": "robin", "n": 1e9}, r"n must be >= 1 and at most 100, got 1e\+09"),
        (MESH, np.ones(8), {"n": 1.4}, r"'n' = 1.4 goes with 'a'"),
        (MESH, np.ones(8), {"a": 2.5, "n": 1.4}, r"'n' = 1.4 goes with 'a'"),
        ((VERTICES, FACES + 1), np.ones(8), {}, r"vertices 1 to 8 \(counted from 0\), there are 8"),
        ((VERTICES, FACES * 1.0), np.ones(8), {}, r"cells must be integers"),
        ((VERTICES[:, :2], FACES), np.ones(8), {}, r"shape \(V, 3\)"),
        ((VERTICES, FACES[:, :2]), np.ones(8), {}, r"triangles \(F, 3\) or tetrahedra"),
        ((VERTICES * np.nan, FACES), np.ones(8), {}, r"some are NaN"),
        ((VERTICES * [0, 0, 1], FACES), np.ones(8), {}, r"no area"),
        (
            (VERTICES, np.array([[0, 1, 2, 4]] * 3)),
            np.ones(8),
            {},
            r"share the face",
        ),
    ],
)
def test_bad_arrays(mesh, values, options, message):
    with pytest.raises(FluxError, match=message):
        import_flux(mesh, values, **options)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("v.csv", "a,b\n1,2\n3,4\n", r"which of its 2 columns.*'a', 'b'"),
        ("v.csv", "1,2\n3,x\n", r"not a table of numbers.*'x'"),
        ("v.csv", "1,2\n3,x\n", r"not a table of numbers.*\. Fix that line\."),
        ("v.csv", "1\n\n", r"1 values fit nothing"),
        ("v.csv", "# nothing\n", r"holds no values"),
        ("v.csv", "", r"holds no values"),
        ("v.txt", b"\x00\x01\xff\xfe" * 9, r"is binary"),
        ("v.npy", b"no numpy", r"cannot be read as a NumPy file: .*\. Save it anew"),
        ("v.npz", b"PK\x03\x04 broken", r"cannot be read as a NumPy file: .*\. Save it anew"),
        ("v.mat", b"broken", r"cannot be read as a MATLAB file: .*\. Save it anew"),
        ("missing.csv", None, r"missing.csv' cannot be read: No such file"),
    ],
)
def test_bad_value_files(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FluxError, match=message) as caught:
        import_flux(MESH, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ("phi;J_n\n0;1\n" + "0;2\n" * 7, "J_n"),
        ("# made by hand\n# phi J_n\n0 1\n" + "0 2\n" * 7, "J_n"),
        ("1,1\n" + "2,2\n" * 7, "2"),
        ("phi;J_n;\r\n0,5;1,0;\r\n" + "0,5;2,0;\r\n" * 7, "J_n"),
        ("0,25;1\n" + "0,25;2\n" * 7, "2"),
        ("\ufeffJ_n\n\n1\n" + "2\n" * 7, None),
    ],
)
def test_columns_by_name_or_number(tmp_path, content, field):
    (tmp_path / "v.csv").write_text(content, encoding="utf-8")
    assert import_flux(MESH, tmp_path / "v.csv", field=field).exitance.tolist() == [1.0] + [2.0] * 7


@pytest.mark.parametrize("field", ["jn", "2"])
def test_a_table_of_one_row(tmp_path, field):
    """Rationale: the row was taken for a column of two values, and then asked for its second column."""
    path = tmp_path / "v.csv"
    path.write_text("id,jn\n7,0.5\n")
    one = (VERTICES[FACES[0]], np.array([[0, 1, 2]]))
    assert import_flux(one, path, field=field, per="face").exitance.tolist() == [0.5]
    with pytest.raises(FluxError, match=r"which of its 2 columns.*'id', 'jn'"):
        import_flux(one, path, per="face")


def test_columns_of_one_name(tmp_path):
    path = tmp_path / "v.csv"
    path.write_text("jn,jn\n" + "1,2\n" * 8)
    with pytest.raises(FluxError, match=r"2 columns are named 'jn'\. Choose one by its number"):
        import_flux(MESH, path, field="jn")
    assert import_flux(MESH, path, field="2").exitance.tolist() == [2.0] * 8


@pytest.mark.skipif(not os.path.isdir("/dev/fd"), reason="no names for open files")
def test_values_from_a_pipe():
    """Rationale: the second look into it found nothing."""
    source, sink = os.pipe()
    os.write(sink, b"jn\n" + b"1\n" * 7 + b"2\n")
    os.close(sink)
    assert import_flux(MESH, f"/dev/fd/{source}").exitance.tolist() == [1.0] * 7 + [2.0]
    os.close(source)


@pytest.mark.parametrize("inside", [False, True], ids=["variable", "member"])
def test_a_sparse_vector_of_matlab(tmp_path, inside):
    scipy = pytest.importorskip("scipy")
    values = scipy.sparse.csc_matrix(np.arange(8.0)[:, None])
    scipy.io.savemat(tmp_path / "v.mat", {"data": {"phi": values}} if inside else {"phi": values})
    assert import_flux(MESH, tmp_path / "v.mat").exitance.tolist() == list(range(8))


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "off", "glb", "vtu", "vtk", "msh", "xdmf", "npz", "step"])
@pytest.mark.parametrize("content", [b"", b"neither fish nor fowl\n" * 20, b"ply\nelement vertex 3\n"])
def test_broken_mesh_files_give_one_line(tmp_path, suffix, content, capfd):
    path = tmp_path / f"broken.{suffix}"
    path.write_bytes(content)
    with pytest.raises((FluxError, BackendError), match="broken") as caught:
        import_flux(path, np.ones(8))
    assert "\n" not in str(caught.value)
    assert "".join(capfd.readouterr()) == ""


STATED = [
    ("W/cm^2", "mm", "W/cm^2"),
    ("(mW/mm2)", "mm", "mW/mm2"),
    ("W_per_cm2", "mm", "W_per_cm2"),
    ("W/(cm^2)", "mm", "W/(cm^2)"),
    ("W.cm-2", "mm", "W.cm-2"),
    ("\u03bcW/mm^2", "mm", "\u03bcW/mm^2"),
    ("W per cm2", "mm", "W per cm2"),
    ("W/m$^2$", "mm", "W/m$^2$"),
    ("W m⁻²", "cm", "W m⁻²"),
    ("W/mm²/sr", "mm", "W/mm²/sr"),
    ("W/mm²", "mm", None),
    ("W·cm-2", "cm", None),
    ("W/mm^2 or W/cm^2", "mm", None),
    ("row/mm2", "mm", None),
    ("W_m20", "mm", None),
    ("5 W. mm 1 to 2", "cm", None),
]


@pytest.mark.parametrize(("unit", "length_unit", "refused"), STATED)
def test_values_in_another_unit_than_their_name_states(tmp_path, unit, length_unit, refused):
    """In the header of a table and as the name of an array. Seen to fail: a power 100 or 1000 times too large."""
    (tmp_path / "jn.csv").write_text(f"Jn [{unit}]\n" + "1.5\n" * 8)
    np.savez(tmp_path / "box.npz", vertices=VERTICES, faces=FACES, **{f"jn {unit}": np.full(8, 1.5)})
    for given in ((MESH, tmp_path / "jn.csv"), (tmp_path / "box.npz",)):
        if refused is None:
            assert (import_flux(*given, length_unit=length_unit).power > 0) is True
            continue
        with pytest.raises(FluxError, match=rf"values are in '{re.escape(refused)}' by .*taken for W/{length_unit}\^2"):
            import_flux(*given, length_unit=length_unit)


def test_meshes_in_another_unit_than_their_file_states(tmp_path):
    """Names of an .npz and comments of a PLY. Seen to fail: read in mm, and the other way, without a word."""
    np.savez(tmp_path / "box.npz", vertices_cm=VERTICES, faces=FACES, jn=np.ones(8))
    import_flux(MESH, np.ones(8)).write(tmp_path / "box.ply")
    for name, unit, other in (("box.npz", "cm", "mm"), ("box.ply", "mm", "cm")):
        with pytest.raises(FluxError, match=rf"vertices are in '{unit}' by the file.*Give --length-unit {unit}"):
            import_flux(tmp_path / name, length_unit=other)
        assert import_flux(tmp_path / name, length_unit=unit).power == pytest.approx(52)
    write_ply(tmp_path / "cm.ply", VERTICES, FACES, {"jn_x": np.ones(8)}, "vertex", {"unit": "W/cm^2"})
    with pytest.raises(FluxError, match=r"its values are in 'W/cm\^2'"):
        import_flux(tmp_path / "cm.ply")
    with pytest.raises(FluxError, match="its values are J_n by the file, and no fluence"):
        import_flux(tmp_path / "box.ply", a="robin")
    assert import_flux(tmp_path / "box.ply", np.ones(8), a=1.0).power == pytest.approx(26)


def test_fluence_by_a_ply_is_no_exitance(tmp_path):
    """Its comment states the quantity. Seen to fail: 52 W in place of 26 W with A = 1, without a word."""
    write_ply(tmp_path / "phi.ply", VERTICES, FACES, {"phi_x": np.ones(8)}, "vertex", {"quantity": "fluence"})
    with pytest.raises(FluxError, match="its values are fluence by the file, they would be taken for J_n"):
        import_flux(tmp_path / "phi.ply")
    assert import_flux(tmp_path / "phi.ply", a=1.0).power == pytest.approx(26)
    assert import_flux(tmp_path / "phi.ply", np.ones(8)).power == pytest.approx(52)


@pytest.mark.parametrize(
    ("kind", "units", "stated"),
    [
        ("3mf", "inch", "inch"),
        ("3mf", "centimeter", "cm"),
        ("3mf", "millimeters", None),
        ("dae", "0.01 * meters", "cm"),
        ("dae", "0.0254 * meters", "0.0254 * meters"),
        ("dae", "0.001 * meters", None),
        ("dae", "meters", None),  # trimesh's word for a file that states no unit, too
        ("step", "meters", "m"),
    ],
)
def test_the_unit_of_a_file_of_trimesh_is_checked(tmp_path, monkeypatch, kind, units, stated):
    """As trimesh reads it with lxml, pycollada or cascadio. Seen to fail: inches were mm, without a word."""
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False, metadata={"fspt_parts": 1})
    mesh.units = units
    monkeypatch.setattr("mitsuba_fspt.phantom.formats.surface_files.load_triangles", lambda path, kind: mesh)
    (tmp_path / f"box.{kind}").touch()
    if stated is None:
        assert import_flux(tmp_path / f"box.{kind}", np.ones(8)).area == pytest.approx(52)
        return
    with pytest.raises(FluxError, match=re.escape(f"its vertices are in '{stated}' by the file")):
        import_flux(tmp_path / f"box.{kind}", np.ones(8))


def test_quadrangles_are_no_tetrahedra(tmp_path):
    """Sides of a cube, of four corners each, as an array and named faces. Seen to fail: 1200 in place of 600 mm²."""
    corners = 10.0 * np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    np.savez(tmp_path / "cube.npz", vertices=corners, faces=sides, jn=np.ones(8))
    for given in (((corners, sides), np.ones(8)), ((corners, sides), np.ones(6)), (tmp_path / "cube.npz",)):
        with pytest.raises(FluxError, match=r"no two of the 6 share a face.*Split quadrangles into two triangles"):
            import_flux(*given)


@pytest.mark.parametrize("apart", [False, True])
def test_faces_that_are_there_twice_are_refused(apart):
    """With the same corners or with vertices of their own; a sheet may have a face on either side.

    Seen to fail: twice the power, without a word.
    """
    more = 8 if apart else 0
    again = np.roll(FACES[3:5], 1, axis=1) + more
    mesh = np.tile(VERTICES, (1 + apart, 1)), np.concatenate([FACES, again])
    with pytest.raises(FluxError, match="2 of its 14 faces repeat another one"):
        import_flux(mesh, np.ones(8 + more))
    sheet = FACES[:2], FACES[:2, ::-1]
    assert import_flux((VERTICES, np.concatenate(sheet)), np.ones(8)).area > 0


def run(*arguments):
    return CliRunner().invoke(app, ["import", *map(str, arguments)])


def test_cli_writes_and_reports(tmp_path):
    BOX.export(tmp_path / "box.off")
    np.save(tmp_path / "jn.npy", np.linspace(-0.1, 1, 8))
    arguments = [tmp_path / "box.off", "--values", tmp_path / "jn.npy", "--length-unit", "cm", "--clip"]
    result = run(*arguments, "--json", "-o", tmp_path / "box.ply")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["area"] == pytest.approx(5200)
    assert (report["negatives"], report["zeros"], report["watertight"], report["outward"]) == (
        1,
        1,
        True,
        True,
    )
    assert report["unit"] == "W/mm^2"
    assert report["max"] == pytest.approx(0.01)
    again = import_flux(tmp_path / "box.ply").report()
    assert again["power"] == report["power"]
    table = run(*arguments, "-o", tmp_path / "box.ply").stdout
    for name in (
        "area",
        "power",
        "min",
        "max",
        "zeros",
        "negatives",
        "watertight",
        "outward",
        "unit",
        "removed",
    ):
        assert f"\n{name}" in "\n" + table
    assert "W/mm^2" in table


def test_cli_refusal_leaves_no_file(tmp_path):
    BOX.export(tmp_path / "box.off")
    np.save(tmp_path / "jn.npy", np.linspace(-0.1, 1, 8))
    result = run(tmp_path / "box.off", "--values", tmp_path / "jn.npy", "-o", tmp_path / "box.ply")
    assert isinstance(result.exception, ExitanceError)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["box.off", "jn.npy"]
