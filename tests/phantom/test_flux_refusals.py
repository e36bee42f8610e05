"""Importing J_n: files of solvers and of meshio that must not be taken, or not without a choice."""

import struct
import sys

import meshio
import numpy as np
import pytest
from typer.testing import CliRunner

from mitsuba_fspt.cli.flux import app
from mitsuba_fspt.phantom.flux_import import import_flux
from mitsuba_fspt.runtime.errors import BackendError, FluxError

POINTS = np.vstack([np.zeros(3), np.eye(3)])
ELEMENT = np.array([[0, 1, 2, 3]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
NODES = "1 4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n"
ELEMENTS = "1 1\n1 1 2 3 4 1\n"
DREF = "1\t0.1\n2\t0.1\n3\t0.1\n4\t0.1\n"


def mmc(folder, nodes=NODES, elements=ELEMENTS, dref=DREF, name="s_dref.dat"):
    (folder / "node_s.dat").write_text(nodes)
    if elements is not None:
        (folder / "elem_s.dat").write_text(elements)
    (folder / name).write_bytes(dref if isinstance(dref, bytes) else dref.encode())
    return folder / "node_s.dat", folder / name


def write_ply(path, properties, vertices, faces):
    """A PLY in text with these further properties on vertices and on faces, and the lines of both."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(POINTS)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", *properties[0])]
    header += ["element face 4", "property list uchar int vertex_indices"]
    header += [f"property float {name}" for name in properties[1]]
    path.write_text("\n".join([*header, "end_header", *vertices, *faces, ""]))
    return path


CORNERS = [f"{x:g} {y:g} {z:g}" for x, y, z in POINTS]
SIDES = ["3 0 2 1", "3 0 1 3", "3 0 3 2", "3 1 2 3"]


def test_a_ply_that_ends_early(tmp_path):
    """Rationale: it was imported with the faces that were left."""
    path, vertices = tmp_path / "whole.ply", [f"{line} 1" for line in CORNERS]
    assert len(import_flux(write_ply(path, (["jn"], []), vertices, SIDES), field="jn").faces) == 4
    write_ply(path, (["jn"], []), vertices, SIDES[:-1])
    with pytest.raises(FluxError, match="ends early: its header tells of 4 face lines, there are 3"):
        import_flux(path, field="jn")


def test_a_ply_with_a_polygon_of_two_corners(tmp_path):
    """Rationale: beside a quadrangle, two triangles to the loader, the values of faces kept their number and moved."""
    faces = ["4 0 2 3 1 10", "2 0 1 20", "3 0 3 2 30", "3 1 2 3 40"]
    with pytest.raises(FluxError, match=r"has faces of 2 corners, a face has 3 or more\. Remove them"):
        import_flux(write_ply(tmp_path / "m.ply", ([], ["jn"]), CORNERS, faces))


def test_a_binary_ply_of_polygons_of_several_sizes(tmp_path):
    """Rationale: the loader takes the first size for all, and where the lengths agree misreads them in silence."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    faces = b"".join(struct.pack(f"<B{n}i", n, *[k % 4 for k in range(n)]) for n in (4, 3, 5))
    (tmp_path / "m.ply").write_bytes(header.encode() + POINTS.astype("<f4").tobytes() + faces)
    with pytest.raises(FluxError, match=r"faces of different numbers of corners, in binary form\. Triangulate it"):
        import_flux(tmp_path / "m.ply", np.ones(4))


def test_texture_coordinates_of_a_ply_are_values_by_name_only(tmp_path):
    vertices = [f"{line} {k + 1} 7" for k, line in enumerate(CORNERS)]
    path = write_ply(tmp_path / "m.ply", (["u", "v"], []), vertices, SIDES)
    with pytest.raises(FluxError, match=r"which field holds the values\?.*texture coordinates: 'u', 'v'\. Choose"):
        import_flux(path)
    assert import_flux(path, field="u").exitance.tolist() == [1, 2, 3, 4]
    assert import_flux(write_ply(path, (["jn", "v"], []), vertices, SIDES)).exitance.tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"name": "s_dref.jnii"}, r"s_dref\.jnii' is not a text _dref\.dat.*fluence.*no -F"),
        ({"name": "s_dref.bin"}, r"not a text _dref"),
        ({"dref": np.linspace(0, 1, 9).tobytes()}, r"is binary.*fluence; run mmc without -F"),
        ({"dref": DREF + "5\t0.1\n"}, r"values of shape \(5,\) do not fill time gates of 4 boundary faces"),
        ({"dref": "1 1 0.1\n2 1 0.1\n3 1 0.1\n4 1 0.1\n"}, r"has 3 columns.*one source"),
        ({"dref": "1 .1\n3 .1\n2 .1\n4 .1\n"}, r"must count faces from 1"),
        ({"dref": "0 .1\n0 .1\n0 .1\n0 .1\n"}, r"must count faces from 1"),
        ({"dref": DREF.replace("0.1", "100")}, r"400 times the launched energy.*-U 1"),
        ({"elements": None}, r"elem_s\.dat' cannot be read"),
        ({"elements": "10 1\n1 1 2 3 4 5 6 7 8 9 10 1\n"}, r"Linear tetrahedra"),
        ({"elements": "1 1\n1 1 2 3 5 1\n"}, r"vertices 0 to 4 \(counted from 0\), there are 4"),
        ({"nodes": "1 2\n1 0 0\n2 1 0\n"}, r"4 and 6 columns"),
    ],
)
def test_mmc_files(tmp_path, files, message):
    with pytest.raises(FluxError, match=message) as caught:
        import_flux(*mmc(tmp_path, **files))
    assert "\n" not in str(caught.value)


