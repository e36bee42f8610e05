"""Importing J_n: every format keeps order, orientation, unit and power.

Most tests put values on a mesh by a law of the place and look whether, after the way through the file, every
value stands where the law wants it: a wrong order, a wrong face or a wrong unit all break that.
"""

import meshio
import numpy as np
import pytest
import trimesh

from mitsuba_fspt.phantom.flux_import import import_flux
from mitsuba_fspt.phantom.formats import surface_files
from mitsuba_fspt.phantom.formats.row_order import require_order
from mitsuba_fspt.phantom.formats.table import read_values
from mitsuba_fspt.phantom.surface_mesh import face_normals
from mitsuba_fspt.runtime.errors import FluxError

SPHERE = trimesh.creation.icosphere(subdivisions=2, radius=4.0)
VERTICES, FACES = np.array(SPHERE.vertices), np.array(SPHERE.faces)


def law(points):
    """J_n [W/mm²] at points [mm], shape (..., 3): linear, not the same by symmetry, > 0 on these meshes."""
    return 0.3 + points @ np.array([0.01, 0.02, 0.005])


def centroids(points, faces):
    return points[faces].mean(axis=1)


def block(orientation="mixed", cells=2, side=6.0):
    """Tetrahedra in a cube: corner nodes (27, 3), elements (48, 4) from 0.

    Six about the diagonal of each small cube; 'mixed' deals every element's corners out at random, so that
    both orientations and every place of a boundary face occur.
    """
    grid = np.linspace(0, side, cells + 1)
    nodes = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.arange((cells + 1) ** 3).reshape(3 * (cells + 1,))
    cubes = np.stack([corner[i : i + cells, j : j + cells, k : k + cells].ravel() for i, j, k in np.ndindex(2, 2, 2)])
    walks = [(1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)]
    elements = np.concatenate([cubes[[0, b, a, 7]].T for a, b in walks])
    if orientation == "mixed":
        return nodes, np.random.default_rng(5).permuted(elements, axis=1)
    return nodes, elements


def element_boundary(elements):
    """Boundary faces in MMC's documented order, as sets of nodes, counted one by one: by other means."""
    order = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    faces = [frozenset(element[corners]) for element in elements for corners in order]
    return [face for face in faces if faces.count(face) == 1]


def assert_law(phantom, area=None):
    """Every value stands where the law wants it, on a closed outward surface."""
    places = phantom.vertices if phantom.per == "vertex" else centroids(phantom.vertices, phantom.faces)
    np.testing.assert_allclose(phantom.exitance, law(places), rtol=2e-6)
    assert np.ptp(phantom.exitance) > 0.1
    report = phantom.report()
    assert (report["watertight"], report["outward"]) == (True, True)
    if area is not None:
        assert report["area"] == pytest.approx(area, rel=1e-6)


def write(path, text):
    path.write_text(text)
    return path


def rows(array):
    return "".join(" ".join(f"{x:.9g}" for x in np.atleast_1d(row)) + "\n" for row in array)


@pytest.mark.parametrize("per", ["vertex", "face"])
@pytest.mark.parametrize("suffix", ["stl", "stl_ascii", "obj", "ply", "off", "glb"])
def test_trimesh_formats_with_values_beside(tmp_path, suffix, per):
    """A mesh trimesh wrote, values in a CSV: both orders survive, but an STL's vertices have none."""
    mesh, values = tmp_path / f"mesh.{suffix.removesuffix('_ascii')}", tmp_path / "values.csv"
    SPHERE.export(mesh, file_type=suffix)
    values.write_text("J_n\n" + rows(law(VERTICES if per == "vertex" else centroids(VERTICES, FACES))))
    if mesh.suffix == ".stl" and per == "vertex":
        with pytest.raises(FluxError, match="STL"):
            import_flux(mesh, values, per=per)
        return
    phantom = import_flux(mesh, values, length_unit="mm")  # a GLB would be in metres
    assert phantom.per == per
    assert len(phantom.vertices) == len(VERTICES)
    assert_law(phantom, SPHERE.area)


