"""The transport matrix as an object, a file and a verb: transpose, views, resumption, refusals."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from small_scenes import SCENES, attribute, ball, glow, lens, load_scene, world_scene, write_ply

import mitsuba_fspt as fspt
from mitsuba_fspt.integral.rows.sparse_rows import SparseRows
from mitsuba_fspt.inverse import transport as module
from mitsuba_fspt.inverse.transport_file import PartialFile
from mitsuba_fspt.inverse.transport_matrix import _differences
from mitsuba_fspt.rendering.provenance import mesh_digest, same_mesh
from mitsuba_fspt.runtime import workers
from mitsuba_fspt.runtime.errors import BackendError, SceneError, TransportError
from mitsuba_fspt.runtime.workers import LOCAL_CLUSTER

pytestmark = pytest.mark.usefixtures("mono")

BODY = trimesh.creation.icosphere(2, radius=5.0)
SMALL = {"width": 16, "height": 12, "pixel_pitch": 1.7}

XML = """<scene version="3.0.0">
    <default name="view" value="0"/>
    <default name="f_number" value="4"/>
    <default name="size" value="1"/>
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/><float name="f_number" value="$f_number"/>
        <float name="magnification" value="0.5"/><float name="pixel_pitch" value="0.5"/>
        <transform name="to_world"><lookat origin="165, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="14"/><integer name="height" value="12"/>
            <string name="pixel_format" value="luminance"/></film>
    </sensor>
    <shape type="ply" id="body">
        <string name="filename" value="body.ply"/><boolean name="face_normals" value="true"/>
        <transform name="to_world"><scale value="$size"/><rotate z="1" angle="$view"/></transform>
        <emitter type="fspt_surface">
            <texture type="mesh_attribute" name="exitance"><string name="name" value="vertex_exitance"/></texture>
        </emitter>
    </shape>
