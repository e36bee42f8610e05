"""`fspt render PHANTOM.ply`: an image for each view, and the options that belong to it."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from small_scenes import LENS_XML, SCENES, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.cli import render as verb

FILM = ["-D", "width=24", "-D", "height=24", "-D", "pixel_pitch=1.152"]
FEW = [*FILM, "--rtol", "1e-2"]


@pytest.fixture(autouse=True)
def phantom(tmp_path, monkeypatch):
    """The nylon cylinder in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SCENES / "nylon_cylinder.ply", tmp_path / "phantom.ply")


def files():
    """What lies beside the phantom."""
    return sorted(set(os.listdir()) - {"phantom.ply", "camera.toml"})


def test_a_file_for_each_view(run):
    code, out, err = run(
        "render",
        "phantom.ply",
        "--view",
        "0,90",
        "--focal-length",
        55,
        "--f-number",
        8,
        "-D",
        "magnification=0.5",
        *FEW,
    )
    assert (code, err) == (0, "")
    assert files() == ["phantom_view0.exr", "phantom_view90.exr"]
    assert [line.split(":")[0] for line in out.splitlines()] == files()
    for view in (0, 90):
        image = fspt.read(f"phantom_view{view}.exr")
        film = {"width": 24, "height": 24, "pixel_pitch": 1.152}
        shipped = fspt.render(fspt.load(SCENES / "nylon_cylinder.xml", view=view, **film), rtol=1e-2)
        np.testing.assert_array_equal(image.power, shipped.power.astype(np.float32))
        assert image.metadata["f_number"] == 8


def test_the_header_reproduces_the_file(run):
    run("render", "phantom.ply", "--view", "30", "--focal-length", 35, *FEW, "-o", "a.exr")
    first = fspt.read("a.exr")
    scene, *parameters = first.metadata["scene"].split(" ")
    define = [word for parameter in parameters for word in ("-D", parameter)]
    assert run("render", scene, *define, "--rtol", first.metadata["rtol"], "-o", "b.exr")[0] == 0
    assert files() == ["a.exr", "b.exr"]
    np.testing.assert_array_equal(fspt.read("b.exr").power, first.power)


def test_a_single_view_has_the_name_that_was_given(run):
    """Seen to be written as mc_view90.exr."""
    assert run("render", "phantom.ply", "--view", "90", *FEW, "-o", "mc.exr")[0] == 0
    assert files() == ["mc.exr"]
    assert run("render", "phantom.ply", *FEW)[0] == 0
    assert files() == ["mc.exr", "phantom.exr"]
    assert fspt.read("mc.exr").metadata["scene"].startswith("phantom.ply f_number=1.8 view=90 ")


def test_explain_takes_a_phantom_like_render(run):
    code, out, err = run("explain", "phantom.ply", "--view", "30", "--f-number", 8, *FILM, "--rtol", "0.1")
    assert (code, err) == (0, "")
    assert "left out" in out
    code, _, err = run("explain", "phantom.ply", "--view", "0,90", *FEW)
    assert (code, "--view 0,90: must be one number of degrees here" in err) == (2, True)
    code, _, err = run("explain", SCENES / "l_shape.xml", "--f-number", "8")
    assert (code, "--f-number goes with PHANTOM.ply" in err) == (2, True)


def test_a_focus_on_the_command_line_takes_the_place_of_that_of_the_camera(run):
    """As -D of any other number does; seen to be refused as two focuses."""
    with open("camera.toml", "w") as file:
        file.write("[lens]\nfocal_length = 55\nf_number = 8\nfocus_distance = 200\n")
    camera = ["phantom.ply", "--camera", "camera.toml", *FEW]
    for focus, more in ((55 / (200 - 55), []), (0.5, ["-D", "magnification=0.5"])):
        assert run("render", *camera, *more, "-o", "x.exr")[0] == 0
        assert fspt.read("x.exr").metadata["magnification"] == pytest.approx(focus, rel=1e-6)


