"""The phantom: what its PLY holds, for Mitsuba and for reading again, and what a phantom cannot be."""

import numpy as np
import pytest
import trimesh

from mitsuba_fspt.phantom.formats.ply import write_ply
from mitsuba_fspt.phantom.phantom import Phantom
from mitsuba_fspt.runtime.errors import ExitanceError, FluxError

SPHERE = trimesh.creation.icosphere(subdivisions=1, radius=2.0)
VERTICES, FACES = np.array(SPHERE.vertices), np.array(SPHERE.faces)


def phantom(per="vertex", **changes):
    """Sphere with values that no single-precision number holds exactly, over nine decades, some of them 0."""
    count = len(VERTICES if per == "vertex" else FACES)
    exitance = np.logspace(-12, -3, count) / 3
    exitance[::7] = 0
    return Phantom(**{"vertices": VERTICES, "faces": FACES, "exitance": exitance, "per": per} | changes)


@pytest.mark.parametrize("per", ["vertex", "face"])
def test_ply_comes_back_bit_by_bit(tmp_path, per):
    provenance = {"source": "Mäuse,\n2 of them", "boundary_factor": "2.57 (robin, n = 1.37)"}
    written = phantom(per, provenance=provenance, negatives=3, removed_power=1.25e-7)
    written.write(tmp_path / "p.ply")
    read = Phantom.read(tmp_path / "p.ply")
    for name in ("vertices", "faces", "exitance"):
        assert np.array_equal(getattr(read, name), getattr(written, name))
    assert read.per == per
    assert read.provenance["boundary_factor"] == "2.57 (robin, n = 1.37)"
    assert read.provenance["source"] == "Mäuse, 2 of them"
    assert read.report() | {"source": ""} == written.report() | {"source": ""}
    header = (tmp_path / "p.ply").read_bytes().split(b"end_header")[0].decode("utf-8")
    for line in ("quantity exitance", "unit W/mm^2", "length_unit mm", f"power {written.power!r} W"):
        assert f"comment {line}\n" in header
    assert "comment source Mäuse, 2 of them\n" in header


@pytest.mark.parametrize("per", ["vertex", "face"])
def test_mitsuba_finds_the_exitance(mono, tmp_path, per):
    """The attribute is there under its name and holds each value, rounded to single precision once."""
    written = phantom(per, provenance={"source": "Mäuse"})
    written.write(tmp_path / "p.ply")
    mesh = mono.load_dict({"type": "ply", "filename": str(tmp_path / "p.ply")})
    parameters = mono.traverse(mesh)
    assert np.array_equal(np.array(parameters[f"{per}_exitance"]), written.exitance.astype(np.float32))
    assert np.array_equal(np.array(parameters["faces"]).reshape(-1, 3), FACES)
    assert np.array_equal(np.array(parameters["vertex_positions"]).reshape(-1, 3), VERTICES.astype(np.float32))


@pytest.mark.parametrize(("name", "attribute"), [("jn_x", "jn"), ("Jn_0", "Jn"), ("my_jn_1", "my_jn")])
@pytest.mark.parametrize("per", ["vertex", "face"])
def test_other_names_that_mitsuba_reads(mono, tmp_path, per, name, attribute):
    """The attribute of that name is what Mitsuba finds in the same file."""
    written = phantom(per)
    write_ply(tmp_path / "p.ply", VERTICES, FACES, {name: written.exitance}, per, {})
    read = Phantom.read(tmp_path / "p.ply")
    assert (read.attribute, read.per) == (attribute, per)
    assert np.array_equal(read.exitance, written.exitance)
    parameters = mono.traverse(mono.load_dict({"type": "ply", "filename": str(tmp_path / "p.ply")}))
    assert len(np.array(parameters[f"{per}_{attribute}"])) == len(written.exitance)


@pytest.mark.parametrize("names", [("jn",), ("exitance",), ("jn_x", "phi_x"), ("jn_y",), ()])
def test_ambiguous_names(tmp_path, names):
    values = phantom().exitance
    write_ply(tmp_path / "p.ply", VERTICES, FACES, dict.fromkeys(names, values), "vertex", {})
    listed = ", ".join(f"'{name}' on vertices" for name in names) or "none"
    with pytest.raises(ExitanceError, match=rf"It has: {listed}\. Make a phantom of it by fspt flux import --field"):
        Phantom.read(tmp_path / "p.ply")


def test_the_own_name_goes_before_others(tmp_path):
    values = phantom().exitance
    write_ply(tmp_path / "p.ply", VERTICES, FACES, {"jn_x": 2 * values, "exitance_x": values}, "vertex", {})
    read = Phantom.read(tmp_path / "p.ply")
    assert read.attribute == "exitance"
    assert np.array_equal(read.exitance, values)