</scene>
"""


@pytest.fixture
def scene_file(tmp_path):
    """A scene file with the parameters view, f_number and size."""
    return written(tmp_path)


def written(folder):
    write_ply(folder / "body.ply", BODY.vertices, BODY.faces, vertex=1e-3 * (2 + BODY.vertices[:, 1] / 5))
    (folder / "body.xml").write_text(XML)
    return folder / "body.xml"


@pytest.fixture(scope="module")
def matrix(mono, tmp_path_factory):
    """Three views; computed once, no test changes it."""
    return fspt.transport(written(tmp_path_factory.mktemp("matrix")), view=[0, 90, 200], f_number=2.8)


def test_the_transpose_is_the_transpose(matrix):
    """Dot test of each view and of all, by matvec, rmatvec, matmat and `.T`; both sides well off 0."""
    rng = np.random.default_rng(2)
    exitance, power = rng.random(matrix.shape[1]), rng.random(matrix.shape[0])
    assert matrix.shape == (3 * 12 * 14, len(BODY.vertices))
    for left, right in [
        (power @ (matrix @ exitance), (matrix.T @ power) @ exitance),
        *(
            (
                (power.reshape(3, -1)[k] @ (block.matrix @ exitance)),
                (block.matrix.T @ power.reshape(3, -1)[k]) @ exitance,
            )
            for k, block in enumerate(matrix.blocks)
        ),
    ]:
        assert left > 0
        assert left == pytest.approx(right, rel=1e-12)
    both = np.stack([exitance, 2 * exitance], 1)
    np.testing.assert_allclose(matrix @ both, np.stack([matrix @ exitance, 2 * (matrix @ exitance)], 1), rtol=1e-12)
    np.testing.assert_allclose(matrix.T @ np.stack([power] * 2, 1), np.stack([matrix.T @ power] * 2, 1), rtol=1e-12)
    np.testing.assert_allclose(matrix.matrix @ exitance, matrix @ exitance, rtol=1e-12)
    np.testing.assert_allclose(matrix.backward(power.reshape(matrix.image_shape)), matrix.T @ power, rtol=1e-12)


def test_its_summary_in_numbers_and_text(matrix):
    """Views as numbers, sums of columns, surface areas, the seen part; J_n of the scene has no say."""
    assert matrix.views == [{"view": view, "f_number": 2.8} for view in (0, 90, 200)]
    assert matrix.image_shape == (3, 12, 14)
    assert matrix.parts == {"body": slice(0, len(BODY.vertices))}
    assert matrix.areas.sum() == pytest.approx(BODY.area, rel=1e-6)
    np.testing.assert_allclose(matrix.sensitivity, matrix.matrix.sum(axis=0), rtol=1e-6)
    assert (matrix.matrix.data > 0).all()
    assert matrix.seen.all()


def test_vertices_that_no_camera_sees_have_no_entries(scene_file):
    """Of a sphere one view sees a little less than half; the columns beyond are empty."""
    found = fspt.transport(scene_file)
    away = BODY.vertices[:, 0] < -1.0
    assert not found.sensitivity[away].any()
    assert found.views == [{}]
    assert 0.4 < found.areas[found.seen].sum() / found.areas.sum() < 0.6


def test_equal_views_are_reported(scene_file):
    """Views that differ by J_n alone, on which no entry depends; those of other poses are not counted."""
    text = XML.replace('value="vertex_exitance"/>', 'value="vertex_exitance"/><float name="scale" value="$J"/>')
    scene_file.write_text(text.replace("<default", '<default name="J" value="1"/><default', 1))
    found = fspt.transport(scene_file, J=[1, 2], view=[0, 90], rtol=1e-2)
    assert "2 of 4 views are equal to one before, such as 'J=2 view=0' to 'J=1 view=0'" in found.metadata["warnings"]
    assert "equal" not in fspt.transport(scene_file, view=[0, 90], rtol=1e-2).metadata.get("warnings", "")


def test_several_meshes_and_sensors(tmp_path):
    """Columns of one mesh after the other, in the order of the scene; a view a sensor, last and fastest."""
    shapes = []
    for k, shift in enumerate((-7, 7)):
        path = write_ply(
            tmp_path / f"{k}.ply", BODY.vertices + np.array([0.0, shift, 0.0]), BODY.faces, vertex=np.ones(162)
        )
        body = {"type": "ply", "filename": str(path), "face_normals": True}
        shapes.append(body | {"emitter": glow(attribute("vertex_exitance"))})
    whole = world_scene(*shapes, sensor=lens(24, 0.6))
    found = fspt.transport(whole)
    assert found.views == [{"sensor": 0}]
    assert [part.stop - part.start for part in found.parts.values()] == [162, 162]
    one = fspt.transport(world_scene(shapes[1], sensor=lens(24, 0.6)))
    part = list(found.parts.values())[1]
    np.testing.assert_allclose(found.sensitivity[part], one.sensitivity, rtol=5e-3, atol=1e-3 * one.sensitivity.max())
    assert fspt.transport(whole, sensor=[0]).views == [{"sensor": 0}]


def test_a_file_contains_the_matrix(matrix, tmp_path):
    """The same numbers after `save` and `read_transport`; one view is read alone; float32 loses no more than 6e-8."""
    matrix.save(tmp_path / "T.npz")
    again = fspt.read_transport(tmp_path / "T.npz")
    assert abs(again.matrix - matrix.matrix).max() == 0
    assert (again.views, again.parts, again.on) == (matrix.views, matrix.parts, "vertex")
    np.testing.assert_array_equal(again.sensitivity, matrix.sensitivity)
    exitance = np.linspace(0, 1, matrix.shape[1])
    np.testing.assert_array_equal(again.error(exitance), matrix.error(exitance))
    with np.load(tmp_path / "T.npz") as file:
        assert file["view_1/values"].dtype == np.float32
        assert file["view_1/columns"].dtype == np.uint16


@pytest.mark.parametrize("count", [1 << 16, (1 << 16) + 1])
def test_files_contain_the_last_column(tmp_path, count):
    """Seen to fail with 16-bit numbers of columns whatever their count."""
    columns = np.array([count - 1, 3], np.int32)
    light, change = np.array([1, 2], np.float32), np.zeros(2, np.float16)
    partial = PartialFile(tmp_path / "T.npz")
    partial.put(0, SparseRows((1, 2), count, light, columns, np.array([0, 1, 2]), change, 0 * light), "one")
    partial.views = 1
    np.testing.assert_array_equal(partial[0].columns, columns)
    assert partial[0].columns.dtype == np.int32


def test_an_interrupted_file_goes_on(matrix, scene_file, tmp_path, monkeypatch):
    """Two of three views are done when it stops; the second call computes the third alone, to the same bits."""
    calls, plain = [], module.computed

    def failing(task, *rest):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(task.label)
        return plain(task, *rest)

    monkeypatch.setattr(module, "computed", failing)
    file, views = tmp_path / "T.npz", {"view": [0, 90, 200], "f_number": 2.8}  # those of `matrix`
    with pytest.raises(KeyboardInterrupt):
        fspt.transport(scene_file, file=file, **views)
    assert not file.exists()
    calls.clear()
    monkeypatch.setattr(module, "computed", lambda task, *rest: calls.append(task.label) or plain(task, *rest))
    found = fspt.transport(scene_file, file=file, **views)
    assert calls == ["view=200 f_number=2.8"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["T.npz", "body.ply", "body.xml"]
    assert abs(found.matrix - matrix.matrix).max() == 0


def test_a_cluster_computes_the_same_matrix(matrix, scene_file, tmp_path, monkeypatch):
    """Of a cluster in this process: the same bits as without, and no file beside.

    What becomes of a worker that is killed is decided in `results_of_cluster`, for which tests/studies/test_sweep.py
    kills one; here each view goes through it.
    """
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    threads = []
    monkeypatch.setattr(module.backend, "set_threads", threads.append)
    tried, retrying = [], workers.results_of_cluster

    def noted(points, *rest):
        tried.extend(points)
        return retrying(points, *rest)

    monkeypatch.setattr(workers, "results_of_cluster", noted)
    views = {"view": [0, 90], "f_number": 2.8}
    with distributed.LocalCluster(n_workers=1, processes=False, **LOCAL_CLUSTER, silence_logs=50) as cluster:
        there = fspt.transport(scene_file, scheduler=cluster.scheduler_address, file="T.npz", **views)
    assert threads == [1, 1]
    assert [task.values["view"] for task in tried] == [0, 90]
    assert there.views == matrix.views[:2]
    assert abs(there.matrix - matrix.matrix[: 2 * 12 * 14]).max() == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["T.npz", "body.ply", "body.xml"]


def test_a_view_that_ends_every_worker_is_named_and_others_stay(scene_file, tmp_path, monkeypatch):
    """What `results_of_cluster` gives of such a view is raised; seen to fail with the error taken for a result."""

    def killed(points, *_):
        yield points[0], module.computed(points[0])
        yield points[1], workers.lost_workers(points[1], "transport")

    monkeypatch.setattr(workers, "results_of_cluster", killed)
    file = tmp_path / "T.npz"
    with pytest.raises(BackendError, match="transport: 3 worker processes died at view=90"):
        fspt.transport(scene_file, view=[0, 90], scheduler="tcp://127.0.0.1:1", file=file)
    monkeypatch.setattr(workers, "results_of_cluster", lambda points, *_: [(p, module.computed(p)) for p in points])
    calls, plain = [], module.computed
    monkeypatch.setattr(module, "computed", lambda task, *rest: calls.append(task.label) or plain(task, *rest))
    fspt.transport(scene_file, view=[0, 90], scheduler="tcp://127.0.0.1:1", file=file)
    assert calls == ["view=90"]


def test_a_scheduler_that_does_not_answer_is_named_by_the_matrix(scene_file, run, tmp_path, monkeypatch):
    """One line; views that are finished stay."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "SCHEDULER_TIMEOUT", 0.5)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "T.npz.views").mkdir()
    code, out, err = run("matrix", scene_file, "-o", "T.npz", "--scheduler", "tcp://127.0.0.1:9")
    assert (code, out) == (2, "")
    assert err.startswith("fspt: transport: no dask scheduler answers at 'tcp://127.0.0.1:9'.")
    assert err.count("\n") == 1
    assert (tmp_path / "T.npz.views").is_dir()