def test_a_camera_file_options_and_a_range(run):
    content = "[lens]\nfocal_length = 55\nf_number = 8\nmagnification = 0.5\nwidth = 24\nheight = 24\n"
    with open("camera.toml", "w") as file:
        file.write(content + "pixel_pitch = 1.152\n[detector]\ngain = 1\n")
    views = ["--view", "-60:61:60", "--f-number", 4, "--rtol", "1e-2"]
    code, _, err = run("render", "phantom.ply", "--camera", "camera.toml", *views, "-o", "x.exr", "--png")
    assert (code, err) == (0, "")
    assert files() == sorted(f"x_view{v}.{kind}" for v in (-60, 0, 60) for kind in ("exr", "png"))
    told = fspt.read("x_view-60.exr").metadata
    assert (told["focal_length"], told["f_number"], told["magnification"]) == (55, 4, 0.5)
    assert fspt.read("x_view0.exr").shape == (24, 24)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["phantom.ply", "--view", "0,0"], "must be different numbers of degrees, got '0'"),
        (["phantom.ply", "--view", "left"], "must be different numbers of degrees, got 'left'"),
        (["phantom.ply", "--view", "0:90:-5"], "view=0:90:-5: the step -5 does not lead from 0 to 90"),
        (["phantom.ply", "--f-number", "2", "-D", "f_number=4"], "-D f_number=4: --f-number gives it already"),
        (["phantom.ply", "--f-number", "0"], "'f_number' must be > 0"),
        (["phantom.ply", "--camera", "none.toml"], "'none.toml' cannot be read"),
        (["phantom.ply", "-D", "colour=3"], "'fspt_lens' has no parameter colour"),
        (["phantom.ply", "-D", "width=wide"], "'width' must be a whole number, got 'wide'"),
        (["phantom.ply", "-o", "x.jpg"], "must end in .exr, .fits"),
        (["phantom.ply", "-o", "no/x.exr"], "the folder 'no' does not exist"),
        (["phantom.ply", "--sensor", "1"], "sensor 1 does not exist"),
        (["none.ply"], "no such file"),
        ([SCENES / "l_shape.ply"], "must have one property with J_n"),
        ([SCENES / "l_shape.xml", "--view", "90"], "--view goes with PHANTOM.ply"),
        ([SCENES / "l_shape.xml", "--focal-length", "50"], "--focal-length goes with PHANTOM.ply"),
    ],
)
def test_what_is_refused(run, arguments, message):
    code, out, err = run("render", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert files() == []


def test_ctrl_c_names_the_views_that_are_written(run, monkeypatch):
    write = verb.Output.write

    def interrupted(self, image, output, picture):
        if output.name == "phantom_view90.exr":
            raise KeyboardInterrupt
        write(self, image, output, picture)

    monkeypatch.setattr(verb.Output, "write", interrupted)
    code, _, err = run("render", "phantom.ply", "--view", "0,90", *FEW)
    assert (code, files()) == (130, ["phantom_view0.exr"])
    assert "interrupted; 1 of 2 images are written: phantom_view0.exr." in err


def test_any_sensor_of_a_scene(run, tmp_path):
    path = write_scene(tmp_path / "two.xml", sensor=LENS_XML + LENS_XML.replace('"0.8"', '"0.4"'))
    for number, pitch in enumerate((0.8, 0.4)):
        assert run("render", path, "--sensor", number, "-o", "o.exr")[0] == 0
        image = fspt.read("o.exr")
        assert (image.metadata["sensor"], image.metadata["pixel_pitch"]) == (number, pytest.approx(pitch))
    code, out, _ = run("explain", path, "--sensor", 1, "--rtol", "0.1")
    assert code == 0
    assert "left out" in out
    code, _, err = run("explain", path, "--sensor", 2)
    assert code == 2
    assert "sensor 2 does not exist" in err
