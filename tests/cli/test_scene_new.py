"""`fspt scene new`: starter scenes render as they are; and what the shell completes."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from small_scenes import SCENES

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import shipped_scenes
from mitsuba_fspt.phantom.starter_scenes import STARTERS

FILM = ["-D", "width=32", "-D", "height=32", "-D", "pixel_pitch=0.864"]
CAMERA = """
[lens]
name = "50 mm"
focal_length = 35
f_number = 2.0
width = 40
height = 40
pixel_pitch = 0.6
transmittance = 0.5

[detector]
quantum_efficiency = 0.9
dark_current = 1e-3
read_noise = 3.5
full_well = 1e5
gain = 1.6
bias = 500
bits = 16
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The nylon cylinder in a folder of its own, as a phantom."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SCENES / "nylon_cylinder.ply", tmp_path / "phantom.ply")
    return tmp_path


def test_the_cylinder_renders_as_it_is(run):
    """Centred, all of it on the film, its side of the radiance J_n/π.

    The ends glow outwards. Seen to fail: dark from below with the lower one not turned over.
    """
    assert run("scene", "new", "cylinder", "-o", "my.xml", *FILM, "--f-number", "8", "--quiet") == (0, "", "")
    assert run("render", "my.xml", "--rtol", "1e-2", "--quiet") == (0, "", "")
    image = fspt.read("my.exr")
    assert image.power.shape == (32, 32)
    assert not image.power[[0, -1]].any()
    assert not image.power[:, [0, -1]].any()
    np.testing.assert_allclose(image.power, image.power[:, ::-1], atol=2e-2 * image.power.max())
    expected = 1e-4 / math.pi * 100 * 660e-9 / (6.62607015e-34 * 299792458.0)
    assert image.to_radiance(660).values[12:20, 14:18] == pytest.approx(expected, rel=0.01)
    text = Path("my.xml").read_text(encoding="utf-8")
    assert text.count("<!--") >= 3
    for up, end in ((1, "upper_end"), (-1, "lower_end")):
        above = text.replace('origin="$distance, 0, 0"', f'origin="0, 0, {up}00"').replace(
            'up="0, 0, 1"', 'up="1, 0, 0"'
        )
        lit = fspt.render(fspt.load(above), rtol=1e-2).power
        assert lit[16, 16] > 0, end


def test_the_rig_shows_three_views(run):
    """Both mirrored images have the direct one's radiance times the reflectance. Seen to fail with one mirror."""
    assert run("scene", "new", "rig", "-o", "my.xml", "--quiet") == (0, "", "")
    assert run("render", "my.xml", "--rtol", "1e-2", "--quiet")[:2] == (0, "")
    radiance = fspt.read("my.exr").to_radiance(660).values
    direct = radiance[64, 192]
    assert direct == pytest.approx(1e-4 / math.pi * 100 * 660e-9 / (6.62607015e-34 * 299792458.0), rel=0.01)
    for half in (radiance[64, :128], radiance[64, 256:]):
        assert half.max() == pytest.approx(0.95 * direct, rel=0.01)
        assert (half > 0.9 * direct).sum() > 20
    assert not radiance[64, [0, 140, 244, 383]].any()


def test_a_mouse_is_the_phantom_that_render_frames(run):
    words = ("scene", "new", "mouse", "--phantom", "phantom.ply", "-o", "my.xml", *FILM)
    code, out, err = run(*words, "--json")
    assert (code, json.loads(out), err) == (0, {"output": "my.xml"}, "")
    assert run("render", "my.xml", "-D", "view=90", "--quiet") == (0, "", "")
    assert run("render", "phantom.ply", "--view", "90", *FILM, "--quiet") == (0, "", "")
    np.testing.assert_array_equal(fspt.read("my.exr").power, fspt.read("phantom.exr").power)