def test_masked_values_are_refused():
    """Seen to fail: what the mask hides counted."""
    values = np.ma.masked_greater([1.0, 1.0, 1.0, 9.0], 2)
    with pytest.raises(FluxError, match=r"'values' is a masked array that hides 1 values\. Fill it"):
        import_flux((POINTS, ELEMENT), values, per="vertex")


def test_mmc_options(tmp_path):
    mesh, values = mmc(tmp_path)
    assert import_flux(mesh, values).power == pytest.approx(0.4)
    with pytest.raises(FluxError, match="power that leaves each face already"):
        import_flux(mesh, values, a="robin")
    with pytest.raises(FluxError, match=r"Give --values SESSION_dref\.dat"):
        import_flux(mesh)
    with pytest.raises(FluxError, match=r"its values stand on faces, not per vertex"):
        import_flux(mesh, values, per="vertex")
    with pytest.raises(FluxError, match=r"no field"):
        import_flux(mesh, values, field="2")
    with pytest.raises(FluxError, match=r"is no node_ID\.dat\. Name the mesh so"):
        import_flux(mesh.rename(tmp_path / "mesh.dat"), values, format="mmc")


@pytest.mark.parametrize(
    ("node", "elem", "message"),
    [
        ("4 3 0 0\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n", "1 2 3 4\n", r"TetGen"),
        ("4 3 0 1\n1 0 0 0 1\n2 1 0 0 1\n3 0 1 0 1\n4 0 0 1 1\n", None, r"not a table of numbers.*TetGen"),
        ("1 0 0\n1 1 0\n1 0 1\n", "1 2 3\n", r"3 columns"),
        (
            "1 0 0 0\n1 1 0 0\n1 0 1 0\n1 0 0 1\n",
            "1 2 3\n2 3 4\n",
            r"must have 4 columns \(tetrahedra\), it has 3",
        ),
        ("1 0 0 0\n1 1 0 0\n1 0 1 0\n1 0 0 1\n", None, r"mesh\.elem' cannot be read"),
        ("1 0 0 0\n1 1 0 0\n1 0 1 0\n1 0 0 1\n", "0 1 2 3\n", r"vertices -1 to 2 .*from 0 or from 1"),
    ],
)
def test_nirfast_files(tmp_path, node, elem, message):
    """Seen to fail: of a TetGen .node with markers of the boundary the message said to fix its second line."""
    (tmp_path / "mesh.node").write_text(node)
    if elem is not None:
        (tmp_path / "mesh.elem").write_text(elem)
    with pytest.raises(FluxError, match=message):
        import_flux(tmp_path / "mesh.node", np.ones(4))