def test_values_beside_several_meshes_without_an_order_are_refused(tmp_path):
    """Two spheres of a GLB. Seen to fail: each had the values of the other one, without a word.

    Points beside one mesh are no second one. Seen to fail: refused.
    """
    trimesh.Scene([SPHERE, trimesh.PointCloud(VERTICES)]).export(tmp_path / "one.glb")
    assert import_flux(tmp_path / "one.glb", np.ones(len(VERTICES))).per == "vertex"
    both = trimesh.Scene([SPHERE, SPHERE.copy().apply_translation((0, 0, 50))])
    both.export(tmp_path / "two.glb")
    with pytest.raises(FluxError, match="it holds 2 meshes, whose order its format leaves open"):
        import_flux(tmp_path / "two.glb", np.repeat([1.0, 2.0], len(VERTICES)))


def test_a_glb_is_in_metres(tmp_path):
    """By glTF's standard; its values are W/m², so that the power is that of the same numbers in W/mm² and mm.

    The report says that y is up in such a file. Seen to fail: without a word.
    """
    SPHERE.export(tmp_path / "mesh.glb")
    in_mm = import_flux(tmp_path / "mesh.glb", law(VERTICES), length_unit="mm")
    phantom = import_flux(tmp_path / "mesh.glb", law(VERTICES))
    assert phantom.area == pytest.approx(1e6 * in_mm.area)
    assert phantom.power == pytest.approx(in_mm.power)
    assert (
        phantom.report()["mesh_unit"] == "m, by the standard of its format; scaled to mm, values from W/m^2 to W/mm^2"
    )
    assert "mesh_unit" not in in_mm.report()
    assert "y up by its standard" in phantom.report()["mesh_axes"]
    assert phantom.report()["mesh_axes"] == in_mm.report()["mesh_axes"]


def test_obj_of_a_modeller_keeps_the_order_of_its_lines(tmp_path):
    """Texture coordinates, normals and materials of an OBJ make loaders split and sort; not here."""
    turned = np.random.default_rng(3).permutation(len(FACES))
    faces = [f"usemtl m{k % 3}\nf " + " ".join(f"{v + 1}/{v % 5 + 1}/{v + 1}" for v in FACES[k]) for k in turned]
    text = "mtllib none.mtl\no sphere\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in VERTICES)
    text += "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\nvt .5 .5\n" + "".join(f"vn {x} {y} {z}\n" for x, y, z in VERTICES)
    mesh = write(tmp_path / "mesh.obj", text + "\n".join(faces) + "\n")
    assert_law(import_flux(mesh, law(VERTICES)), SPHERE.area)
    assert_law(import_flux(mesh, law(centroids(VERTICES, FACES[turned]))), SPHERE.area)


def off(counts="OFF\n{} {} 0\n", point="{} {} {}\n", face="3 {} {} {}\n"):
    text = counts.format(len(VERTICES), len(FACES)) + "".join(point.format(*v) for v in VERTICES.tolist())
    return text + "".join(face.format(*f) for f in FACES.tolist())


@pytest.mark.parametrize("counts", ["OFF\n{} {} 0\n", "# made\n\nOFF # by\n# hand\n{} {} 960\n", "OFF {} {} 0\r\n"])
def test_off_of_points_and_triangles_is_read_at_once(tmp_path, monkeypatch, counts):
    """Without trimesh, which takes seconds for 400,000 faces, and every bit as it stands in the text."""
    monkeypatch.setattr(surface_files, "load_triangles", None)
    phantom = import_flux(write(tmp_path / "mesh.off", off(counts)), law(VERTICES))
    np.testing.assert_array_equal(phantom.vertices, VERTICES)
    np.testing.assert_array_equal(phantom.faces, FACES)


@pytest.mark.parametrize(
    "text",
    [
        off(face="3 {} {} {} 255 0 0\n"),
        off("OFF\n{} {} 0\n").replace("OFF", "COFF", 1).replace("\n3 ", " 0 0 0 1\n3 ", 1),
        off() + "0 0 0\n",
    ],
    ids=["colours", "header", "more"],
)
def test_off_with_more_in_it_is_left_to_trimesh(tmp_path, monkeypatch, text):
    asked, real = [], surface_files.load_triangles
    monkeypatch.setattr(surface_files, "load_triangles", lambda *args: asked.append(args) or real(*args))
    assert_law(import_flux(write(tmp_path / "mesh.off", text), law(VERTICES)), SPHERE.area)
    assert asked == [(tmp_path / "mesh.off", "off")]


