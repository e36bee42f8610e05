"""Phantoms described in TOML, meshes of tissue from files, and `fspt flux solve` over them."""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from mitsuba_fspt.cli.flux import app
from mitsuba_fspt.optics.boundary import boundary_a
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Cylinder, Sphere
from mitsuba_fspt.phantom.flux_import import import_flux
from mitsuba_fspt.phantom.phantom import Phantom
from mitsuba_fspt.phantom.surface_mesh import boundary
from mitsuba_fspt.runtime.errors import BackendError, FluxError
from mitsuba_fspt.tissue import phantom_file
from mitsuba_fspt.tissue.composition import Absorbers
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.diffusion import solve
from mitsuba_fspt.tissue.mesher import read_tetrahedra, tetrahedralize
from mitsuba_fspt.tissue.phantom_file import Band, CylinderGeometry, PhantomFile, Region, Spread

pytest.importorskip("skfem")
SCENES = Path(__file__).parents[2] / "scenes"
SMALL = """
[geometry]
shape = "cylinder"
radius = 6
height = 8
[optical]
mua = 0.05
musp = 1
[[sources]]
shape = "point"
centre = [1, 0, -1]
power = 2.5
[mesh]
edge = 2
[output]
edge = 1
voxel = 1
"""


def described(tmp_path: Path, text: str) -> PhantomFile:
    (tmp_path / "phantom.toml").write_text(text, encoding="utf-8")
    return PhantomFile.read(tmp_path / "phantom.toml")


def solved_description(tmp_path: Path, text: str) -> Phantom:
    phantom = described(tmp_path, text)
    return phantom.solve().phantom(phantom.surface_edge)


def test_the_papers_phantoms() -> None:
    """Rationale: the files say what the paper says: R 15, H 30, a hole of 1 mm radius 8 mm off the axis."""
    for name, length in (("nylon_cylinder", 1.0), ("nylon_cylinder_6mm", 6.0)):
        phantom = PhantomFile.read(SCENES / f"{name}.toml")
        assert phantom.geometry == CylinderGeometry(15, 30)
        assert phantom.medium == Medium(0.0138, 0.91, 1.37)
        ((source,), power) = phantom.sources, phantom.sources[0].power
        assert isinstance(source.shape, Cylinder)
        assert (source.shape.length, source.shape.radius, power) == (length, 1, 1)
        assert source.shape.centre[:2] == (8, 0)
        assert source.shape.centre[2] - length / 2 == -1.5


def test_the_documented_example(tmp_path: Path) -> None:
    """docs/phantom-file.md has a file with every table, with the defaults as values; its tables say them, too."""
    page = (SCENES.parent / "docs" / "phantom-file.md").read_text(encoding="utf-8")
    phantom = described(tmp_path, page.split("```toml\n", 1)[1].split("```", 1)[0])
    plain = PhantomFile(phantom.geometry, phantom.medium, phantom.sources, phantom.regions, bands=phantom.bands)
    assert phantom == plain
    assert phantom.regions[0].medium == Medium(0.05, 1.2, 1.37)
    assert phantom.bands == {
        "red": Band(0.3, (Medium(0.01, 0.85, 1.37), Medium(0.04, 1.1, 1.37)), (Spread(), Spread()))
    }
    defaults = {name: value for name, value in re.findall(r"^\| `(.*?)` \|.* ([\d.]+) where left out", page, re.M)}
    assert defaults == {
        "n": f"{phantom.medium.n:g}",
        "g": f"{phantom.medium.g:g}",
        "power": f"{phantom.sources[0].power:g}",
        **{name: f"{getattr(Absorbers(), name):g}" for name in ("blood", "water", "fat")},
        "[mesh] edge": f"{PhantomFile.edge:g}",
        "[mesh] order": f"{PhantomFile.order:g}",
        "[output] edge": f"{PhantomFile.surface_edge:g}",
        "[output] voxel": f"{PhantomFile.voxel:g}",
    }