@pytest.mark.parametrize(
    ("cells", "point_data", "cell_data", "options", "message"),
    [
        ([("tetra", ELEMENT)], {"phi": np.ones(4), "psi": np.ones(4)}, {}, {}, r"'phi', 'psi'.*--field"),
        ([("tetra", ELEMENT)], {"phi": np.ones(4)}, {}, {"field": "jn"}, r"no field 'jn'.*has: 'phi'"),
        (
            [("tetra", ELEMENT)],
            {"v": np.ones((4, 3))},
            {},
            {},
            r"Fields it has: none\. Give the values by --values",
        ),
        (
            [("triangle", TRIANGLES)],
            {"jn": np.ones(4)},
            {"jn": [np.ones(4)]},
            {},
            r"on vertices and on faces.*--per",
        ),
        (
            [("tetra", ELEMENT), ("triangle", TRIANGLES)],
            {},
            {"jn": [np.ones(1), np.ones(4)]},
            {},
            r"cell data passed over: both on triangles and on tetrahedra",
        ),
        (
            [("quad", np.array([[0, 1, 2, 3]]))],
            {"jn": np.ones(4)},
            {},
            {},
            r"holds quad; triangles or tetrahedra",
        ),
        ([("line", np.array([[0, 1]]))], {"jn": np.ones(4)}, {}, {}, r"holds line; triangles or tetrahedra"),
    ],
)
def test_meshio_choices(tmp_path, cells, point_data, cell_data, options, message):
    meshio.Mesh(POINTS, cells, point_data, cell_data).write(tmp_path / "m.vtu")
    with pytest.raises(FluxError, match=message):
        import_flux(tmp_path / "m.vtu", **options)


def test_other_objects_are_no_mesh():
    with pytest.raises(FluxError, match=r"name of a file or \(points, cells\), got list"):
        import_flux([POINTS, TRIANGLES], np.ones(4))


def test_a_vtu_of_several_pieces(tmp_path):
    """Rationale: of two pieces the cells of the last one alone came, with half the power."""
    meshio.Mesh(POINTS, [("triangle", TRIANGLES)], {"jn": np.ones(4)}).write(tmp_path / "m.vtu", binary=False)
    text = (tmp_path / "m.vtu").read_text()
    piece = text[text.index("<Piece") : text.index("</Piece>") + len("</Piece>")]
    (tmp_path / "m.vtu").write_text(text.replace(piece, piece + piece))
    with pytest.raises(FluxError, match=r"m\.vtu' has 2 pieces, only one can be read\. Save them as one"):
        import_flux(tmp_path / "m.vtu")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("$EndNodeData\n", "$EndNodeData\n{section}", r"'jn' more than once.*Save one step alone"),
        ("\n4 4.0\n", "\n5 4.0\n", r"'jn' have other tags than the mesh\. Save both anew"),
        ("\n4 4.0\n", "\n3 4.0\n", r"'jn' have other tags than the mesh"),
    ],
    ids=["steps", "strange", "twice"],
)
def test_gmsh_values_of_no_node(tmp_path, old, new, message):
    path = tmp_path / "m.msh"
    meshio.gmsh.write(path, meshio.Mesh(POINTS, [("triangle", TRIANGLES)], {"jn": np.arange(1.0, 5)}), "2.2", False)
    text = path.read_text().replace("np.float64(", "").replace(")", "")
    section = text[text.index("$NodeData") :]
    assert old in text
    path.write_text(text.replace(old, new.format(section=section)))
    with pytest.raises(FluxError, match=message):
        import_flux(path)


def test_values_of_triangles_in_another_order_than_the_tetrahedra(tmp_path):
    """One value a boundary face, of a file that lists these as triangles: its order, where it is the same, or no mesh.

    Seen to fail: the values of the triangles came on other faces.
    """
    values = np.arange(1.0, 5)
    faces = import_flux((POINTS, ELEMENT), values, per="face").faces
    for turned, order in ((False, [0, 1, 2, 3]), (True, [2, 0, 3, 1])):
        mesh = meshio.Mesh(POINTS, [("tetra", ELEMENT), ("triangle", faces[order])])
        mesh.write(tmp_path / "m.mesh")
        if turned:
            with pytest.raises(FluxError, match=r"values: 4 values fit the boundary faces.* in another order"):
                import_flux(tmp_path / "m.mesh", values, per="face")
        else:
            np.testing.assert_array_equal(import_flux(tmp_path / "m.mesh", values, per="face").exitance, values)