def test_off_of_four_sided_faces(tmp_path):
    """A box of six squares, which trimesh makes triangles of."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    sides = ["0 1 3 2", "4 6 7 5", "0 4 5 1", "2 3 7 6", "0 2 6 4", "1 5 7 3"]
    mesh = write(tmp_path / "box.off", "OFF\n8 6 12\n" + rows(corners) + "".join(f"4 {side}\n" for side in sides))
    assert import_flux(mesh, np.ones(8)).area == pytest.approx(6)


@pytest.mark.parametrize("per", ["vertex", "face"])
def test_ply_properties(tmp_path, per):
    """A scalar property by any name, of a PLY that trimesh wrote; Mitsuba's suffix may be left out."""
    mesh = SPHERE.copy()
    attributes = mesh.vertex_attributes if per == "vertex" else mesh.face_attributes
    attributes["jn_x"] = law(VERTICES if per == "vertex" else centroids(VERTICES, FACES))
    attributes["region"] = np.arange(len(attributes["jn_x"]), dtype=np.int32)
    mesh.export(tmp_path / "mesh.ply")
    for field in (None, "jn", "jn_x"):
        phantom = import_flux(tmp_path / "mesh.ply", field=field)
        assert phantom.per == per
        assert_law(phantom, SPHERE.area)


def test_ply_with_texture_coordinates_keeps_its_vertices(tmp_path):
    """Texture coordinates at the corners of faces would make trimesh split and sort the vertices."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(VERTICES)}\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "jn"))
    header += f"element face {len(FACES)}\nproperty list uchar int vertex_indices\n"
    header += "property list uchar float texcoord\nend_header\n"
    faces = "".join(f"3 {a} {b} {c} 6 0 0 1 0 0 {c % 2}\n" for a, b, c in FACES)
    mesh = write(tmp_path / "mesh.ply", header + rows(np.column_stack([VERTICES, law(VERTICES)])) + faces)
    for values in (None, law(VERTICES), law(centroids(VERTICES, FACES))):
        assert_law(import_flux(mesh, values), SPHERE.area)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh", "xdmf", "mesh", "inp"])
@pytest.mark.parametrize("cell", ["triangle", "tetra"])
@pytest.mark.parametrize("per", ["vertex", "face"])
def test_meshio_formats(tmp_path, suffix, cell, per):
    """A mesh meshio wrote; of tetrahedra the boundary, outward, node data where the nodes are."""
    points, cells = (VERTICES, FACES) if cell == "triangle" else block(cells=3)
    path, values = tmp_path / f"mesh.{suffix}", None
    data = law(points if per == "vertex" else centroids(points, cells))
    mesh = meshio.Mesh(points, [(cell, cells)])
    if suffix in ("mesh", "inp"):
        values = write(tmp_path / "values.txt", rows(data))
    elif per == "vertex":
        mesh.point_data = {"jn": data}
    else:
        mesh.cell_data = {"jn": [data]}
    if suffix == "xdmf":
        pytest.importorskip("h5py", reason="meshio writes XDMF by h5py")
    options = {"vtu": {"binary": True}, "xdmf": {"data_format": "XML"}, "msh": {"file_format": "gmsh"}}
    mesh.write(path, **options.get(suffix, {}))
    phantom = import_flux(path, values)
    assert phantom.per == per
    if cell == "triangle" or per == "vertex":
        assert_law(phantom, SPHERE.area if cell == "triangle" else 6 * 36.0)
        return
    # A face has the value of its tetrahedron, the one with all its three corners.
    corners = np.array([np.flatnonzero(np.isclose(points, v).all(axis=1))[0] for v in phantom.vertices])
    for face, value in zip(corners[phantom.faces], phantom.exitance, strict=True):
        (owner,) = np.flatnonzero(np.isin(cells, face).sum(axis=1) == 3)
        assert value == pytest.approx(data[owner], rel=1e-6)
    assert phantom.report()["outward"] is True


def turned(text, section, header):
    """The lines of a section of a text file in reverse order, but the `header` lines it begins with."""
    before, name, rest = text.partition(f"${section}\n")
    inside, end, after = rest.partition(f"$End{section}\n")
    lines = inside.splitlines(keepends=True)
    return "".join([before, name, *lines[:header], *lines[: header - 1 : -1], end, after])


def write_gmsh(path, version, binary, nodes):
    """SPHERE with jn and jf by the law, the nodes on lines (or rows) in the order `nodes`; tags are 1, 2, 3, ..."""
    data = {"jn": law(VERTICES)}, {"jf": [law(centroids(VERTICES, FACES))]}
    points = VERTICES[nodes] if binary and version == "4.1" else VERTICES
    mesh = meshio.Mesh(points, [("triangle", FACES)], *data)
    meshio.gmsh.write(path, mesh, version, binary=binary)
    if binary and version == "4.1":
        tags = np.arange(1, len(VERTICES) + 1, dtype=np.uint64)
        content = path.read_bytes()
        assert content.count(tags.tobytes()) == 1
        path.write_bytes(content.replace(tags.tobytes(), tags[nodes].tobytes()))


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_gmsh_values_go_to_the_tags_they_have(tmp_path, version, binary):
    """Not to the nodes and elements in the order of their lines, which is any order."""
    path = tmp_path / "mesh.msh"
    write_gmsh(path, version, binary, np.random.default_rng(2).permutation(len(VERTICES)))
    if not binary:
        text = path.read_text().replace("np.float64(", "").replace(")", "")  # as meshio writes with NumPy 2
        for section in ("Nodes", "Elements") if version == "2.2" else ("NodeData", "ElementData"):
            text = turned(text, section, 1 if version == "2.2" else 8)
        path.write_text(text)
    for field in ("jn", "jf"):
        assert_law(import_flux(path, field=field), SPHERE.area)


def test_boundary_of_tetrahedra_is_outward_whatever_their_orientation():
    """The opposite node decides; without it half of the mixed block's faces would show inward."""
    nodes, elements = block("mixed")
    phantom = import_flux((nodes, elements), law(nodes))
    normals = face_normals(phantom.vertices, phantom.faces)
    assert (np.einsum("ij,ij->i", normals, centroids(phantom.vertices, phantom.faces) - 3.0) > 0).all()
    assert phantom.area == pytest.approx(6 * 36)
    assert len(phantom.vertices) == 26  # the node in the middle is no part of the surface