def test_every_key_of_a_phantom_file(tmp_path: Path) -> None:
    """Every kind of source and region, and all that has a default."""
    text = SMALL.replace("musp = 1", 'musp = 1\nn = 1.4\ng = 0.9\nmodel = "diffusion"\na = "haskell"') + (
        '[[sources]]\nshape = "sphere"\ncentre = [0, 0.5, 1]\nradius = 0.5\n'
        '[[sources]]\nshape = "cylinder"\ncentre = [0, 0, 0]\nradius = 0\nlength = 2\naxis = [0, 1, 0]\npower = 3\n'
        '[[regions]]\nshape = "sphere"\ncentre = [-2, 0, 0]\nradius = 2\nmua = 0.1\nmusp = 2\n'
        '[[regions]]\nshape = "cylinder"\ncentre = [0, 0, 3]\nradius = 9\nlength = 2\nmua = 0.2\nmusp = 3\nn = 1.5\n'
    )
    phantom = described(tmp_path, text)
    assert phantom.medium == Medium(0.05, 1, 1.4, 0.9)
    assert (phantom.model, phantom.a) == ("diffusion", "haskell")
    assert phantom.sources == (
        Source(Sphere((1, 0, -1)), 2.5),
        Source(Sphere((0, 0.5, 1), 0.5), 1),
        Source(Cylinder((0, 0, 0), 2, 0, (0, 1, 0)), 3),
    )
    assert phantom.regions == (
        Region(Sphere((-2, 0, 0), 2), Medium(0.1, 2, 1.4, 0.9)),
        Region(Cylinder((0, 0, 3), 2, 9), Medium(0.2, 3, 1.5, 0.9)),
    )
    assert (phantom.edge, phantom.order, phantom.surface_edge, phantom.voxel) == (2, 2, 1, 1)
    mesh = phantom.mesh()
    centroids = mesh.vertices[mesh.cells].mean(axis=1)
    np.testing.assert_array_equal(mesh.region == 2, centroids[:, 2] > 2)
    assert set(mesh.region) == {0, 1, 2}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius = 6", "", r"\[geometry\]: 'radius' is missing"),
        ("radius = 6", "radius = true", "'radius' must be a number, for example 1.5, got True"),
        ("radius = 6", "radius = -6", "'radius' must be > 0"),
        ("radius = 6", "raduis = 6\nradius = 6", r"\[geometry\]: 'raduis' means nothing here"),
        ('shape = "cylinder"', 'shape = "cube"', "'shape' must be one of cylinder, got 'cube'"),
        ("mua = 0.05", "mua = -1", "'mua' must be >= 0"),
        (
            "musp = 1",
            "musp = 1\nmodel = 'diffusion'\na = 'exact'",
            "'a' must be robin, haskell or a number > 0, got 'exact'",
        ),
        (
            "musp = 1",
            "musp = 1\na = 2.5",
            r"\[optical\]: 'a' is of the diffusion equation, got 2.5 beside the model sp3",
        ),
        ("musp = 1", "musp = 1\nmua_sd = 1.5", r"\[optical\]: 'mua_sd' must be in \[0, 1\), got 1.5\. Give a relative"),
        ("musp = 1", "musp = 1\ng = 1", r"'g' must be in \[0, 0.99\], got 1\. Give for example 0.9"),
        ("musp = 1", "musp = 1\nn_sd = -0.1", r"'n_sd' must be in \[0, 1\), got -0.1"),
        ("musp = 1", "musp = 1\nmodel = 'p3'", r"\[optical\]: 'model' must be one of sp3, diffusion, got 'p3'"),
        ("[mesh]", "[mesh]\norder = 2.0", "'order' must be a whole number"),
        ("[mesh]", "[mesh]\norder = 3", "'order' must be 1 or 2, got 3"),
        ("centre = [1, 0, -1]", "centre = [1, 0]", r"\[\[sources\]\] number 1: 'centre' must be three numbers"),
        ("centre = [1, 0, -1]", "centre = [1, 0, 7]", "source 1: .* reaches out of the tissue"),
        ("[output]", "[outptu]", r"'phantom.toml': 'outptu' means nothing here"),
        ("power = 2.5", "power = 0", "'power' must be > 0"),
        ("[mesh]", "[[regions]]\nlabel = 4\nmua = 1\nmusp = 1\n[mesh]", "region 1: no tetrahedron"),
        ("edge = 2", "edge = 20", "must not exceed radius"),
        ("edge = 1\n", "edge = 0\n", "'edge' must be > 0"),
        ("[geometry]", "[geometry", "is no TOML file"),
    ],
)
def test_wrong_descriptions(tmp_path: Path, old: str, new: str, message: str) -> None:
    """One line that names table, key, value and rule."""
    assert old in SMALL
    with pytest.raises(FluxError, match=message) as caught:
        solved_description(tmp_path, SMALL.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_absent_file(tmp_path: Path) -> None:
    with pytest.raises(FluxError, match="cannot be read: No such file"):
        PhantomFile.read(tmp_path / "nothing.toml")


def test_tetrahedra_with_labels_from_a_file(tmp_path: Path) -> None:
    """Rationale: a labelled mesh in cm, written by meshio, is the same phantom as the shape it was labelled by."""
    meshio = pytest.importorskip("meshio")
    mesh = cylinder_tetrahedra(6, 8, 2)
    inside = mesh.inside(Sphere((-2, 0, 0), 2.5))
    labels = np.where(inside, 7, 3)
    meshio.write_points_cells(
        tmp_path / "tissue.vtu", mesh.vertices / 10, [("tetra", mesh.cells)], cell_data={"tissue": [labels]}
    )
    text = SMALL.replace('shape = "cylinder"\nradius = 6\nheight = 8', 'file = "tissue.vtu"\nlength_unit = "cm"')
    region = "[[regions]]\n{}\nmua = 0.3\nmusp = 2\n"
    by_label = text.replace('"cm"', '"cm"\nlabels = "tissue"') + region.format("label = 7")
    by_shape = text + region.format('shape = "sphere"\ncentre = [-2, 0, 0]\nradius = 2.5')
    exited = []
    for description in (text, by_label, by_shape):
        solution = described(tmp_path, description).solve()
        assert solution.balance == pytest.approx(0, abs=1e-5)
        exited.append(solution.solved.exited)
    assert exited[1] == pytest.approx(exited[2], rel=1e-12)
    assert exited[1] < 0.99 * exited[0]
    straight = solve(cylinder_tetrahedra(6, 8, 2), [Medium(0.05, 1)], [Source(Sphere((1, 0, -1)), 2.5)], order=1)
    assert exited[0] == pytest.approx(straight.solved.exited, rel=0.02)
    with pytest.raises(FluxError, match=r"no field 'organ' .* Fields it has: 'tissue'"):
        read_tetrahedra(tmp_path / "tissue.vtu", 2, labels="organ")
    with pytest.raises(FluxError, match="'length_unit' must be one of mm, cm, m, got 'inch'"):
        read_tetrahedra(tmp_path / "tissue.vtu", 2, "inch")


@pytest.mark.parametrize(("radius", "ratio"), [(1.0, 1.38), (3.0, None)])
def test_the_volume_of_a_region_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, radius: float, ratio: float | None
) -> None:
    """A sphere in edges of 2 mm, of whose volume the tetrahedra have 138 %: 0.294 in place of 0.328 W leave by it.

    Seen to fail: without a word. The volume in the mesh is exact to 3 %, half of it for a sphere that sticks out.
    """
    region = f'[[regions]]\nshape = "sphere"\ncentre = [0.5, 0.3, 1.0]\nradius = {radius}\nmua = 1\nmusp = 1\n'
    mesh = described(tmp_path, SMALL + region).mesh()
    exact = 4 / 3 * math.pi * radius**3
    assert mesh.volume_in(Sphere((0.5, 0.3, 1.0), radius)) == pytest.approx(exact, rel=0.03)
    assert mesh.volume_in(Sphere((0.5, 0.3, 4.0), radius)) == pytest.approx(exact / 2, rel=0.03)
    if ratio is None:
        assert not caplog.messages
        return
    assert mesh.volumes[mesh.region == 1].sum() == pytest.approx(ratio * exact, rel=0.01)
    found, stated = (float(text.split()[-1]) for text in caplog.messages[0].split(" mm^3")[:2])
    assert found / stated == pytest.approx(ratio, rel=0.03)