def test_one_real_field_is_found_among_labels_and_vectors(tmp_path):
    mesh = meshio.Mesh(
        POINTS,
        [("tetra", ELEMENT), ("triangle", TRIANGLES), ("line", ELEMENT[:, :2])],
        {"phi": np.arange(4.0), "region": np.arange(4), "gradient": np.ones((4, 3))},
    )
    mesh.write(tmp_path / "m.vtu")
    assert import_flux(tmp_path / "m.vtu").provenance["source"] == (
        "m.vtu (its cell data passed over: both on triangles and on tetrahedra) 'phi'"
    )
    assert import_flux(tmp_path / "m.vtu", field="region").exitance.tolist() == [0, 1, 2, 3]


def test_whole_numbers_are_never_values_but_by_name(tmp_path):
    """Rationale: a file with nothing but the numbers of its regions was imported as J_n."""
    data = {"jn": [np.arange(1, 5)]}
    meshio.Mesh(POINTS, [("triangle", TRIANGLES)], {}, data).write(tmp_path / "m.vtu")
    with pytest.raises(FluxError, match=r"All it has are whole numbers.*: 'jn'\. Choose one by --field"):
        import_flux(tmp_path / "m.vtu")
    assert import_flux(tmp_path / "m.vtu", field="jn").exitance.tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("options", [{}, {"per": "face"}, {"per": "vertex"}, {"field": "medit:ref"}])
def test_labels_of_medit_are_no_field(tmp_path, options):
    """They stand on vertices and on cells, and were offered as values; for the media of a tissue they remain."""
    data = {"medit:ref": np.ones(4, int)}, {"medit:ref": [np.ones(4, int)]}
    meshio.Mesh(POINTS, [("triangle", TRIANGLES)], *data).write(tmp_path / "m.mesh")
    with pytest.raises(FluxError, match=r"Fields it has: none"):
        import_flux(tmp_path / "m.mesh", **options)


def test_second_order_tetrahedra_keep_their_corners(tmp_path):
    pairs = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
    points = np.vstack([POINTS, POINTS[pairs].mean(axis=1)])
    mesh = meshio.Mesh(points, [("tetra10", np.arange(10)[None])], {"phi": 1 + points @ [1.0, 2.0, 3.0]})
    mesh.write(tmp_path / "m.vtu")
    phantom = import_flux(tmp_path / "m.vtu")
    assert phantom.exitance.tolist() == [1, 2, 3, 4]
    assert phantom.area == pytest.approx(1.5 + np.sqrt(3) / 2)


@pytest.mark.parametrize(("module", "name", "extra"), [("meshio", "m.vtu", "mesh"), ("scipy.io", "phi.mat", "tissue")])
def test_a_missing_package_names_its_extra(tmp_path, monkeypatch, module, name, extra):
    (tmp_path / name).touch()
    monkeypatch.setitem(sys.modules, module, None)
    mesh = tmp_path / name if extra == "mesh" else (POINTS, TRIANGLES)
    with pytest.raises(BackendError, match=rf"is not installed\. pip install 'mitsuba-fspt\[{extra}\]'"):
        import_flux(mesh, tmp_path / name)


def test_a_package_that_a_loader_misses(tmp_path, monkeypatch):
    """Rationale: it was asked whether the file is damaged."""

    def load(*_, **__):
        raise ImportError("No module named 'networkx'")

    monkeypatch.setattr("trimesh.load_scene", load)
    (tmp_path / "m.3mf").touch()
    with pytest.raises(
        BackendError, match=r"m\.3mf' as \.3mf needs a package .*'networkx'\. Install it by pip, or save"
    ):
        import_flux(tmp_path / "m.3mf", np.ones(4))


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "off", "npz", "vtu", "msh", "glb"])
def test_a_folder_for_a_mesh(tmp_path, suffix):
    (tmp_path / f"m.{suffix}").mkdir()
    with pytest.raises(FluxError, match=r"(it is a folder|Is a directory)\. Check the name\."):
        import_flux(tmp_path / f"m.{suffix}", np.ones(4))


