"""Sweeps: every point its image, none rendered twice, the same bits however the work is shared out."""

from __future__ import annotations

import csv
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from begun_workers import begin_held, end_at_once, hold_all_but_the_first_point
from small_scenes import BALL_XML, LENS_XML, write_ply, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.cli.options import several
from mitsuba_fspt.images import picture
from mitsuba_fspt.rendering import live_scene
from mitsuba_fspt.rendering.scene_source import SceneSource
from mitsuba_fspt.runtime import workers
from mitsuba_fspt.runtime.errors import BackendError, ImageError, SceneError
from mitsuba_fspt.studies import sweep, sweep_workers
from mitsuba_fspt.studies.point_renderer import PointRenderer
from mitsuba_fspt.studies.sweep import write_contact_sheet

F_NUMBERS, DISTANCES = ("2.8", "8"), ("165", "175")
VALUES = {"f_number": F_NUMBERS, "distance": DISTANCES}
NAMES = [f"s_f_number={f}_distance={d}.exr" for f, d in product(F_NUMBERS, DISTANCES)]
DEFINE = ["-D", "f_number=2.8,8", "-D", "distance=165,175"]
PLY_XML = """
    <shape type="ply">
        <string name="filename" value="{name}"/>
        <emitter type="fspt_surface">
            <texture type="mesh_attribute" name="exitance"><string name="name" value="vertex_exitance"/></texture>
        </emitter>
    </shape>"""


@pytest.fixture(autouse=True)
def scene(tmp_path, monkeypatch):
    """A sphere before a lens of 8 × 6 pixels in a folder of its own, with the parameters f_number and distance."""
    monkeypatch.chdir(tmp_path)
    return write_scene(tmp_path / "s.xml", integrator='<integrator type="fspt_integral"/>').relative_to(tmp_path)