def write_mmc(folder, nodes, elements, dref, gates=1, beside=()):
    """The files of MMC's command line tool, as its documentation has them."""
    number = np.arange(1, len(nodes) + 1)
    write(folder / "node_cube.dat", f"1\t{len(nodes)}\n" + rows(np.column_stack([number, nodes])))
    table = np.column_stack([np.arange(1, len(elements) + 1), elements + 1, np.ones(len(elements), int)])
    write(folder / "elem_cube.dat", f"1\t{len(elements)}\n" + rows(table))
    for name in beside:
        write(folder / f"{name}_cube.dat", "1 1\n")
    lines = [f"{k + 1}\t{value / gates:e}\n" for _ in range(gates) for k, value in enumerate(dref)]
    return folder / "node_cube.dat", write(folder / "cube_dref.dat", "".join(lines))


@pytest.mark.parametrize("gates", [1, 3])
@pytest.mark.parametrize("beside", [(), ("velem",), ("facenb",)])
def test_mmc_faces_in_its_order(tmp_path, gates, beside):
    """dref is energy per face: J_n = dref/area, its faces element by element.

    Without facenb and velem files MMC first turns elements of positive (2−1)·(3−1)×(4−1) by exchanging their
    last nodes; seen with pmmc 0.3.12 on such a mesh. Leaving that out moves values between faces of corner
    elements, and this test fails; so it does where dref is not divided by the area.
    """
    nodes, elements = block("mixed")
    numbered = elements.copy()
    if not beside:
        positive = np.linalg.det(nodes[elements[:, 1:]] - nodes[elements[:, :1]]) > 0
        assert 0 < positive.sum() < len(elements)
        numbered[positive] = elements[positive][:, [0, 1, 3, 2]]
    places = np.array([nodes[list(face)].mean(axis=0) for face in element_boundary(numbered)])
    energy = 1e-3 * law(places) * 4.5  # every face has 3 · 3 / 2 mm²
    mesh, values = write_mmc(tmp_path, nodes, elements, energy, gates, beside)
    for given in (mesh, tmp_path / "elem_cube.dat"):
        phantom = import_flux(given, values)
        np.testing.assert_allclose(phantom.exitance, 1e-3 * law(centroids(phantom.vertices, phantom.faces)), rtol=1e-5)
    assert phantom.power == pytest.approx(energy.sum(), rel=1e-5)
    assert phantom.report()["outward"] is True
    in_memory = import_flux((nodes, elements + 1), np.tile(energy / 2, (2, 1)).T, format="mmc")
    if not beside:
        np.testing.assert_allclose(in_memory.exitance, phantom.exitance, rtol=1e-5)


