"""`fspt locate`, `fspt flux solve --band`: files, JSON, bands, and bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from cylinder_views import cylinder_views, exact, tetrahedra_made_once

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.reduction import read_measured
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.tissue.phantom_file import PhantomFile

pytest.importorskip("skfem")
SOURCE = (2.5, 1.0, -1.0, 2e-12)  # x, y, z [mm], power [W]
CCD = fspt.Detector.typical_ccd()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, mono):
    """cylinder.toml, T.npz, and exposures of four views in the bands red and green."""
    folder = tmp_path_factory.mktemp("cylinder")
    matrix = cylinder_views(folder)
    matrix.save(folder / "T.npz")
    vertices = Surface.of(matrix).vertices
    for band in ("red", "green"):
        for k, plane in enumerate(matrix.forward(exact(vertices, [SOURCE], band))):
            exposure = CCD.expose(fspt.Image(plane, metadata={"pixel_pitch": 0.5}), 60, 650, seed=k)
            exposure.write(folder / f"{band}_{k}.exr")
    with tetrahedra_made_once():
        yield folder


def names(band):
    return [f"{band}_{k}.exr" for k in range(4)]


def test_sources_in_one_band_and_in_two(run, folder, monkeypatch):
    """The intervals hold the source, as JSON; as text a line a source; the tetrahedra are written."""
    monkeypatch.chdir(folder)
    red, green = (["T.npz", *names(band)] for band in ("red", "green"))
    arguments = ("locate", "cylinder.toml", *red, *green, "--band", "red", "--band", "green", "--confidence", 0.999)
    arguments += ("--band-correlation", 1)
    code, out, err = run(*arguments, "-o", "source.vtu", "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    (source,) = record["sources"]
    low, high = (np.array(end) for end in source["position_interval"])
    assert (low < SOURCE[:3]).all()
    assert (SOURCE[:3] < high).all()
    assert source["power_interval"][0] < SOURCE[3] < source["power_interval"][1]
    assert (high - low).max() < 1
    assert (folder / record["output"]).stat().st_size > 5_000
    (folder / "source.vtu").unlink()
    code, out, err = run("locate", "cylinder.toml", *red, "--band", "red", "--shape", "sphere")
    assert (code, err) == (0, "")
    assert out.startswith("source 1: x 2.")
    assert ", radius at most 3." in out or ", radius at most 2." in out
    assert "90 % intervals; chi2" in out
    assert run("locate", "cylinder.toml", *red, "--band", "red", "--quiet") == (0, "", "")


def test_the_output_is_none_of_the_inputs(run, folder, monkeypatch):
    """The mesh file that the phantom file names is kept, too."""
    meshio = pytest.importorskip("meshio")
    monkeypatch.chdir(folder)
    mesh = PhantomFile.read("cylinder.toml").mesh()
    meshio.Mesh(mesh.vertices, [("tetra", mesh.cells)]).write("body.vtu")
    text = (folder / "cylinder.toml").read_text()
    old = text[: text.index("[optical]")]
    (folder / "meshed.toml").write_text(text.replace(old, '[geometry]\nfile = "body.vtu"\n'))
    before = (folder / "body.vtu").read_bytes()
    code, out, err = run("locate", "meshed.toml", "T.npz", *names("red"), "-o", "body.vtu")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert (folder / "body.vtu").read_bytes() == before


def test_images_as_npz(run, folder, monkeypatch):
    """A file is a matrix by its content, not by its name."""
    monkeypatch.chdir(folder)
    for k, name in enumerate(names("red")):
        read_measured(name).write(f"red_{k}.npz")
    records = [
        run("locate", "cylinder.toml", "T.npz", *files, "--band", "red", "--json")
        for files in (names("red"), [f"red_{k}.npz" for k in range(4)])
    ]
    assert [code for code, _, _ in records] == [0, 0]
    one, other = (json.loads(out)["sources"][0]["position"] for _, out, _ in records)
    np.testing.assert_allclose(one, other, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("cylinder.toml", "T.npz", *names("red"), "-o", "x.ply"), "must end in .vtu"),
        (("cylinder.toml", "T.npz", "red_0.exr"), "1 images for 4 views"),
        (("cylinder.toml", "T.npz", *names("red"), "T.npz", *names("green")), "2 transport matrices"),
        (("cylinder.toml", "T.npz", *names("red"), "--band", "blue"), "band 'blue'"),
        (("cylinder.toml", "T.npz", *names("red"), "--sources", 0), "'sources'"),
        (("cylinder.toml", "T.npz", *names("red"), "--shape", "cube"), "'shape' must be one of point, sphere"),
        (("cylinder.toml", "T.npz", *names("red"), "--band-correlation", 2), "'band_correlation' must be in [0, 1]"),
        (("none.toml", "T.npz", *names("red")), "none.toml"),
        (("cylinder.toml", "none.npz", *names("red")), "does not exist"),
        (("cylinder.xml", "T.npz", *names("red")), "cylinder.xml"),
    ],
)
def test_bad_input(run, folder, monkeypatch, arguments, words):
    """Exit code 2, one line that says what is wrong, and no file."""
    monkeypatch.chdir(folder)
    before = sorted(path.name for path in folder.iterdir())
    code, out, err = run("locate", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_phantom_solved_in_a_band(run, folder, monkeypatch):
    """`flux solve --band`: the share of the power, and what leaves by the band's coefficients."""
    monkeypatch.chdir(folder)
    records = {}
    for band in ("red", "green"):
        code, out, _ = run("flux", "solve", "cylinder.toml", "-o", "band.ply", "--band", band, "--json")
        assert code == 0
        records[band] = json.loads(out)
    (folder / "band.ply").unlink()
    assert records["red"]["source_power"] == pytest.approx(0.6)
    assert records["green"]["source_power"] == pytest.approx(0.3)
    assert records["green"]["exit_fraction"] < 0.7 * records["red"]["exit_fraction"]
    code, out, err = run("flux", "solve", "cylinder.toml", "-o", "band.ply", "--band", "blue")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "The bands are red, green" in err