@pytest.fixture
def calls(monkeypatch):
    """Points rendered and scenes loaded in this process, by label and parameters."""
    rendered, loaded = [], []
    image, load = PointRenderer.image, live_scene.load_source

    def counting_image(self, point):
        rendered.append(point.label)
        return image(self, point)

    def counting_load(source):
        loaded.append(source.given)
        return load(source)

    monkeypatch.setattr(PointRenderer, "image", counting_image)
    monkeypatch.setattr(live_scene, "load_source", counting_load)
    return rendered, loaded


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Images of all points, one scene loaded for each, by file name."""
    path = write_scene(tmp_path_factory.mktemp("serial") / "s.xml")
    pairs = product(F_NUMBERS, DISTANCES)
    return {
        name: fspt.render(fspt.load(path, f_number=f, distance=d)) for name, (f, d) in zip(NAMES, pairs, strict=True)
    }


def assert_same_bits(folder, images):
    for name, image in images.items():
        found = fspt.read(folder / name)
        for plane in ("power", "error", "coverage"):
            expected = getattr(image, plane).astype(np.float32)
            np.testing.assert_array_equal(getattr(found, plane), expected, err_msg=f"{name} {plane}")
        assert image.power.max() > 0


def index_without_times(folder):
    with (folder / "index.csv").open(newline="") as file:
        return [{column: row[column] for column in row if column != "wall_time"} for row in csv.DictReader(file)]


# --- what comes out ---


def test_every_combination_becomes_an_image_and_a_row(run, tmp_path):
    code, out, err = run("sweep", "s.xml", *DEFINE)
    assert (code, err) == (0, "")
    assert re.match(r"s_sweep/index\.csv: 4 points, 4 rendered in \S+ s, 0 reused\n", out)
    assert out.endswith("s_sweep/contact_sheet.png: all of them as pictures\n")
    folder = tmp_path / "s_sweep"
    assert sorted(os.listdir(folder)) == sorted([*NAMES, "index.csv", "contact_sheet.png"])
    with (folder / "index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["f_number", "distance", "file", "power", "peak", "largest_error", "wall_time"]
    assert [(row["f_number"], row["distance"]) for row in rows] == list(product(F_NUMBERS, DISTANCES))
    assert [row["file"] for row in rows] == NAMES
    for row in rows:
        image = fspt.read(folder / row["file"])
        assert float(row["power"]) == pytest.approx(image.power.sum(dtype=np.float64), rel=1e-12)
        assert float(row["peak"]) == image.power.max() > 0
        assert float(row["largest_error"]) == image.error.max() > 0
        assert float(row["wall_time"]) == image.metadata["wall_time"] > 0
    assert float(rows[0]["power"]) > 4 * float(rows[2]["power"])  # the stop, not the distance, is its column


def test_one_load_and_the_bits_of_scenes_loaded_one_by_one(scene, tmp_path, calls, serial):
    """Rationale: f-number and pose of the lens are changed in place; neither may change the last bit."""
    rows = fspt.sweep(scene, VALUES, "o")
    _, loaded = calls
    assert loaded == [{"f_number": F_NUMBERS[0], "distance": DISTANCES[0]}]
    assert [row.file.name for row in rows] == NAMES
    assert_same_bits(tmp_path / "o", serial)
    for name, image in serial.items():
        told, found = dict(image.metadata), dict(fspt.read(tmp_path / "o" / name).metadata)
        assert len(found.pop("fingerprint")) == 64
        told["scene"] = "s.xml " + told["scene"].split(" ", 1)[1]
        assert found.pop("wall_time") > 0
        del told["wall_time"]
        assert found == told


def test_values_are_numbers_arrays_text_or_one_alone(scene):
    rows = fspt.sweep(scene, {"f_number": np.array([4.0, 5.6]), "distance": np.array(170)}, "o")
    assert [row.parameters for row in rows] == [{"f_number": f, "distance": 170} for f in (4.0, 5.6)]
    assert [type(value) for value in rows[0].parameters.values()] == [float, int]
    assert [row["f_number"] for row in index_without_times(Path("o"))] == ["4.0", "5.6"]  # the texts as given
    assert rows[1].file.name == "s_f_number=5.6_distance=170.exr"


def test_values_that_no_file_name_can_contain_stay_apart(tmp_path):
    shapes = '<default name="note" value=""/>' + BALL_XML.replace("<shape", '<shape id="$note"')
    path = write_scene(tmp_path / "m.xml", shapes=shapes)
    rows = fspt.sweep(path, {"note": ["a/b", "a-b"]}, "o")
    assert [row.parameters["note"] for row in rows] == ["a/b", "a-b"]
    assert rows[0].file.name.startswith("m_note=a-b-")
    assert rows[1].file.name == "m_note=a-b.exr"
    assert rows[0].peak == rows[1].peak > 0


def test_names_that_are_too_long_are_cut_and_stay_apart(tmp_path):
    """Nine values of 60 letters: more than a file name holds. Seen to fail with an OSError."""
    letters = "abcdefghi"
    more = "".join(f'<default name="{name}" value=""/>' for name in letters)
    shapes = BALL_XML.replace("<shape", f'<shape id="{"".join(f"${name}" for name in letters)}"')
    path = write_scene(tmp_path / "m.xml", shapes=more + shapes)
    values = {name: 30 * "é" for name in letters} | {"i": ["x", "y"]}
    rows = fspt.sweep(path, values, "o")
    names = [row.file.name for row in rows]
    assert len(set(names)) == 2
    assert all(name.startswith("m_a=éé") and len(os.fsencode(name)) <= 255 for name in names)
    assert sorted(os.listdir("o")) == sorted([*names, "index.csv"])
    assert fspt.sweep(path, values, "o") == rows


def test_the_contact_sheet_shows_all_on_one_scale(scene, monkeypatch):
    rows = fspt.sweep(scene, VALUES, "o")
    figures = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: figures.append(figure))
    write_contact_sheet(rows, "sheet.png")
    axes, bar = figures[0].axes
    (shown,) = axes.images
    scale, unit = picture.scale_and_unit(np.array([max(row.peak for row in rows)]))
    assert bar.get_ylabel() == f"power [{unit}]"
    assert "W/pixel" in unit
    assert shown.get_clim() == pytest.approx((0, max(row.peak for row in rows) / scale))
    assert np.nansum(shown.get_array().filled(0)) * scale == pytest.approx(sum(row.power for row in rows), rel=1e-5)
    labels = [text.get_text() for text in axes.texts]
    titles = [
        f"f_number={f}  distance={d}\n{row.power:.3g} W"
        for (f, d), row in zip(product(F_NUMBERS, DISTANCES), rows, strict=True)
    ]
    assert labels == [titles[0], "2 mm", *titles[1:]]  # the scale bar of the first image


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0:360:90", "0 90 180 270"),
        ("0:0.4:0.1", "0 0.1 0.2 0.3"),
        ("1:0:-.25", "1 0.75 0.5 0.25"),
        ("-90:91:90", "-90 0 90"),
        ("10:31:10,5", "10 20 30 5"),
        ("1e1:3e1:1e1", "10 20"),
        ("a:b:c", "a:b:c"),
        ("2.80,x", "2.80 x"),
    ],
)
def test_ranges_leave_their_stop_out(text, values):
    """In decimal: three steps of 0.1 are 0.3, and no rounding error adds the stop."""
    assert several("view", text) == values.split()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0:360", "a range is start:stop:step. Give for example view=0:360:10."),
        ("0:360:10:2", "a range is start:stop:step"),
        ("0:inf:1", "a range is start:stop:step"),
        ("0:360:0", "the step 0 does not lead from 0 to 360"),
        ("0:360:-10", "the step -10 does not lead from 0 to 360"),
        ("0:-90:10", "the step 10 does not lead from 0 to -90"),
        ("5:5:1", "the step 1 does not lead from 5 to 5"),
        ("0:1:1e-9", "has 1000000000 values, at most 100000 are taken"),
    ],
)
def test_ranges_that_lead_nowhere(run, tmp_path, text, message):
    code, _, err = run("sweep", "s.xml", "-D", f"view={text}")
    assert (code, err.count("\n")) == (2, 1)
    assert message in err
    assert os.listdir(tmp_path) == ["s.xml"]


@pytest.mark.parametrize("kind", ["loaded", "text", "dictionary"])
def test_a_sweep_needs_the_file(scene, kind):
    given = {"loaded": fspt.load(scene), "text": scene.read_text(), "dictionary": {"type": "scene"}}[kind]
    name = {"loaded": "a loaded scene. Give for example 's.xml'", "text": "XML text", "dictionary": "dict"}[kind]
    with pytest.raises(SceneError, match=f"must be the name of a file, whose parameters vary, got {name}"):
        fspt.sweep(given, {"f_number": 8}, "o")
    assert not os.path.exists("o")


# --- which parameters only move the lens ---


@pytest.mark.parametrize(
    ("more", "sensor", "expected"),
    [
        ("", LENS_XML, {"f_number": ("f_number",)}),
        ("", LENS_XML.replace('value="0.5"', 'value="$f_number"'), {"f_number": ("f_number", "magnification")}),
        ('<default name="other" value="$f_number"/>', LENS_XML, {}),
        ("", LENS_XML.replace('"$f_number"', '"$f_number.5"'), {}),
        ("", LENS_XML * 2, {}),
        ("", LENS_XML.replace("fspt_lens", "thinlens"), {}),
    ],
)
def test_a_lens_parameter_sets_numbers_of_the_only_lens_and_nothing_else(tmp_path, more, sensor, expected):
    assert SceneSource.of(write_scene(tmp_path / "x.xml", more=more, sensor=sensor)).lens_parameters() == expected


# --- what is there is not rendered again ---


def test_a_second_run_renders_what_is_missing_broken_or_another(scene, tmp_path, calls):
    rendered, loaded = calls
    first = fspt.sweep(scene, VALUES, "o")
    index = index_without_times(tmp_path / "o")
    os.replace(tmp_path / "o" / NAMES[1], tmp_path / "o" / NAMES[3])  # missing, and another stop's
    whole = (tmp_path / "o" / NAMES[2]).read_bytes()
    (tmp_path / "o" / NAMES[2]).write_bytes(whole[: len(whole) // 2])
    os.utime(scene)
    rendered.clear()
    second = fspt.sweep(scene, VALUES, "o")
    assert sorted(rendered) == ["f_number=2.8 distance=175", "f_number=8 distance=165", "f_number=8 distance=175"]
    rendered.clear(), loaded.clear()
    assert fspt.sweep(scene, VALUES, "o", jobs=5) == second
    assert rendered == loaded == []
    assert [row.power for row in second] == [row.power for row in first]
    assert index_without_times(tmp_path / "o") == index


def test_the_report_separates_new_images_from_those_kept(run):
    """Seen to fail with the time of all images, old ones too, called the time of rendering."""
    assert run("sweep", "s.xml", "-D", "f_number=2.8,8")[0] == 0
    _, out, _ = run("sweep", "s.xml", "-D", "f_number=2.8,8,11")
    assert re.match(r"s_sweep/index\.csv: 3 points, 1 rendered in \S+ s, 2 reused\n", out)
    _, out, _ = run("sweep", "s.xml", "-D", "f_number=2.8,8,11")
    assert out.startswith("s_sweep/index.csv: 3 points, 3 reused\n")


def test_another_sensor_makes_another_image(tmp_path, run):
    path = write_scene(tmp_path / "two.xml", sensor=LENS_XML + LENS_XML.replace('"0.8"', '"0.4"'))
    first, second = (fspt.sweep(path, {"f_number": 8}, "o", sensor=k)[0] for k in (0, 1))
    assert second.power == pytest.approx(fspt.render(fspt.load(path), sensor=1).power.sum(), rel=1e-5)
    assert not second.reused
    assert first.peak > 3 * second.peak > 0
    code, _, _ = run("sweep", "two.xml", "-D", "f_number=8", "--sensor", 1, "-o", "o")
    assert code == 0
    code, _, err = run("sweep", "two.xml", "-D", "f_number=8", "--sensor", 2, "-o", "o")
    assert (code, err.count("\n")) == (2, 1)
    assert "sensor 2 does not exist, the scene has 2. Give 0 to 1." in err


@pytest.mark.parametrize("what", ["scene", "included", "data", "rtol", "nothing"])
def test_a_change_of_what_makes_an_image_makes_it_anew(tmp_path, calls, what):
    rendered, _ = calls
    corners, triangle = [(0, -3, -3), (0, 3, -3), (0, 3, 3)], [(0, 1, 2)]
    (tmp_path / "data").mkdir()
    write_ply(tmp_path / "data" / "p.ply", corners, triangle, vertex=[1e-3, 1e-3, 1e-3])
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{PLY_XML.format(name="data/p.ply")}</scene>')
    path = write_scene(tmp_path / "x.xml", shapes='<include filename="part.xml"/>')
    settings = {"rtol": 1e-2}
    (before,) = fspt.sweep(path, {"f_number": 8}, "o", **settings)
    rendered.clear()
    if what == "scene":
        path.write_text(path.read_text().replace('name="pixel_pitch" value="0.8"', 'name="pixel_pitch" value="0.9"'))
    elif what == "included":
        text = (tmp_path / "part.xml").read_text()
        (tmp_path / "part.xml").write_text(
            text.replace("</shape>", '<boolean name="face_normals" value="true"/></shape>')
        )
    elif what == "data":
        write_ply(tmp_path / "data" / "p.ply", corners, triangle, vertex=[2e-3, 2e-3, 2e-3])
    elif what == "rtol":
        settings = {"rtol": 2e-2}
    (after,) = fspt.sweep(path, {"f_number": 8}, "o", **settings)
    assert rendered == ([] if what == "nothing" else ["f_number=8"])
    if what == "data":
        assert after.power == pytest.approx(2 * before.power, rel=1e-5)


@pytest.mark.parametrize("where", ["", "sub", "deep"])
def test_a_change_of_what_an_included_file_includes_makes_an_image_anew(tmp_path, calls, where):
    """The first name depends on a parameter. Seen to fail: the image of the old sphere stayed, with its old row."""
    for folder in ("sub", "deep/sub"):
        (tmp_path / folder).mkdir(parents=True)
    include = '<scene version="3.0.0">{}<include filename="inner.xml"/></scene>'
    outer = "deep/outer" if where == "deep" else "outer"
    shapes = '<default name="part" value=""/><path value="sub"/><include filename="$part.xml"/>'
    path = write_scene(tmp_path / "x.xml", shapes=shapes)
    (tmp_path / f"{outer}.xml").write_text(include.format('<path value="sub"/>'))
    inner = tmp_path / os.path.dirname(outer) / where.replace("deep", "sub") / "inner.xml"
    inner.write_text(f'<scene version="3.0.0">{BALL_XML}</scene>')
    rendered, _ = calls
    (before,) = fspt.sweep(path, {"part": outer}, "o")
    inner.write_text(inner.read_text().replace('"3"', '"1.5"'))
    (after,) = fspt.sweep(path, {"part": outer}, "o")
    assert len(rendered) == 2
    assert after.power < before.power / 3
    assert fspt.sweep(path, {"part": outer}, "o") == [after]
    assert len(rendered) == 2


def test_a_parameter_of_a_file_that_another_parameter_names(tmp_path):
    path = write_scene(tmp_path / "x.xml", shapes='<default name="part" value=""/><include filename="$part.xml"/>')
    for name in ("a", "b"):
        parameter, ball = f'<default name="{name}" value="3"/>', BALL_XML.replace('"3"', f'"${name}"')
        (tmp_path / f"{name}.xml").write_text(f'<scene version="3.0.0">{parameter}{ball}</scene>')
    small, large = fspt.sweep(path, {"part": "a", "a": [1.5, 3]}, "o")
    assert large.power > 3 * small.power
    with pytest.raises(SceneError, match=r"has no parameter 'a'\. Its <default> parameters: .*, part, b"):
        fspt.sweep(path, {"part": ["a", "b"], "a": [1.5, 3]}, "o")


# --- several processes ---


def test_two_processes_one_of_them_killed(scene, tmp_path, monkeypatch, serial):
    """Both are at a point when the first is done, however slowly this process handles it."""
    started, killed = [], []

    def counting(count, context, _, arguments):
        started.append(ProcessPoolExecutor(count, context, begin_held, arguments))
        return started[-1]

    def kill_one(what, share):
        if share == 0.25:
            (child,) = started[0]._processes.values()
            os.kill(child.pid, signal.SIGKILL)
            killed.append(child.pid)
            child.join()
            Path("go").touch()

    monkeypatch.setattr(sweep_workers, "ProcessPoolExecutor", counting)
    rows = fspt.sweep(scene, VALUES, "o", jobs=2, progress=kill_one)
    assert len(killed) == 1
    assert len(started) == 3  # one in place of the dead, none more
    assert [row.file.name for row in rows] == NAMES
    assert_same_bits(tmp_path / "o", serial)
    assert not multiprocessing.active_children()


def test_a_point_that_kills_every_process_is_named(scene, monkeypatch):
    monkeypatch.setattr(sweep_workers, "_begin", end_at_once)
    with pytest.raises(BackendError, match=r"3 worker processes died at f_number=8\. Give it more memory"):
        fspt.sweep(scene, {"f_number": [8]}, "o", jobs=2)


def test_an_error_in_a_process_comes_back_as_it_is(scene):
    with pytest.raises(SceneError, match=r"^f_number=4: fspt_integral: 'rtol' must be in \(0, 1\), got 3"):
        fspt.sweep(scene, {"f_number": [4]}, "o", jobs=2, rtol=3)
    assert not os.path.exists("o")


def test_a_cluster_of_two_workers_one_of_them_killed(scene, tmp_path, serial):
    """By its address; a worker is killed at its point, of two. The other renders both: a third would load Mitsuba.

    Seen to fail where both had finished all points by then.
    """
    distributed = pytest.importorskip("distributed")
    killed = []

    def kill_one(what, share):
        if share == 0.5:
            (busy, *_) = [worker for worker, tasks in distributed.default_client().processing().items() if tasks]
            with suppress(OSError):
                os.kill(distributed.default_client().run(os.getpid, workers=[busy])[busy], signal.SIGKILL)
                killed.append(busy)
            Path("go").touch()

    with distributed.LocalCluster(n_workers=2, **workers.LOCAL_CLUSTER, silence_logs=50) as cluster:
        with distributed.Client(cluster) as client:
            client.run(hold_all_but_the_first_point)
        values = VALUES | {"distance": DISTANCES[:1]}
        rows = fspt.sweep(scene, values, "o", scheduler=cluster.scheduler_address, progress=kill_one)
    assert len(killed) == 1
    assert [row.file.name for row in rows] == NAMES[::2]
    assert_same_bits(tmp_path / "o", {name: serial[name] for name in NAMES[::2]})


def test_a_cluster_started_here(run, tmp_path, serial):
    """While another one has dask's usual port. Seen to fail, with a warning that the port is taken."""
    pytest.importorskip("distributed")
    with socket.socket() as other:
        with suppress(OSError):  # or it is taken already
            other.bind(("127.0.0.1", 8787))
            other.listen()
        code, _, err = run("sweep", "s.xml", *DEFINE, "--scheduler", "local", "--jobs", "1", "-o", "o")
    assert (code, err) == (0, "")
    assert_same_bits(tmp_path / "o", serial)


