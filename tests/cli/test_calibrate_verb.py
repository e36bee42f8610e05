"""`fspt calibrate`: values, the scene file with them, JSON, sets that are not determined, and bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_scenes import write_scene

import mitsuba_fspt as fspt

# What must come through byte for byte: a comment that looks like a parameter, single quotes, odd spaces, CRLF.
ODD = """\r
    <!-- <default name="distance" value="1"/> -->\r
    <default  value = '0.25'  name='unused' />"""
COARSE = ("--rtol", "5e-3")  # for images with 1 % of noise


@pytest.fixture(scope="module")
def folder(tmp_path_factory, mono):
    """A scene at 165 mm and f/8, and an image of it at 164 mm with 1 % of noise."""
    folder = tmp_path_factory.mktemp("calibrate")
    scene = write_scene(folder / "ball.xml", more=ODD)
    power = fspt.render(fspt.load(scene, distance=164), rtol=1e-3).power.astype(float)
    sigma = np.full(power.shape, 0.01 * power.max())
    noise = sigma * np.random.default_rng(1).standard_normal(power.shape)
    fspt.Image(power + noise, sigma, metadata={"pixel_pitch": 0.8}).write(folder / "image.exr")
    return folder


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def test_values_and_the_fitted_scene(run, folder):
    """The distance comes back; the file differs from the scene in that number alone, and fits without a change."""
    scene, fitted = folder / "ball.xml", folder / "fitted.xml"
    free = ("calibrate", scene, folder / "image.exr", *COARSE, "--free")
    code, out, err = run(*free, "distance", "-o", fitted, "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    value, sd = record["values"]["distance"], record["sd"]["distance"]
    assert record["determined"]
    assert 0 < sd < 0.5
    assert value == pytest.approx(164, abs=4 * sd)
    expected = scene.read_bytes().replace(b'name="distance" value="165"', f'name="distance" value="{value!r}"'.encode())
    assert expected != scene.read_bytes()
    assert fitted.read_bytes() == expected
    code, out, err = run(*free, "distance,gain", "-D", "f_number=8")
    assert (code, err, out.count("\n")) == (0, "", 3)
    assert "gain = " in out
    fitted.unlink()


def test_a_border_is_told(run, folder, caplog):
    """Images 5 % too bright ask for a transmittance of 1.05; it stays at 1, in one line and in the JSON.

    Seen to fail: exit code 2 with the rule of the transmittance, of the first difference from 1.
    """
    text = (folder / "ball.xml").read_bytes().decode()
    plain = '<transform name="to_world">'
    free = text.replace(plain, '<float name="transmittance" value="$tau"/>' + plain, 1)
    (folder / "tau.xml").write_text(free.replace("<sensor", '<default name="tau" value="1"/><sensor', 1))
    image = fspt.read(folder / "image.exr")
    bright = fspt.Image(1.05 * image.power, image.error, metadata=image.metadata)
    bright.write(folder / "bright.exr")
    code, out, _ = run(
        "calibrate", folder / "tau.xml", folder / "bright.exr", "--free", "tau,distance", *COARSE, "--json"
    )
    record = json.loads(out)
    assert (code, record["warnings"]) == (0, [line.removeprefix("fspt: calibrate: ") for line in caplog.messages])
    assert record["warnings"][0].startswith(
        "'tau' ended at 1, the border of the values that the scene allows; at 1.00006: fspt_lens: 'transmittance' must "
        "be > 0 and at most 1, got 1.00006. Give for example 0.9. The minimum lies 10 sd beyond"
    )
    assert record["values"]["tau"] == pytest.approx(1, abs=0.1 * record["sd"]["tau"])


def test_undetermined_parameters_are_reported(run, folder):
    """Gain and f-number scale the image alike: exit code 2, the combination on stderr and as JSON, no file."""
    arguments = ("calibrate", folder / "ball.xml", folder / "image.exr", "--free", "f_number,gain", "--json")
    code, out, err = run(*arguments, "-o", folder / "fitted.xml")
    assert (code, err.count("\n")) == (2, 1)
    assert "do not determine f_number, gain separately" in err
    record = json.loads(out)
    assert not record["determined"]
    assert record["condition"] > 100
    assert abs(record["combinations"][0]["f_number"]) == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert "fitted.xml" not in files(folder)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("image.exr", "--free", "colour"), "no parameter 'colour'"),
        (("image.exr", "--free", ""), "no parameter ''"),
        (("image.exr", "--free", "distance,distance"), "a parameter twice"),
        (("image.exr", "--free", "distance", "-D", "distance=165"), "is free and given"),
        (("image.exr", "--free", "distance", "-D", "f_number=8,4"), "1 images for 2 views"),
        (("image.exr", "image.exr", "--free", "distance"), "2 images for 1 views"),
        (("none.exr", "--free", "distance"), "none.exr"),
        (("image.exr", "--free", "unused"), "unused parameters"),
        (("image.exr", "--free", "distance", "--rtol", "0"), "--rtol"),
        (("image.exr", "--free", "distance", "-o", "fitted.json"), "must end in .xml"),
        (("image.exr", "--free", "distance", "-o", "ball.xml"), "would overwrite"),
    ],
)
def test_bad_input(run, folder, monkeypatch, arguments, words):
    """Exit code 2, one line that says what is wrong, and no file."""
    monkeypatch.chdir(folder)
    before = files(folder)
    code, out, err = run("calibrate", "ball.xml", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
    assert files(folder) == before


@pytest.mark.parametrize(("kind", "name"), [("shape", "filename"), ("sensor", "vignetting"), ("sensor", "spectrum")])
def test_a_fitted_scene_that_would_not_find_its_files_is_refused(run, tmp_path, kind, name):
    (tmp_path / "other").mkdir()
    (tmp_path / "mesh.ply").write_text("ply\n")
    mesh = f'<{kind} type="ply"><string name="{name}" value="mesh.ply"/></{kind}>'
    text = f'<scene version="3.0.0"><default name="distance" value="165"/>{mesh}</scene>'
    (tmp_path / "mesh.xml").write_text(text)
    arguments = (tmp_path / "mesh.xml", tmp_path / "none.exr", "--free", "distance")
    code, out, err = run("calibrate", *arguments, "-o", tmp_path / "other" / "fitted.xml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"names 'mesh.ply' beside it, which is not in '{tmp_path / 'other'}'" in err
    assert not list((tmp_path / "other").iterdir())