def test_a_dark_phantom_is_written_and_read(tmp_path):
    """J_n = 0 everywhere is a control measurement; seen to be refused."""
    dark = phantom(exitance=np.zeros(42))
    assert (dark.power, dark.report()["removed_percent"]) == (0, 0)
    dark.write(tmp_path / "p.ply")
    assert not Phantom.read(tmp_path / "p.ply").exitance.any()


def test_power_of_a_sphere():
    """J_n A for uniform J_n; the sphere of triangles is a little smaller than 16π mm²."""
    for per, count in (("vertex", 42), ("face", 80)):
        uniform = phantom(per, exitance=np.full(count, 0.25))
        assert uniform.power == pytest.approx(0.25 * SPHERE.area, rel=1e-12)
        assert uniform.area == pytest.approx(16 * np.pi, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"exitance": np.ones(5)}, FluxError, r"must fit, got shapes \(42, 3\), \(80, 3\) and \(5,\)"),
        ({"exitance": np.full(42, np.nan)}, ExitanceError, r"42 of 42 values are NaN or inf"),
        ({"exitance": np.ma.masked_all(42)}, FluxError, "'exitance' is a masked array that hides 42 values. Fill it"),
        ({"exitance": np.full(42, -1.0)}, ExitanceError, r"must be >= 0, the least is -1 W/mm\^2"),
        ({"per": "edge"}, FluxError, r"'per' must be vertex or face, got 'edge'"),
        ({"faces": FACES + 1}, FluxError, r"numbers of the 42 vertices"),
        ({"faces": FACES[:0]}, FluxError, r"numbers of the 42 vertices"),
        ({"vertices": VERTICES * 0}, FluxError, r"no area"),
        ({"provenance": {"power": "1 W"}}, FluxError, r"'power' is taken"),
        ({"provenance": {"two words": "x"}}, FluxError, r"'two words' is taken or no single word"),
    ],
)
def test_invalid_phantoms(changes, error, message):
    with pytest.raises(error, match=message):
        phantom(**changes)


def test_arrays_of_a_phantom_are_its_own():
    """Seen to fail: 0 W after the caller used an array again."""
    exitance = np.ones(42)
    found = phantom(exitance=exitance)
    exitance[:] = 0
    assert found.power == pytest.approx(found.area)


@pytest.mark.parametrize("name", ["p.obj", "missing/p.ply"])
def test_refused_output_leaves_nothing(tmp_path, name):
    with pytest.raises(FluxError, match="output file"):
        phantom().write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_ply_of_another_kind_is_refused(tmp_path):
    mesh = SPHERE.copy()
    mesh.vertex_attributes["jn"] = np.ones(42)
    mesh.export(tmp_path / "mesh.ply")
    with pytest.raises(ExitanceError, match=r"'exitance_x'.* It has: 'jn' on vertices.* fspt flux import"):
        Phantom.read(tmp_path / "mesh.ply")
    phantom().write(tmp_path / "p.ply")
    other = (tmp_path / "p.ply").read_bytes().replace(b"comment unit W/mm^2", b"comment unit W/cm^2")
    (tmp_path / "p.ply").write_bytes(other)
    with pytest.raises(FluxError, match=r"the unit of a phantom must be W/mm\^2"):
        Phantom.read(tmp_path / "p.ply")


@pytest.mark.parametrize(
    ("comment", "taken"),
    [("mm; jn in 1/mm^2 per unit source power", True), ("W/cm^2", False), ("m", False), ("W/mm^2", True)],
)
def test_units_in_the_comments_of_others(tmp_path, comment, taken):
    """Free text with a length other than mm is refused: J_n would be wrong by a factor of 100 without a word."""
    write_ply(tmp_path / "p.ply", VERTICES, FACES, {"jn_x": phantom().exitance}, "vertex", {"unit": comment})
    if taken:
        assert Phantom.read(tmp_path / "p.ply").power == phantom().power
    else:
        with pytest.raises(FluxError, match=r"the unit of a phantom must be W/mm\^2, got '"):
            Phantom.read(tmp_path / "p.ply")


@pytest.mark.parametrize(("name", "what"), [("gone.ply", "there is no such file"), ("", "it is a folder")])
def test_no_file_to_read(tmp_path, name, what):
    """Rationale: the loader's words were that the file is damaged."""
    with pytest.raises(FluxError, match=rf"cannot be read: {what}\. Check the name\."):
        Phantom.read(tmp_path / name)