def test_images_are_held_against_the_views(scene_file, matrix, caplog):
    """Size, order and pixel pitch must agree where metadata tell; another mesh is one line."""
    images = [fspt.render(fspt.load(scene_file, view=view, f_number=2.8)) for view in (0, 90, 200)]
    assert matrix.backward(images).max() > 0
    assert not caplog.records
    with pytest.raises(TransportError, match="in the order of the views"):
        matrix.backward(images[::-1])
    with pytest.raises(TransportError, match="3 views"):
        matrix.backward(images[:2])
    with pytest.raises(TransportError, match=r"must have the shape \(3, 12, 14\)"):
        matrix.backward(np.zeros((3, 14, 12)))
    other = [fspt.Image(image.power, metadata=image.metadata | {"pixel_pitch": 0.6}) for image in images]
    with pytest.raises(TransportError, match=r"pixel pitch of 0\.6 mm"):
        matrix.backward(other)
    strange = [fspt.Image(image.power, metadata=image.metadata | {"mesh_digest": "0:AAAA"}) for image in images]
    with caplog.at_level(logging.WARNING):
        matrix.backward(strange)
    assert [record.getMessage() for record in caplog.records] == [
        "fspt: image 0 shows another mesh than the one of the matrix."
    ]
    for name, value, own in (("transmittance", 0.5, 1.0), ("lens_diameter", 30.0, "none")):
        caplog.clear()  # the power is that through a filter, J_n would be half of what it is
        matrix.backward([fspt.Image(image.power, metadata=image.metadata | {name: value}) for image in images])
        assert caplog.messages == [f"fspt: image 0 has {name} = {value}, its view of the matrix {own}."]
    caplog.clear()
    some = [{name: image.metadata[name] for name in ("focal_length", "f_number", "pixel_pitch")} for image in images]
    for f_number, lines in ((2.8, 0), (4.0, 1)):  # of a lens whose other numbers the metadata do not state
        matrix.backward(
            [
                fspt.Image(image.power, metadata=known | {"f_number": f_number})
                for image, known in zip(images, some, strict=True)
            ]
        )
        assert len(caplog.messages) == lines
    caplog.clear()
    counts = [np.full(image.shape, 600) for image in images]
    camera = fspt.Detector.typical_ccd()
    numbers = {"exposure_time": 60, "wavelength_nm": 650}
    with caplog.at_level(logging.WARNING):
        matrix.backward([camera.reduce(c, **numbers) for c in counts])
    assert [record.getMessage() for record in caplog.records] == [
        f"fspt: image 0 was reduced with the dark current of pixels of {camera.pixel_pitch:g} mm, the matrix has "
        f"pixels of {images[0].metadata['pixel_pitch']:g} mm. Give pixel_pitch to reduce."
    ]
    caplog.clear()
    matrix.backward([camera.reduce(c, pixel_pitch=images[0].metadata["pixel_pitch"], **numbers) for c in counts])
    assert not caplog.records