# --- what goes wrong ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no parameter to vary over s.xml. Give one, for example -D f_number=2.8,5.6."),
        (
            ["-D", "iso=100,200"],
            "s.xml: the scene has no parameter 'iso'. Its <default> parameters: f_number, distance.",
        ),
        (["-D", "f_number="], "parameter 'f_number' has an empty value. Give values between commas"),
        (["-D", "f_number"], "-D f_number: must be NAME=V1,V2,…, for example -D f_number=2.8,5.6."),
        (["-D", "f_number=2", "-D", "f_number=4"], "'f_number' is given twice. Put all values into one"),
        (["-D", "f_number=2,2"], "parameter 'f_number' has the value '2' twice. Leave one out."),
        (["-D", "f_number=8,abc"], "parameter 'f_number' must be a finite number, got 'abc'. Correct this value."),
        (["-D", "f_number=8,-2"], "fspt_lens: 'f_number' must be > 0 and finite, got -2. Give"),
        (["-D", "f_number=8", "-o", "s.xml"], "the folder 's.xml' is a file. Give another name with -o."),
        (["-D", "f_number=8", "-o", "no/where"], "the folder 'no' does not exist. Make it, or write elsewhere."),
        (["-D", "f_number=8", "-o", "o" * 256], "cannot be made: File name too long. Give -o a name."),
        (["-D", "f_number=8", "--jobs", "0"], "'jobs' must be >= 1, got 0. Give a number of processes"),
        (["-D", "f_number=8", "--method", "magic"], "'method' must be one of integral, path, ptracer, got 'magic'."),
        (["-D", "f_number=8", "--scheduler", "tcp://[::1]:9", "--jobs", "2"], "'jobs' = 2 has no meaning for the"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path, arguments, message):
    code, out, err = run("sweep", "s.xml", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("fspt: ")
    assert message in err
    assert err.count("\n") == 1
    assert os.listdir(tmp_path) == ["s.xml"]


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_does_not_answer(run, tmp_path, monkeypatch, address):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "SCHEDULER_TIMEOUT", 0.5)
    code, out, err = run("sweep", "s.xml", *DEFINE, "--scheduler", address)
    assert (code, out) == (2, "")
    assert err == (
        f"fspt: sweep: no dask scheduler answers at '{address}'. Start one with 'dask scheduler', or give "
        "--scheduler local.\n"
    )
    assert os.listdir(tmp_path) == ["s.xml"]