def test_mmc_energy_per_face_does_not_depend_on_the_length_unit(tmp_path):
    nodes, elements = block()
    mesh, values = write_mmc(tmp_path, nodes, elements, np.full(48, 0.01))
    phantom = import_flux(mesh, values, length_unit="cm")
    assert phantom.power == pytest.approx(0.48)
    assert phantom.area == pytest.approx(100 * 6 * 36)


@pytest.mark.parametrize("suffix", ["txt", "npy", "mat"])
def test_nirfast(tmp_path, suffix):
    """phi at the nodes becomes phi/(2A); .node lines are `boundary x y z`, without a number of the node.

    A(1.37) by hand: (2/(1 − 0.37²/2.37²) − 1 + (1 − 1/1.37²)^1.5) · 1.37² = 2.57006. Fails where the 2 is
    left out.
    """
    import scipy.io

    nodes, elements = block()
    inside = (nodes > 0).all(axis=1) & (nodes < 6).all(axis=1)
    write(tmp_path / "cube.node", rows(np.column_stack([~inside, nodes])))
    write(tmp_path / "cube.elem", rows(elements + 1))
    values, phi = tmp_path / f"phi.{suffix}", 2 * 2.5700602 * law(nodes)
    if suffix == "npy":
        np.save(values, phi)
    elif suffix == "mat":
        scipy.io.savemat(values, {"data": {"phi": np.column_stack([phi, 2 * phi]), "freq": 0.0}, "region": 1})
    else:
        write(values, rows(phi))
    field = "data.phi:1" if suffix == "mat" else None
    phantom = import_flux(tmp_path / "cube.node", values, field=field)
    assert_law(phantom, 6 * 36)
    assert phantom.provenance["boundary_factor"] == "2.57006 (robin, n = 1.37)"
    by_base_name = import_flux(tmp_path / "cube", values, field=field)
    np.testing.assert_array_equal(by_base_name.exitance, phantom.exitance)
    in_memory = import_flux((nodes, elements + 1), phi, format="nirfast")
    np.testing.assert_allclose(in_memory.exitance, phantom.exitance, rtol=1e-6)


@pytest.mark.parametrize("places", ["vertices", "faces"])
def test_rows_with_positions_in_another_order_are_refused(tmp_path, places):
    """A table x, y, z [m], J_n of vertices or centroids of a mesh in mm, 5 mm away. Seen to fail: J_n on other vertices
    without a word, whose correlation with the right ones was -0.06.
    """
    ball = trimesh.creation.icosphere(1, 10.0)
    at = ball.vertices if places == "vertices" else ball.triangles_center
    table = np.column_stack([1e-3 * (at + 5), 2 + at[:, 2] / 10])
    for order, good in ((slice(None), True), (slice(None, None, -1), False)):
        np.savetxt(tmp_path / "jn.csv", table[order], delimiter=",", header="x,y,z,jn", comments="")
        if good:
            found = import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="jn")
            np.testing.assert_allclose(found.exitance, table[:, 3])
            continue
        with pytest.raises(FluxError, match="columns 1 to 3 are positions of the mesh's elements in another order"):
            import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="jn")