def test_images_of_another_light_than_the_lens_s_filter_are_told(scene_file, matrix):
    """The matrix holds the transmittance of the filter for the light of its lens alone."""
    image = fspt.render(fspt.load(scene_file, view=0, f_number=2.8))
    lens = matrix.metadata["lenses"][0] | {"wavelength_nm": 560.0, "transmittance": 0.38}
    metadata = {"pixel_pitch": image.metadata["pixel_pitch"]}
    for light, told in ((560.0, 0), (660.0, 1)):
        notes = _differences(0, metadata | {"wavelength_nm": light}, matrix.views[0], lens, matrix)
        assert [note.startswith("image 0 has light of 660 nm") for note in notes] == told * [True]


def test_a_digest_of_a_mesh_does_not_depend_on_its_pose():
    """Rotation and translation in single precision keep it; a moved vertex, a mirror and other faces do not."""
    turn = trimesh.transformations.rotation_matrix(1.1, [1, 2, 3])[:3, :3]
    plain = mesh_digest(BODY.vertices.astype(np.float32), BODY.faces)
    moved = (BODY.vertices @ turn.T + [100, -20, 3]).astype(np.float32)
    bent = BODY.vertices.copy()
    bent[7] *= 1.01
    assert same_mesh(plain, mesh_digest(moved, BODY.faces))
    assert not same_mesh(plain, mesh_digest(bent, BODY.faces))
    assert not same_mesh(plain, mesh_digest(BODY.vertices * [1, 1, -1], BODY.faces))
    assert not same_mesh(plain, mesh_digest(BODY.vertices, BODY.faces[::-1]))


def test_areas_cannot_be_written_into(matrix):
    """Seen to fail: `weights = T.areas; weights *= …` changed the powers of all later results."""
    for array in (matrix.areas, matrix.sensitivity):
        with pytest.raises(ValueError, match="read-only"):
            array *= 2