def test_a_region_much_smaller_than_a_tetrahedron(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A sphere of 0.01 mm about the middle of one. Seen to fail: a division by its volume, in which no point fell."""
    mesh = described(tmp_path, SMALL).mesh()
    centre = mesh.vertices[mesh.cells[0]].mean(axis=0).tolist()
    region = f'[[regions]]\nshape = "sphere"\ncentre = {centre}\nradius = 0.01\nmua = 1\nmusp = 1\n'
    assert np.count_nonzero(described(tmp_path, SMALL + region).mesh().region) == 1
    assert "its shape in the tissue about 0 mm^3" in caplog.messages[0]


def test_parts_that_are_not_joined_are_refused(tmp_path: Path) -> None:
    """Halves of a cylinder with nodes of their own at z = 0. Seen to fail: no light passed between them, 0.56 in place
    of 0.39 W left, for which the edges were blamed; the import had the power of the faces inside as well, 0.74 in place
    of 0.52 W, without a word.
    """
    mesh = cylinder_tetrahedra(6, 8, 2)
    above = mesh.vertices[mesh.cells].mean(axis=1)[:, 2] > 0
    cells = mesh.cells + len(mesh.vertices) * above[:, None]
    np.savez(tmp_path / "halves.npz", vertices=np.tile(mesh.vertices, (2, 1)), tetrahedra=cells)
    inside = int(
        (np.abs(mesh.vertices[boundary(mesh.vertices, mesh.cells[above])[0]][..., 2]) < 1e-9).all(axis=1).sum()
    )
    with pytest.raises(FluxError, match=rf"geometry: halves.npz: {inside} border faces of tetrahedra lie on others"):
        read_tetrahedra(tmp_path / "halves.npz", 2)
    with pytest.raises(FluxError, match=rf"halves.npz.*: {inside} border faces of tetrahedra lie on others"):
        import_flux(tmp_path / "halves.npz", np.full(2 * len(mesh.vertices), 1e-3))


def test_the_unit_of_a_mesh_is_checked(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A body of 18.8 mm in a file in cm, without its unit. Seen to fail: its exit power was that of 1.6 mm, 0.95 in
    place of 0.19 W of a larger one, without a word; of a name with the unit, too.
    """
    mesh = cylinder_tetrahedra(6, 8, 4)
    for name in ("vertices", "vertices_cm"):
        np.savez(tmp_path / f"{name}.npz", **{name: 0.1 * mesh.vertices}, tetrahedra=mesh.cells)
    found = read_tetrahedra(tmp_path / "vertices.npz", 4)
    assert np.ptp(found.vertices[:, 2]) == pytest.approx(0.8)
    assert 'and 18.8 mm if it is cm. If that is right give length_unit = "cm".' in caplog.messages[0]
    with pytest.raises(FluxError, match=r"vertices_cm.npz: its vertices are in 'cm' .* Give length_unit = \"cm\""):
        read_tetrahedra(tmp_path / "vertices_cm.npz", 4)
    caplog.clear()
    assert np.ptp(read_tetrahedra(tmp_path / "vertices_cm.npz", 4, "cm").vertices[:, 2]) == pytest.approx(8)
    assert not caplog.messages
    surface = trimesh.Trimesh(mesh.vertices / 1e3, boundary(mesh.vertices, mesh.cells)[0])
    surface.export(tmp_path / "body.glb")
    with pytest.raises(FluxError, match="it has no labels 'organ'"):
        read_tetrahedra(tmp_path / "body.glb", 4, labels="organ")
    assert not caplog.messages  # metres, by the standard


@pytest.mark.parametrize(("given", "told"), [("edge = 0.5", 1), ("edge = 2.5", 0), ("order = 1", 0)])
def test_an_edge_that_tetrahedra_of_a_file_do_not_have_is_told(
    given: str, told: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Seen to fail: the edge had no effect, without a word."""
    mesh = cylinder_tetrahedra(6, 8, 3)
    np.savez(tmp_path / "tissue.npz", vertices=mesh.vertices, tetrahedra=mesh.cells)
    text = '[geometry]\nfile = "tissue.npz"\n[optical]\nmua = 0.05\nmusp = 1.0\n'
    (tmp_path / "p.toml").write_text(f"{text}[mesh]\n{given}\n")
    assert PhantomFile.read(tmp_path / "p.toml").mesh().edge == pytest.approx(mesh.edge)
    assert caplog.text.count("holds tetrahedra with edges of 3.24 mm, on which [mesh] edge = 0.5 has no effect") == told


def test_the_border_of_tetrahedra_from_a_file_is_smooth(tmp_path: Path) -> None:
    """Rationale: tetrahedra of a sphere, a source in its middle: J_n is that of the sphere and equal everywhere.

    Expected behaviour: the exact total of diffusion within 0.05 %, ripple below 0.2 %. With plane facets it was 0.6 %
    and 4 %, under SP3, whose flow along the border has second derivatives, 65 %.
    """
    skfem = pytest.importorskip("skfem")
    radius, mua, musp = 6.0, 0.02, 1.0
    ball = skfem.MeshTet.init_ball(3)
    np.savez(tmp_path / "ball.npz", vertices=radius * ball.p.T, tetrahedra=ball.t.T)
    solution = solve(
        read_tetrahedra(tmp_path / "ball.npz", 2), [Medium(mua, musp)], [Source(Sphere((0, 0, 0)))], model="diffusion"
    )
    d = 1 / (3 * (mua + musp))
    k, robin = math.sqrt(mua / d), 1 / (2 * boundary_a("robin", 1.37))
    free = math.exp(-k * radius) / radius, -math.exp(-k * radius) * (k * radius + 1) / radius**2  # φ/φ_0 and its slope
    bound = math.sinh(k * radius) / radius, (k * radius * math.cosh(k * radius) - math.sinh(k * radius)) / radius**2
    share = -(robin * free[0] + d * free[1]) / (robin * bound[0] + d * bound[1])
    exact = robin * (free[0] + share * bound[0]) / d * radius**2
    assert exact == pytest.approx(0.6008, abs=1e-4)
    assert solution.solved.exited == pytest.approx(exact, rel=5e-4)
    exitance = solution.phantom(0.7).exitance
    assert np.ptp(exitance) / exitance.mean() < 2e-3


def test_surface_without_a_mesher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing mesher is named with its extra; an open surface is refused before it is asked for."""
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    ball = trimesh.creation.icosphere(2, 6.0)
    ball.export(tmp_path / "ball.ply")
    with pytest.raises(BackendError, match=r"pip install 'mitsuba-fspt\[mesher\]'"):
        read_tetrahedra(tmp_path / "ball.ply", 2)
    with pytest.raises(FluxError, match="not closed"):
        tetrahedralize(ball.vertices, ball.faces[1:], 2)
    with pytest.raises(FluxError, match="it has no labels 'organ'"):
        read_tetrahedra(tmp_path / "ball.ply", 2, labels="organ")


def test_surface_through_the_mesher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: the mesher fills a sphere, and curved elements on its surface give the exact total from its middle.

    Expected behaviour: within 0.1 %, ripple below 0.5 %. Seen to fail with the border left where the mesher put it
    (0.5 % of the total).
    """
    pytest.importorskip("pytetwild")
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(5, 10.0)
    mesh = tetrahedralize(ball.vertices, ball.faces, 3)
    solution = solve(mesh, [Medium(0.0138, 0.91)], [Source(Sphere((0, 0, 0)))], model="diffusion")
    assert not list(tmp_path.iterdir())
    assert solution.solved.exited == pytest.approx(0.47367, rel=1e-3)
    phantom = solution.phantom(0.7)
    assert phantom.closure.watertight
    assert phantom.closure.outward
    assert np.ptp(phantom.exitance) / phantom.exitance.mean() < 5e-3


def test_scikit_fem_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(BackendError, match=r"scikit-fem .* pip install 'mitsuba-fspt\[tissue\]'"):
        solve(cylinder_tetrahedra(6, 8, 2), [Medium(0.05, 1)], [Source(Sphere((1, 0, -1)))])


def test_flux_solve(tmp_path: Path) -> None:
    """Rationale: the command writes surface and volume and reports the balance as one JSON object."""
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    ply, vol = tmp_path / "small.ply", tmp_path / "small.vol"
    command = ["solve", str(tmp_path / "small.toml"), "-o", str(ply), "--volume", str(vol)]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["source_power"] == 2.5
    assert report["absorbed_power"] + report["exit_power"] == pytest.approx(2.5, rel=1e-5)
    assert report["exit_fraction"] == pytest.approx(report["power"] / 2.5)
    assert report["volume_low"] == [-7, -7, -5]
    assert report["volume_voxels"] == [14, 14, 10]
    assert report["watertight"] is True
    phantom = Phantom.read(ply)
    assert phantom.power == pytest.approx(report["exit_power"], rel=1e-12)
    assert len(phantom.vertices) == report["vertices"]
    assert vol.stat().st_size == 48 + 4 * 14 * 14 * 10
    table = CliRunner().invoke(app, command)
    assert "balance" in table.stdout
    assert "exit fraction" in table.stdout


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("edge = 1\n", "edge = 1e-3\n", r"surface: edges of 0.001 mm make .*e\+09 triangles, at most 1e\+07 can be"),
        (
            "edge = 1\n",
            "edge = 1e-300\n",
            r"surface: edges of 1e-300 mm make inf triangles.* Give an edge above 0\.\d+ mm",
        ),
        ("edge = 2\n", "edge = 1e-3\n", r"geometry: mesh edges of 0.001 mm make about 5.18e\+12 tetrahedra"),
        ("edge = 2\n", "edge = 1e-300\n", r"geometry: .* about inf tetrahedra.* Give an edge above 0\.1 mm"),
    ],
)
def test_a_mesh_too_large_for_the_memory_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, message: str
) -> None:
    """Rationale: the process was killed for its memory after a minute, without a word."""
    monkeypatch.setattr(phantom_file, "solve", None)
    assert old in SMALL
    with pytest.raises(FluxError, match=message):
        described(tmp_path, SMALL.replace(old, new)).solve()


def test_a_filling_too_large_for_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cube of 1 mm³ has 8.5 regular tetrahedra of 1 mm. The mesher is not asked."""
    monkeypatch.setitem(sys.modules, "pytetwild", object())
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    with pytest.raises(
        FluxError, match=r"edges of 0.005 mm make about 6.79e\+07 tetrahedra.* Give an edge above 0.012 mm"
    ):
        tetrahedralize(np.array(cube.vertices), np.array(cube.faces), 0.005)


def test_flux_solve_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.replace("[1, 0, -1]", "[9, 0, -1]"), encoding="utf-8")
    result = CliRunner().invoke(app, ["solve", str(tmp_path / "small.toml"), "-o", str(tmp_path / "small.ply")])
    assert isinstance(result.exception, FluxError)
    assert [file.name for file in tmp_path.iterdir()] == ["small.toml"]


def test_flux_solve_writes_both_files_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Phantom, path: Path) -> None:
        raise FluxError("the disk is full")

    monkeypatch.setattr(Phantom, "write", fail)
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    description, ply, vol = (str(tmp_path / name) for name in ("small.toml", "small.ply", "small.vol"))
    result = CliRunner().invoke(app, ["solve", description, "-o", ply, "--volume", vol])
    assert isinstance(result.exception, FluxError)
    assert [file.name for file in tmp_path.iterdir()] == ["small.toml"]