def test_positions_outweigh_numbers_of_a_larger_mesh(tmp_path):
    """Node numbers of a volume mesh in the order of its surface, beside the positions. Seen to fail: refused."""
    ball = trimesh.creation.icosphere(1, 10.0)
    numbers = 7 + 3 * np.arange(len(ball.vertices))[::-1]
    table = np.column_stack([numbers, ball.vertices / 10, np.ones(len(numbers))])
    np.savetxt(tmp_path / "jn.csv", table, delimiter=",", header="node,x,y,z,jn", comments="")
    assert import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="jn").per == "vertex"


def test_columns_that_are_no_positions_are_passed_over_at_once(monkeypatch):
    """Time gates: their sorted values are not those of the vertices, so that no nearest vertices are searched for.

    Seen to fail: 30 gates of 160,000 vertices did not end within five minutes.
    """
    monkeypatch.setattr("scipy.spatial.cKDTree", lambda points: pytest.fail("a tree for values"))
    ball = trimesh.creation.icosphere(2, 10.0)
    gates = np.exp(-np.arange(9.0) * (1 + ball.vertices[:, :1] / 40))
    require_order(gates, [], "1", (ball.vertices, ball.triangles_center), "jn.csv")


@pytest.mark.parametrize(("header", "refused"), [("node,jn", True), ("", True), ("num_photons,jn", False)])
def test_rows_with_numbers_of_a_larger_mesh(tmp_path, header, refused):
    """Node numbers 7, 10, 13 … in another order; a first column with another name may hold anything.

    Seen to fail: taken in the order of the rows, but for numbers from 0 or 1; and num_photons refused.
    """
    ball = trimesh.creation.icosphere(1, 10.0)
    numbers = 7 + 3 * np.arange(len(ball.vertices))[::-1]
    np.savetxt(
        tmp_path / "jn.csv", np.column_stack([numbers, 1e-6 * numbers]), delimiter=",", header=header, comments=""
    )
    if not refused:
        assert import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="2").power > 0
        return
    with pytest.raises(FluxError, match="column 1 numbers the rows, but not in ascending order"):
        import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="2")


def test_a_table_beside_vertices_far_away(tmp_path):
    """Seen to fail: NumPy's warning of the middles of the faces before the line, and a traceback of SciPy's tree."""
    far = VERTICES / np.abs(VERTICES).max() * 1e308
    np.savetxt(tmp_path / "jn.csv", np.column_stack([far, np.ones(len(far))]))
    with pytest.raises(FluxError, match="a vertex lies at 1e\\+308 mm"):
        import_flux((far, SPHERE.faces), tmp_path / "jn.csv", field="4", per="vertex")


@pytest.mark.parametrize("first", [0, 1])
def test_numbers_of_the_rows_are_no_values(tmp_path, first):
    """Column 1 of node, jn by its number. Seen to fail: a power of 0, 1, 2, … W/mm² without a word."""
    ball = trimesh.creation.icosphere(1, 10.0)
    rows = [f"{first + k},1e-6" for k in range(len(ball.vertices))]
    (tmp_path / "jn.csv").write_text("\n".join(["node,jn", *rows]))
    with pytest.raises(FluxError, match="column 1 numbers the rows and holds no values"):
        import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="1")


@pytest.mark.parametrize("first", [0, 1])
def test_rows_that_are_numbered_in_another_order_are_refused(tmp_path, first):
    """A table by nodes, sorted by something else: the values were taken in the order of the rows."""
    ball = trimesh.creation.icosphere(1, 10.0)
    numbers = np.arange(len(ball.vertices))
    for order, good in ((numbers, True), (numbers[::-1], False)):
        rows = [f"{first + k},{1e-6 * k}" for k in order]
        (tmp_path / "jn.csv").write_text("\n".join(["node,jn", *rows]))
        if good:
            found = import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="jn")
            np.testing.assert_allclose(found.exitance, 1e-6 * numbers)
            continue
        with pytest.raises(FluxError, match="column 1 numbers the rows, but not in ascending order"):
            import_flux((ball.vertices, ball.faces), tmp_path / "jn.csv", field="jn")