def test_vectors_that_do_not_fit_are_refused(matrix):
    """Masked arrays, too. Seen to fail: `T @ J` and `backward` took what the mask hides."""
    hidden = np.ma.array(np.ones(162), mask=np.arange(162) == 3)
    for product in (matrix.forward, matrix.matvec, matrix.dot, lambda values: matrix @ values):
        with pytest.raises(TransportError, match=r"J is a masked array that hides 1 values\. Fill it"):
            product(hidden)
    with pytest.raises(TransportError, match="images is a masked array that hides 504 values"):
        matrix.backward(np.ma.masked_all(matrix.image_shape))
    rows = np.ones(matrix.shape[0])
    for transpose in (matrix.T, matrix.H):
        np.testing.assert_array_equal(transpose @ rows, matrix.rmatvec(rows))
        np.testing.assert_array_equal(transpose @ rows[:, None], matrix.rmatvec(rows)[:, None])
        assert transpose.T is matrix
        with pytest.raises(TransportError, match="images is a masked array that hides 1 values"):
            transpose @ np.ma.array(rows, mask=np.arange(len(rows)) == 3)
    with pytest.raises(TransportError, match=r"J must have the shape \(162,\)"):
        matrix.forward(np.ones(161))
    with pytest.raises(TransportError, match="J has 1 values that are NaN"):
        matrix.forward(np.where(np.arange(162) == 3, np.nan, 1))
    with pytest.raises(TransportError, match="images has 1 values that are NaN"):
        matrix.backward(np.where(np.arange(504).reshape(3, 12, 14) == 5, np.nan, 1))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"on": "edge"}, "'on' must be 'vertex' or 'face'"),
        ({"rtol": 0}, r"'rtol' must be in \(0, 1\)"),
        ({"view": [0, 0]}, "value '0' twice"),
        ({"colour": 3}, "no parameter 'colour'"),
        ({"size": [1, 1.1]}, "rigid motion"),
        ({"view": 0, "f_number": "wide"}, "must be a finite number"),
        ({"sensor": [0, 0]}, "or one twice"),
        ({"sensor": 3}, "sensor 3 does not exist"),
        ({"file": "T.txt"}, "must end in .npz"),
        ({"file": "nowhere/T.npz"}, "does not exist"),
    ],
    ids=str,
)
def test_wrong_wishes_are_refused_in_one_line(scene_file, tmp_path, monkeypatch, given, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((TransportError, SceneError), match=message) as refused:
        fspt.transport(scene_file, **given)
    assert "\n" not in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["body.ply", "body.xml"]


def test_scenes_without_columns_are_refused(tmp_path):
    import mitsuba as mi

    with pytest.raises(TransportError, match="is a sphere"):
        fspt.transport(world_scene(ball()))
    with pytest.raises(TransportError, match="is a sphere"):
        fspt.transport(SCENES / "textured_sphere.xml")
    with pytest.raises(TransportError, match="loaded scene has no parameter"):
        fspt.transport(load_scene("nylon_cylinder"), view=[0, 90])
    path = write_ply(tmp_path / "b.ply", BODY.vertices, BODY.faces, vertex=np.ones(162))
    body = {"type": "ply", "filename": str(path), "face_normals": True, "emitter": glow(attribute())}
    away = lens(to_world=mi.ScalarTransform4f().look_at([165, 0, 0], [300, 0, 0], [0, 0, 1]))
    with pytest.raises(TransportError, match="sees nothing"):
        fspt.transport(world_scene(body, sensor=away))
    grid = mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32))
    around = mi.ScalarTransform4f().translate([-20] * 3).scale(40)
    volume = {"type": "gridvolume", "grid": grid, "to_world": around, "accel": False}
    law = {"emission": "last_flight", "int_ior": 1.37, "mua": 0.01, "musp": 1.0, "fluence": volume}
    with pytest.raises(TransportError, match=r"'last_flight' of shape .* depends on the fluence.*Give 'lambert'"):
        fspt.transport(world_scene(body | {"emitter": glow(attribute()) | law}))