LONG = "x" * 300


@pytest.mark.parametrize(
    "arguments", [f"{LONG}.ply -o o.ply", f"m.ply --values {LONG}.csv -o o.ply", f"m.ply -o {LONG}.ply"]
)
def test_names_that_are_too_long(tmp_path, monkeypatch, arguments):
    """Rationale: to ask for such a file raises."""
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "m.ply", (["jn"], []), [f"{line} 1" for line in CORNERS], SIDES)
    result = CliRunner().invoke(app, ["import", *arguments.split()])
    assert isinstance(result.exception, FluxError)
    assert [path.name for path in tmp_path.iterdir()] == ["m.ply"]


def test_the_message_for_a_file_that_meshio_cannot_read_has_a_fix(tmp_path):
    (tmp_path / "m.vtu").write_text("<VTK")
    with pytest.raises(FluxError, match=r"cannot be read by meshio: .*\. Save it anew\."):
        import_flux(tmp_path / "m.vtu")


def test_npz_fields(tmp_path):
    arrays = {"vertices_mm": POINTS, "faces": TRIANGLES, "source_mm": np.zeros(3), "jn_mc": np.ones(4)}
    np.savez(tmp_path / "m.npz", **arrays)
    assert import_flux(tmp_path / "m.npz", per="face").per == "face"
    np.savez(tmp_path / "m.npz", jn_fem=np.full(4, 2.0), **arrays)
    with pytest.raises(FluxError, match=r"'jn_fem', 'jn_mc'\. Choose one by --field"):
        import_flux(tmp_path / "m.npz", per="face")
    assert import_flux(tmp_path / "m.npz", field="jn_fem", per="face").exitance.tolist() == [2, 2, 2, 2]
    np.savez(tmp_path / "m.npz", exitance=np.full(4, 3.0), jn_fem=np.ones(4), **arrays)
    assert import_flux(tmp_path / "m.npz", per="vertex").exitance.tolist() == [3, 3, 3, 3]
    np.savez(tmp_path / "m.npz", points=POINTS, faces=TRIANGLES)
    with pytest.raises(FluxError, match=r"one array named vertices or nodes.*'points' \(4, 3\)"):
        import_flux(tmp_path / "m.npz")


DESCRIPTION = """
[geometry]
{geometry}
[optical]
mua = 0.05
musp = 1
[[sources]]
shape = "point"
centre = [0, 0, 0]
"""


@pytest.mark.parametrize(
    ("arguments", "overwritten"),
    [
        ("import m.ply -o m.ply", "-o would overwrite 'm.ply'"),
        ("import link.ply -o m.ply", "-o would overwrite 'link.ply'"),
        ("import m.ply --values v.ply -o ./v.ply", "-o would overwrite 'v.ply'"),
        ("solve file.toml -o m.ply", "-o would overwrite 'm.ply'"),
        ("solve file.toml -o new.ply --volume file.toml", "must end in .vol. Give a name such as fluence.vol"),
        ("solve told.vol -o new.ply --volume told.vol", "--volume would overwrite 'told.vol'"),
        ("solve file.toml -o new.ply --volume link.vol", "--volume would overwrite 'm.ply'"),
        ("solve told.ply -o told.ply", "-o would overwrite 'told.ply'"),
    ],
)
def test_no_output_takes_the_place_of_an_input(tmp_path, monkeypatch, arguments, overwritten):
    """Refused before any work, whatever the name it is given by; every file stays as it was."""
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "m.ply", (["jn"], []), [f"{line} 1" for line in CORNERS], SIDES)
    for name in ("link.ply", "link.vol"):
        (tmp_path / name).symlink_to("m.ply")
    (tmp_path / "v.ply").write_text("1\n2\n3\n4\n")
    (tmp_path / "file.toml").write_text(DESCRIPTION.format(geometry='file = "m.ply"'))
    for name in ("told.vol", "told.ply"):
        (tmp_path / name).write_text(DESCRIPTION.format(geometry='shape = "cylinder"\nradius = 3\nheight = 6'))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    result = CliRunner().invoke(app, arguments.split())
    assert isinstance(result.exception, FluxError)
    assert overwritten in str(result.exception)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