@pytest.mark.parametrize(("field", "column"), [("jn", 2), (3, 2), ("label", 1)])
def test_a_column_of_labels_is_no_numbering_of_other_rows(tmp_path, field, column):
    """Nodes in order stand beside labels 3, 1, 2, 4, or these are the values; refused before."""
    table = np.array([[1, 3, 0.1], [2, 1, 0.2], [3, 2, 0.3], [4, 4, 0.4]])
    np.savetxt(tmp_path / "jn.csv", table, delimiter=",", header="node,label,jn", comments="")
    np.testing.assert_array_equal(read_values(tmp_path / "jn.csv", str(field)), table[:, column])
    np.savetxt(tmp_path / "jn.csv", table[:, 1:], delimiter=",", header="label,jn", comments="")
    np.testing.assert_array_equal(read_values(tmp_path / "jn.csv", "label"), table[:, 1])


@pytest.mark.parametrize("number", [2, np.int64(2), "2"])
def test_a_column_by_its_number(tmp_path, number):
    """Seen to fail: no number that is no text was taken."""
    nodes, elements = block()
    table = np.column_stack([np.ones(27), np.arange(27.0)])
    write(tmp_path / "values.txt", rows(table))
    by_file = import_flux((nodes, elements), tmp_path / "values.txt", field=number, per="vertex")
    by_array = import_flux((nodes, elements), table, field=number, per="vertex")
    alone = import_flux((nodes, elements), table[:, 1], per="vertex")
    np.testing.assert_array_equal(by_file.exitance, alone.exitance)
    np.testing.assert_array_equal(by_array.exitance, alone.exitance)
    with pytest.raises(FluxError, match=r"'n' must be a number, got '1\.4'\. Give for example 1\.37"):
        import_flux((nodes, elements), table[:, 1], per="vertex", a="robin", n="1.4")


@pytest.mark.parametrize("kind", ["stnd", "fluor", "blt"])
def test_nirfast_refractive_index_of_param(tmp_path, kind):
    """The .param file tells n: A(1.53) where it says so, node by node, unless n is given."""
    nodes, elements = block()
    write(tmp_path / "cube.node", rows(np.column_stack([np.ones(27), nodes])))
    write(tmp_path / "cube.elem", rows(elements + 1))
    index = np.where(nodes[:, 0] > 3, 1.53, 1.37)
    columns = [np.full((27, 2), 0.1), index, np.full((27, 5 if kind == "fluor" else 0), 0.2)]
    write(tmp_path / "cube.param", f"{kind}\n" + rows(np.column_stack(columns)))
    phantom = import_flux(tmp_path / "cube.node", np.ones(27))
    ratio = phantom.exitance[phantom.vertices[:, 0] <= 3][0] / phantom.exitance[phantom.vertices[:, 0] > 3][0]
    assert ratio == pytest.approx(3.571 / 2.570, abs=1e-3)
    assert phantom.provenance["boundary_factor"] == "2.57006 to 3.57064 (robin, n = 1.37 to 1.53)"
    assert np.ptp(import_flux(tmp_path / "cube.node", np.ones(27), n=1.4).exitance) == 0


def test_nirfast_kinds_of_param_without_an_index_need_it(tmp_path):
    """Rationale: 1.37 was taken in silence. The concentrations of kind spec are no n."""
    nodes, elements = block()
    write(tmp_path / "cube.node", rows(np.column_stack([np.ones(27), nodes])))
    write(tmp_path / "cube.elem", rows(elements + 1))
    names = "HbO\ndeoxyHb\nWater\nS-Amplitude\nS-Power\n"
    write(tmp_path / "cube.param", f"spec\n{names}" + rows(np.full((27, 5), 0.5)))
    with pytest.raises(FluxError, match=r"its \.param tells no refractive index n for A\. Give --n"):
        import_flux(tmp_path / "cube.node", np.ones(27))
    phantom = import_flux(tmp_path / "cube.node", np.ones(27), n=1.53)
    assert phantom.provenance["boundary_factor"] == "3.57064 (robin, n = 1.53)"
    assert import_flux(tmp_path / "cube.node", np.ones(27), a=2.5).power == pytest.approx(6 * 36 / 5)