BANDS = """
[[regions]]
shape = "sphere"
centre = [-3, 0, 0]
radius = 2
mua = 0.3
musp = 1
[bands.red]
share = 0.25
mua = 0.01
musp = 0.9
n = 1.4
[[bands.red.regions]]
mua = 0.2
musp = 0.8
"""


def test_bands(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A band has its own media, in the order of the regions, and its share of the sources' power; none is told."""
    phantom = described(tmp_path, SMALL.replace("musp = 1\n", "musp = 1\ng = 0.8\n", 1) + BANDS)
    assert phantom.band("red").media == (Medium(0.01, 0.9, 1.4, 0.8), Medium(0.2, 0.8, 1.37, 0.8))
    assert phantom.band(None).media == (Medium(0.05, 1, 1.37, 0.8), Medium(0.3, 1, 1.37, 0.8))
    assert phantom.solve(band="red").source_power == pytest.approx(0.25 * 2.5)
    assert not caplog.messages
    assert phantom.solve().source_power == pytest.approx(2.5)
    assert ["no band is given, of the phantom file's red" in text for text in caplog.messages] == [True]


def test_spreads(tmp_path: Path) -> None:
    """Regions and bands have the relative sd of [optical] unless they name others; no band has those of [optical]."""
    text = SMALL.replace("musp = 1\n", "musp = 1\nmua_sd = 0.1\nn_sd = 0.01\n", 1) + BANDS.replace(
        "mua = 0.01", "mua = 0.01\nmusp_sd = 0.2\nmua_sd = 0"
    ).replace("mua = 0.3", "mua = 0.3\nmua_sd = 0.3")
    phantom = described(tmp_path, text)
    assert phantom.band(None).spreads == (Spread(0.1, 0, 0.01), Spread(0.3, 0, 0.01))
    assert phantom.band("red").spreads == (Spread(0, 0.2, 0.01), Spread(0.3, 0, 0.01))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("share = 0.25", "share = 0", r"'share' must be in \(0, 1\], got 0"),
        ("share = 0.25", "", "'share' is missing"),
        ("[[bands.red.regions]]\nmua = 0.2\nmusp = 0.8\n", "", "0 tables .* for 1"),
        ("n = 1.4", "N = 1.4", "'N' means nothing here"),
        ("mua = 0.01", "mua = -1", r"\[bands\] \[red\]: .*mua"),
        ("[bands.red]", "[bands.red]\nregion = 3", "'region' means nothing here"),
    ],
)
def test_bad_bands(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in BANDS
    with pytest.raises(FluxError, match=words):
        described(tmp_path, SMALL + BANDS.replace(old, new))


def test_vertices_of_no_tetrahedron_are_left_out(tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    mesh = cylinder_tetrahedra(6, 8, 2)
    points = np.concatenate([[[9.0, 9, 9]], mesh.vertices])
    meshio.Mesh(points, [("tetra", mesh.cells + 1)]).write(tmp_path / "body.vtu")
    found = read_tetrahedra(tmp_path / "body.vtu", 2)
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(np.sort(found.cells, axis=1), np.sort(mesh.cells, axis=1))


@pytest.mark.parametrize("body", [trimesh.creation.box((2, 3, 4)), trimesh.creation.cylinder(5.0, 8.0, sections=8)])
def test_flat_sharp_edged_tetrahedra_of_a_file_stay_flat(tmp_path: Path, body: trimesh.Trimesh) -> None:
    """Rationale: edges of 90° and of 45° are sharp, however the file rounds vertices; a box and an octagonal prism.

    Expected: each point of a face stays. Seen to fail where 45° was smooth: the prism was bent by 0.3 mm.
    """
    meshio = pytest.importorskip("meshio")
    points = np.concatenate([body.vertices, [body.center_mass]]).astype(np.float32)
    cells = np.column_stack([body.faces, np.full(len(body.faces), len(body.vertices))])
    meshio.Mesh(points, [("tetra", cells)]).write(tmp_path / "body.vtu")
    mesh = read_tetrahedra(tmp_path / "body.vtu", 2)
    assert mesh.snap is not None
    on = np.concatenate([body.triangles.mean(axis=1), body.triangles[:, :2].mean(axis=1)])  # middles of faces and edges
    np.testing.assert_allclose(mesh.snap(on), on, atol=5e-6)