@pytest.mark.parametrize("name", STARTERS)
def test_the_camera_of_a_file_wherever_a_lens_is_made(run, folder, name):
    """And its detector in expose. An option overrules the file."""
    (folder / "retiga.toml").write_text(CAMERA)
    phantom = ["--phantom", "phantom.ply"] if name == "mouse" else []
    words = ("scene", "new", name, *phantom, "-o", "my.xml", "--camera", "retiga.toml", "--f-number", "4", "--quiet")
    assert run(*words) == (0, "", "")
    assert run("render", "my.xml", "--rtol", "0.1", "--quiet")[:2] == (0, "")
    told = fspt.read("my.exr").metadata
    assert (told["focal_length"], told["f_number"], told["transmittance"]) == (35, 4, 0.5)
    assert fspt.read("my.exr").shape == (40, 40)
    words = ("expose", "my.exr", "-o", "e.exr", "--exposure-time", "1", "--wavelength-nm", "660")
    assert run(*words, "--detector", "retiga.toml", "--quiet") == (0, "", "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("rat", "-o", "my.xml"), "the name must be one of cylinder, mouse, rig"),
        (("mouse", "-o", "my.xml"), "mouse frames a phantom, whose PLY is missing. Give --phantom"),
        (("mouse", "-o", "my.xml", "--phantom", "gone.ply"), "gone.ply"),
        (("cylinder", "-o", "my.xml", "--phantom", "phantom.ply"), "cylinder has no place for 'phantom.ply'"),
        (("cylinder", "-o", "phantom.ply"), "must end in .xml"),
        (("cylinder", "-o", "nowhere/my.xml"), "the folder 'nowhere' does not exist"),
        (("cylinder", "-o", "my.xml", "-D", "colour=3"), "'fspt_lens' has no parameter colour"),
        (("cylinder", "-o", "my.xml", "--f-number", "-1"), "'f_number' must be > 0"),
        (("cylinder", "-o", "my.xml", "--camera", "gone.toml"), "'gone.toml' cannot be read"),
    ],
)
def test_what_is_refused_leaves_no_scene(run, words, message):
    code, out, err = run("scene", "new", *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert os.listdir() == ["phantom.ply"]


def test_an_existing_scene_stays(run, folder):
    (folder / "my.xml").write_text("mine")
    code, out, err = run("scene", "new", "cylinder", "-o", "my.xml")
    assert (code, out) == (2, "")
    assert err == "fspt: output file 'my.xml' exists, and may hold work of yours. Give another name.\n"
    assert (folder / "my.xml").read_text() == "mine"


COMPLETE = """
import contextlib, io, json, os, sys
from mitsuba_fspt.cli import main
sys.argv, found = ["fspt"], []
for typed in json.loads(sys.stdin.read()):
    os.environ |= {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split(" ")) - 1)}
    with contextlib.redirect_stdout(io.StringIO()) as told, contextlib.suppress(SystemExit):
        main()
    found.append(told.getvalue().split())
print(json.dumps(found))
"""


def completions(*typed):
    """What the shell offers for the last word of each command line; a process for all takes as long as one for one."""
    environment = os.environ | {"_FSPT_COMPLETE": "complete_bash"}
    call = [sys.executable, "-c", COMPLETE]
    done = subprocess.run(call, env=environment, input=json.dumps(typed), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_the_shell_completes_verbs_options_and_words():
    verbs, options, methods, scenes, units = completions(
        "fspt r",
        "fspt render a.xml --rt",
        "fspt render a.xml --method p",
        "fspt scene new m",
        "fspt render a.xml --unit p",
    )
    assert {"render", "roi"} <= set(verbs)
    assert "stability" not in verbs
    assert {"--rtol"} == set(options)
    assert methods == ["path", "ptracer"]
    assert scenes == ["mouse", "mirror_rig"]
    assert units == ["photons/s", "p/s/cm2/sr"]


@pytest.mark.parametrize("name", ["cylinder", "rig"])
def test_the_starter_scenes_are_well_formed(run, name):
    assert run("scene", "new", name, "-o", "my.xml", "--quiet") == (0, "", "")
    root = ElementTree.parse("my.xml").getroot()
    defaults = {node.get("name") for node in root.iter("default")}
    used = {text[1:] for node in root.iter() for text in node.attrib.values() if text.startswith("$")}
    assert {name.split(",")[0] for name in used} == defaults


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_scene_of_the_package_is_copied_with_its_data(run, name):
    """Byte for byte; a second copy takes the data that is there. Seen to fail without the data files."""
    assert run("scene", "new", name, "-o", "my.xml", "--quiet") == (0, "", "")
    assert run("scene", "new", name, "-o", "again.xml", "--quiet") == (0, "", "")
    for file in set(os.listdir()) - {"my.xml", "again.xml", "phantom.ply"}:
        assert Path(file).read_bytes() == (SCENES / file).read_bytes()
    assert Path("my.xml").read_bytes() == (SCENES / f"{name}.xml").read_bytes()
    for file in re.findall(r'value="([\w]+\.(?:ply|exr))"', Path("my.xml").read_text()):
        assert Path(file).is_file()


def test_a_copy_overwrites_no_other_data(run):
    Path("l_shape.ply").write_text("mine")
    code, out, err = run("scene", "new", "l_shape", "-o", "my.xml")
    assert (code, out) == (2, "")
    assert err == "fspt: scene new: 'l_shape.ply' exists with another content. Give -o in another folder.\n"
    assert sorted(os.listdir()) == ["l_shape.ply", "phantom.ply"]
    code, _, err = run("scene", "new", "l_shape", "-o", "my.xml", "--f-number", "2")
    assert code == 2
    assert err.startswith("fspt: scene new: l_shape is copied as it is.")