def test_without_dask_the_extra_is_named(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BackendError, match=r"pip install 'mitsuba-fspt\[cluster\]'"):
        fspt.sweep(scene, VALUES, "o", scheduler="local")


def test_without_matplotlib_all_but_the_contact_sheet_is_there(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, _, err = run("sweep", "s.xml", "-D", "f_number=8", "-o", "o")
    assert code == 0
    assert err.count("\n") == 1
    assert "no contact sheet" in err
    assert "mitsuba-fspt[plot]" in err
    assert sorted(os.listdir("o")) == ["index.csv", "s_f_number=8.exr"]


def test_a_folder_without_the_right_to_write(scene, monkeypatch):
    os.mkdir("o")
    monkeypatch.setattr(sweep.os, "access", lambda path, mode: False)
    with pytest.raises(ImageError, match=r"the folder 'o' is not writable\. Write elsewhere"):
        fspt.sweep(scene, VALUES, "o")


def test_a_parameter_named_like_a_column(tmp_path):
    path = write_scene(tmp_path / "x.xml", more='<default name="power" value="1"/>')
    with pytest.raises(SceneError, match=r"parameter 'power' has the name of a column of index\.csv"):
        fspt.sweep(path, {"power": [1, 2]}, "o")


@pytest.fixture
def cluster_here(monkeypatch):
    """Address of a cluster whose worker is this process."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("mitsuba_fspt.studies.point_renderer.set_threads", lambda count: None)
    with distributed.LocalCluster(n_workers=1, processes=False, **workers.LOCAL_CLUSTER, silence_logs=50) as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize("where", ["here", "processes", "cluster"])
def test_points_that_fail_are_named_and_leave_the_others(tmp_path, where, request):
    """Seen to fail: what came after the first of them was not rendered."""
    how = {"jobs": 2} if where == "processes" else {}
    if where == "cluster":
        how = {"scheduler": request.getfixturevalue("cluster_here")}
    sensor = LENS_XML.replace('"0.8"', '"$pitch"')
    path = write_scene(tmp_path / "x.xml", sensor='<default name="pitch" value="1"/>' + sensor)
    told = []
    with pytest.raises(fspt.FsptError, match=r"^pitch=-1: .*'pixel_pitch' must be > 0 and finite, got -1\b.*\.$"):
        fspt.sweep(path, {"pitch": [0.8, -1, 0.4]}, "o", progress=lambda what, share: told.append(share), **how)
    assert told[-1] == 1
    assert sorted(os.listdir("o")) == ["index.csv", "x_pitch=0.4.exr", "x_pitch=0.8.exr"]
    assert len((tmp_path / "o" / "index.csv").read_text().splitlines()) == 3
    if how:  # the line is the same however the points are shared out
        return
    with pytest.raises(fspt.FsptError) as caught:
        fspt.sweep(path, {"pitch": [-1, 0.8, -2, -3]}, "o")
    assert re.search(r"^pitch=-1: .* 3 of 4 points failed; the others: pitch=-2, pitch=-3\.$", str(caught.value))
    assert len((tmp_path / "o" / "index.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize("jobs", [[], ["--jobs", "2"]])
def test_ctrl_c_leaves_one_line_and_what_is_done(tmp_path, jobs):
    """Ctrl-C goes to all processes of the terminal, and only the first of them acts on it."""
    define = ["-D", "f_number=2.8,4,5.6,8,11,16,22,32", "-D", "distance=165,170,175,180"]
    command = [sys.executable, "-m", "mitsuba_fspt", "sweep", "s.xml", *define, "-o", "o", *jobs]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not list(tmp_path.glob("o/s_*.exr")):
        time.sleep(0.01)
    if jobs:
        for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            os.kill(int(child), signal.SIGINT)
        time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err == "fspt: interrupted; finished images stay in o, the same command goes on from there.\n"
    done = {path.name for path in tmp_path.glob("o/*.exr")}
    assert 0 < len(done) < 32
    assert set(os.listdir("o")) == done | {"index.csv"}
    assert len((tmp_path / "o" / "index.csv").read_text().splitlines()) == 1 + len(done)
    assert all(fspt.read(tmp_path / "o" / name).power.max() > 0 for name in done)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_the_one_at_the_top(tmp_path, number):
    """Each point would take minutes. Seen to fail: the workers went on with their points.

    The signal that a process cannot catch meets two workers, of which one could keep the other's pipe open.
    """
    slow = ["--method", "path", "--spp", "100000000", "--jobs", "2"]
    define, busy = (DEFINE, 4) if number == signal.SIGKILL else (["-D", "f_number=8"], 2.5)
    command = [sys.executable, "-m", "mitsuba_fspt", "sweep", "s.xml", *define, "-o", "o", *slow]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    deadline = time.monotonic() + 60
    workers: list[Path] = []
    while time.monotonic() < deadline and sum(map(_seconds_of_work, workers)) < busy:
        time.sleep(0.1)
        workers = [Path(f"/proc/{child}") for child in children.read_text().split()]
    process.send_signal(number)
    deadline = time.monotonic() + 20
    while any(map(_runs, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    left = [worker for worker in workers if _runs(worker)]
    for worker in left:
        os.kill(int(worker.name), signal.SIGKILL)
    out, err = process.communicate(timeout=20)
    assert len(workers) >= 2
    assert not left
    assert out == ""
    if number == signal.SIGTERM:
        assert process.returncode == 130
        done = "finished images stay in o, the same command goes on from there"
        assert err == f"fspt: interrupted; {done if (tmp_path / 'o').exists() else 'nothing was written'}.\n"


def _runs(process):
    """A process of /proc is there and no corpse that nobody has buried."""
    try:
        return (process / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def _seconds_of_work(process):
    try:
        user, system = (process / "stat").read_text().rsplit(")", 1)[1].split()[11:13]
    except OSError:
        return 0
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("hit", ["write", "_write_index"])
def test_ctrl_c_while_a_file_is_written_leaves_no_image_without_its_row(scene, monkeypatch, hit):
    holder = fspt.Image if hit == "write" else sweep
    write = getattr(holder, hit)

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        write(*arguments)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(holder, hit, interrupted)
    with pytest.raises(KeyboardInterrupt):
        fspt.sweep(scene, {"f_number": [8, 16]}, "o")
    done = [name for name in os.listdir("o") if name.endswith(".exr")]
    assert len(done) == (1 if hit == "write" else 2)
    assert set(os.listdir("o")) == {*done, "index.csv"}
    with open("o/index.csv", encoding="utf-8") as index:
        assert {row["file"] for row in csv.DictReader(index)} == set(done)


def test_a_run_after_ctrl_c_renders_the_rest(scene, calls):
    rendered, _ = calls

    def interrupt(what, share):
        if share == 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fspt.sweep(scene, VALUES, "o", progress=interrupt)
    assert len(rendered) == 2
    fspt.sweep(scene, VALUES, "o")
    assert sorted(rendered) == sorted(f"f_number={f} distance={d}" for f, d in product(F_NUMBERS, DISTANCES))


def test_images_that_were_stopped_are_rendered_anew(scene, calls):
    """No time is left for any refinement; without a limit both are completed, and stay."""
    values = {"f_number": F_NUMBERS}
    stopped = sweep.sweep(scene, values, "o", max_time=1e-3)
    assert ["stopped by max_time" in row.warnings for row in stopped] == [True, True]
    whole = sweep.sweep(scene, values, "o")
    assert [row.reused for row in whole] == [False, False]
    assert [row.warnings for row in whole] == ["", ""]
    assert all(after.largest_error < 0.1 * before.largest_error for before, after in zip(stopped, whole, strict=True))
    assert [row.reused for row in sweep.sweep(scene, values, "o", max_time=60)] == [True, True]
    assert len(calls[0]) == 4


def test_each_point_gets_its_part_of_the_time(scene, monkeypatch):
    """Of 80 s the first of four points gets 20; the others share what it leaves. Two processes have 40 for each."""
    given = []

    def instant(self, point):
        given.append(point.max_time)
        raise SceneError("not rendered")

    monkeypatch.setattr(PointRenderer, "image", instant)
    with pytest.raises(SceneError):
        sweep.sweep(scene, VALUES, "o", max_time=80)
    assert given == pytest.approx([20, 80 / 3, 40, 80], abs=2)
    monkeypatch.setattr(sweep_workers, "images_of_processes", lambda missing, jobs: ((p, p.max_time) for p in missing))
    points = [point for point, _ in sweep._images(sweep.points(scene, VALUES, {}), 2, None, sweep.Deadline(80))]
    assert [point.max_time for point in points] == pytest.approx([40] * 4, abs=1)


def test_ctrl_c_before_the_first_image_names_no_folder(run, scene, monkeypatch):
    """Seen to fail: 'finished images stay in o', which did not exist."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "_images", interrupted)
    assert run("sweep", scene, *DEFINE, "-o", "o") == (130, "", "fspt: interrupted; nothing was written.\n")
    assert not Path("o").exists()
