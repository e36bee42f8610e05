"""Bad input through the command line: exit code 2, one line that names the thing, nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mitsuba_fspt import cli

SCENES = Path(__file__).resolve().parent.parent / "scenes"
TEMPLATE = """<scene version="3.0.0">
    <default name="f_number" value="8"/>
    <integrator type="fspt_integral"><float name="rtol" value="1e-2"/></integrator>
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/> <float name="f_number" value="$f_number"/>
        {lens}
        <transform name="to_world"><lookat origin="{origin}" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    {shape}
</scene>"""
LENS = '<float name="magnification" value="0.5"/> <float name="pixel_pitch" value="1"/>'
SPHERE = '<shape type="sphere"><float name="radius" value="10"/>{}</shape>'
EMITTER = '<emitter type="fspt_surface"><float name="exitance" value="{}"/></emitter>'


def scene(folder: Path, lens: str = LENS, shape: str | None = None, origin: str = "0, 0, 165") -> str:
    shape = SPHERE.format(EMITTER.format(1)) if shape is None else shape
    path = folder / "scene.xml"
    path.write_text(TEMPLATE.format(lens=lens, shape=shape, origin=origin))
    return str(path)


def mesh_scene(folder: Path, exitance: np.ndarray | None, vertices: np.ndarray | None = None) -> str:
    """A scene of a PLY triangle pair with these values on its four vertices."""
    if vertices is None:
        vertices = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    data = {} if exitance is None else {"exitance_x": exitance.astype(np.float32)}
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], vertex_attributes=data, process=False)
    mesh.export(folder / "mesh.ply")
    emitter = (
        '<emitter type="fspt_surface"><texture type="mesh_attribute" name="exitance">'
        '<string name="name" value="vertex_exitance"/></texture></emitter>'
    )
    shape = f'<shape type="ply"><string name="filename" value="mesh.ply"/>{emitter}</shape>'
    return scene(folder, shape=shape)


def refused(capfd: pytest.CaptureFixture[str], arguments: list[str], *words: str) -> None:
    """Run `fspt render` with these arguments; it must refuse in one line that holds all of `words`."""
    assert cli.run(["render", *arguments]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("fspt: ")
    assert "Traceback" not in err
    for word in words:
        assert word in err, err


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        ('<float name="focus_distance" value="55"/><float name="pixel_pitch" value="1"/>', ("focus_distance", "55")),
        ('<float name="image_distance" value="50"/><float name="pixel_pitch" value="1"/>', ("image_distance", "50")),
        ('<float name="pixel_pitch" value="1"/>', ("exactly one", "none")),
        (LENS + '<float name="focus_distance" value="165"/>', ("exactly one", "magnification", "focus_distance")),
        (LENS + '<float name="lens_diameter" value="5"/>', ("lens_diameter", "5", "6.875")),
        ('<float name="magnification" value="0.5"/><float name="pixel_pitch" value="0"/>', ("pixel_pitch", "0")),
        ('<float name="magnification" value="0.5"/>', ("pixel_pitch", "missing")),
        (LENS + '<string name="model" value="fisheye"/>', ("model", "fisheye", "hrrt")),
        (LENS + '<string name="model" value="hrrt"/>', ("hrrt", "lens_diameter")),
        (LENS + '<string name="model" value="ripoll"/>', ("numerical_aperture",)),
        (LENS + '<float name="apperture" value="3"/>', ("apperture",)),
    ],
)
def test_lens(folder: Path, capfd: pytest.CaptureFixture[str], lens: str, words: tuple[str, ...]) -> None:
    refused(capfd, [scene(folder, lens=lens)], *words)
    assert sorted(os.listdir(folder)) == ["scene.xml"]


@pytest.mark.parametrize("value", ["0", "-2.8", "nan"])
def test_f_number(folder: Path, capfd: pytest.CaptureFixture[str], value: str) -> None:
    refused(capfd, [scene(folder), "-D", f"f_number={value}"], "f_number", value)


def test_camera_inside(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    refused(capfd, [scene(folder, origin="0, 0, 1")], "inside the phantom", "to_world")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.array([1, -2, 3, 4]), (">= 0", "-2")),
        (np.array([1, np.nan, 3, 4]), ("NaN",)),
        (np.array([1, np.inf, 3, 4]), ("infinite",)),
        (np.zeros(4), ("0 everywhere",)),
        (None, ("vertex_exitance", "exitance_x")),
    ],
)
def test_exitance(
    folder: Path, capfd: pytest.CaptureFixture[str], values: np.ndarray | None, words: tuple[str, ...]
) -> None:
    refused(capfd, [mesh_scene(folder, values)], *words)
    refused(capfd, ["scene.xml", "--method", "path", "--spp", "2"], *words)
    assert sorted(os.listdir(folder)) == ["mesh.ply", "scene.xml"]


@pytest.mark.parametrize("value", ["-1", "nan", "0"])
def test_exitance_number(folder: Path, capfd: pytest.CaptureFixture[str], value: str) -> None:
    refused(capfd, [scene(folder, shape=SPHERE.format(EMITTER.format(value)))], "exitance")


def test_nothing_glows(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    refused(capfd, [scene(folder, shape=SPHERE.format(""))], "nothing glows", "fspt_surface")


def test_mesh_files(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shape = '<shape type="ply"><string name="filename" value="mesh.ply"/>' + EMITTER.format(1) + "</shape>"
    path = scene(folder, shape=shape)
    refused(capfd, [path], "mesh.ply", "not found")
    (folder / "mesh.ply").write_text("no mesh at all")
    refused(capfd, [path], "mesh.ply")
    refused(capfd, [mesh_scene(folder, np.ones(4), vertices=np.zeros((4, 3)))], "area")


def test_scene_files(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    refused(capfd, ["none.xml"], "none.xml")
    (folder / "broken.xml").write_text("<scene><shape></scene>")
    refused(capfd, ["broken.xml"], "broken.xml", "line 1")
    (folder / "unknown.xml").write_text('<scene version="3.0.0"><shape type="spheer"/></scene>')
    refused(capfd, ["unknown.xml"], "spheer")
    (folder / "pinhole.xml").write_text(
        TEMPLATE.replace("fspt_lens", "perspective").format(lens="", shape="", origin="0, 0, 9")
    )
    refused(capfd, ["pinhole.xml"], "pinhole.xml")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-D", "f_nummer=8"], ("f_nummer", "f_number")),
        (["-D", "f_number"], ("-D f_number", "NAME=VALUE")),
        (["--rtol", "-1"], ("rtol", "-1")),
        (["--rtol", "x"], ("--rtol", "number")),
        (["--spp", "16"], ("spp", "16")),
        (["--method", "path", "--rtol", "1e-3"], ("rtol",)),
        (["--method", "path", "--spp", "1"], ("spp", "1")),
        (["--method", "path", "--seed", "-1"], ("seed", "-1")),
        (["--method", "montecarlo"], ("montecarlo", "ptracer")),
        (["-o", "image.png"], ("image.png", ".exr")),
        (["-o", "missing/image.exr"], ("missing", "does not exist")),
        (["--frob"], ("--frob",)),
    ],
)
def test_arguments(
    folder: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], words: tuple[str, ...]
) -> None:
    refused(capfd, [scene(folder), *arguments], *words)
    assert sorted(os.listdir(folder)) == ["scene.xml"]


def test_unwritable_folder(folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The system's answer is replaced: the tests may run as root, who may write anywhere."""
    path = scene(folder)
    monkeypatch.setattr(os, "access", lambda path, mode, **_: mode != os.W_OK)
    refused(capfd, [path], "not writable")


def test_disk_full(folder: Path) -> None:
    """A file-size limit stands for the full disk: the write fails half-way, the old image stays whole."""
    path = scene(folder)
    (folder / "image.exr").write_bytes(b"old")
    code = f"""
import resource, signal, sys
from mitsuba_fspt import cli, image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
write = image.write_exr
def write_to_full_disk(*arguments):
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))
    write(*arguments)
image.write_exr = write_to_full_disk
sys.exit(cli.run(["render", {path!r}, "-o", "image.exr"]))
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2, result.stderr
    assert "image.exr" in result.stderr
    assert "Traceback" not in result.stderr
    assert (folder / "image.exr").read_bytes() == b"old"
    assert sorted(os.listdir(folder)) == ["image.exr", "scene.xml"]


def test_interrupted(folder: Path) -> None:
    """Ctrl-C half-way: exit code 130, one line, no file."""
    path = scene(folder)
    command = [sys.executable, "-m", "mitsuba_fspt", "render", path, "--method", "path", "--spp", "100000000"]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(6)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert out == ""
    assert err.count("\n") == 1, err
    assert "interrupted" in err
    assert sorted(os.listdir(folder)) == ["scene.xml"]