def test_a_matrix_too_large_for_the_memory_is_refused_before_the_work(tmp_path, monkeypatch):
    """Seen to fail where nothing compares the bytes."""
    from mitsuba_fspt.integral.rows import view_rows

    monkeypatch.setattr(view_rows, "available_memory", lambda: 1 << 20)
    scene = load_scene("nylon_cylinder")
    solved = []
    monkeypatch.setattr(type(scene.integrator()), "solve", lambda *given: solved.append(given))
    with pytest.raises(TransportError, match=r"needs \d+ bytes .* 1048576 are free"):
        fspt.transport(scene)
    assert not solved


def test_an_rtol_that_is_not_reached_is_reported(matrix, scene_file, tmp_path, run, monkeypatch):
    """In the metadata, and as one line of the verb. Here an integral that states a hundredth of the brightest pixel.

    Seen to fail without `warnings` in the metadata.
    """
    import mitsuba as mi

    assert "warnings" not in matrix.metadata
    integral = type(mi.load_dict({"type": "fspt_integral"}))  # of the variant that is set
    plain = integral.solve

    def unsure(*given, **named):
        found = plain(*given, **named)
        return replace(found, error=0.01 * found.power.max() * (found.power > 0))

    monkeypatch.setattr(integral, "solve", unsure)
    monkeypatch.chdir(tmp_path)
    code, _, err = run("matrix", scene_file, "-o", "T.npz", "--quiet")
    assert code == 0
    assert err.startswith("fspt: T.npz: rtol 0.001 not reached on ")
    assert "largest error 1.0e-02 of the peak" in err
    assert err.count("\n") == 1
    assert fspt.read_transport("T.npz").metadata["warnings"] in err


def test_files_that_are_none_are_refused(matrix, tmp_path):
    """Seen to fail with a text that NumPy opens: its message is that of a pickled file, which may be unsafe."""
    with pytest.raises(TransportError, match="does not exist"):
        fspt.read_transport(tmp_path / "none.npz")
    whole = tmp_path / "T.npz"
    matrix.save(whole)
    half = tmp_path / "half.npz"
    half.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(TransportError, match="truncated"):
        fspt.read_transport(half)
    np.savez(tmp_path / "other.npz", meta=np.array(json.dumps({"format": "something"})))
    with pytest.raises(TransportError, match="has the format 'something'"):
        fspt.read_transport(tmp_path / "other.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(TransportError, match=r"\(no zip archive\)"):
        fspt.read_transport(tmp_path / "text.npz")


def test_the_verb(scene_file, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("matrix", scene_file, "-D", "view=0:180:90", "-D", "f_number=4", "-o", "T.npz", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["shape"] == [2 * 12 * 14, 162]
    assert told["entries"] == fspt.read_transport("T.npz").entries
    assert 0 < told["sensitivity"][0] < told["sensitivity"][1] < 1
    assert 0.5 < told["seen"] < 1
    code, out, err = run("matrix", scene_file, "-D", "size=1,1.2", "-o", "U.npz")
    assert (code, out) == (2, "")
    assert "rigid motion" in err
    assert len(err.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["T.npz", "body.ply", "body.xml"]


def test_a_matrix_stops_between_views_and_goes_on(matrix, scene_file, tmp_path, run, monkeypatch):
    """In no time at least one view is computed; each call adds one, and the last gives the matrix."""
    monkeypatch.chdir(tmp_path)
    command = ("matrix", scene_file, "-D", "view=0,90", "-D", "f_number=2.8", "-o", "T.npz")
    code, out, err = run(*command, "--max-time", "1e-3")
    assert (code, out) == (2, "")
    assert re.fullmatch(
        r"fspt: transport: stopped by max_time, as another view takes some [\d.e+]+ s; 1 of 2 views are in "
        r"T.npz.views. Call it again to go on from there.\n",
        err,
    )
    assert not Path("T.npz").exists()
    code, _, err = run(*command, "--max-time", "1e-3")
    assert (code, err) == (0, "")
    assert np.array_equal(fspt.read_transport("T.npz").matrix.data, matrix.matrix[: 2 * 12 * 14].data)
    with pytest.raises(TransportError, match="'max_time' = 10 needs 'file'"):
        fspt.transport(scene_file, max_time=10)
    with pytest.raises(TransportError, match="'max_time' must be > 0 s"):
        fspt.transport(scene_file, file="U.npz", max_time=0)
