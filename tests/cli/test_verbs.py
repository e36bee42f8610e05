"""The command line: what each verb prints, writes and returns, and what the header of its image tells."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import pytest
import typer
from small_scenes import BALL_XML, LENS_XML, SCENES, write_ply, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.cli import app
from mitsuba_fspt.rendering import render
from mitsuba_fspt.runtime import backend, doctor

SMALL = ["-D", "width=12", "-D", "height=10", "-D", "pixel_pitch=2.304", "--rtol", "1e-2"]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def header(path):
    """Header attributes under `fspt:` as OpenEXR reads them."""
    with OpenEXR.File(str(path)) as file:
        return {key: value for key, value in file.header().items() if key.startswith("fspt:")}


# --- render ---


def test_render_writes_the_scenes_name_into_the_current_folder(run, tmp_path):
    code, out, err = run("render", SCENES / "two_spheres.xml", *SMALL)
    assert (code, err) == (0, "")
    assert re.fullmatch(r"two_spheres\.exr: total \S+ W, brightest pixel \S+ W, \S+ s\n", out)
    assert os.listdir(tmp_path) == ["two_spheres.exr"]
    image = fspt.read("two_spheres.exr")
    assert image.shape == (10, 12)
    assert float(re.search(r"total (\S+) W", out)[1]) == pytest.approx(image.power.sum(), rel=1e-5)
    with OpenEXR.File("two_spheres.exr", separate_channels=True) as file:
        assert set(file.channels()) == {"Y", "error.Y", "coverage.Y"}
        assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("scene", sorted(SCENES.glob("*.xml")), ids=lambda path: path.stem)
def test_every_scene_of_the_package_renders(run, scene):
    """By its own integrator, small."""
    integral = "fspt_integral" in scene.read_text()
    few = SMALL[-2:] if integral else ["--spp", "2"]
    code, _, err = run("render", scene, "-o", "o.exr", *SMALL[:-2], *few)
    assert code == 0
    assert err == "" or err.startswith("fspt: o.exr: rtol 0.01 not reached on 1 pixels")  # a texel's corner
    image = fspt.read("o.exr")
    assert image.power.max() > 0
    assert image.metadata["method"] == "integral" or not integral


def test_render_with_a_picture_beside(run, tmp_path):
    code, out, err = run("render", SCENES / "l_shape.xml", *SMALL, "-o", "letter.exr", "--png")
    assert (code, err) == (0, "")
    assert out.splitlines()[1].startswith("letter.png: ")
    assert set(os.listdir(tmp_path)) == {"letter.exr", "letter.png"}


def test_mitsubas_warnings_stay_out_of_the_output(run, tmp_path):
    """A film in colour draws one from Mitsuba, a scene that loses rays one from the integrator."""
    import small_scenes

    write_ply(tmp_path / "a.ply", [(0, -3, -3), (0, 3, -3), (0, 3, 3)], [(0, 1, 2)], vertex=[1, 1, 1])
    sensor = small_scenes.LENS_XML.replace('value="luminance"', 'value="rgb"')
    write_scene(tmp_path / "s.xml", sensor=sensor)
    for method in ("integral", "path"):
        code, out, err = run("render", "s.xml", "--method", method, *(["--spp", 4] if method == "path" else []))
        assert (code, err, len(out.splitlines())) == (0, "", 1)


# --- the header ---

LENS_NUMBERS = {
    "model": "diaphragm",
    "focal_length": 55.0,
    "f_number": 4.0,
    "diaphragm_diameter": 13.75,
    "focus_distance": 165.0,
    "image_distance": 82.5,
    "magnification": 0.5,
    "pixel_pitch": 0.8,
}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--rtol", "5e-3"], {"method": "integral", "rtol": 5e-3, "domain": "pupil", "pixel": "area"}),
        (["--domain", "surface", "--rtol", "1e-2"], {"method": "integral", "rtol": 1e-2, "domain": "surface"}),
        (["--method", "path", "--spp", "70", "--seed", "9"], {"method": "path", "seed": 9, "spp": 96, "passes": 32}),
        (["--method", "ptracer", "--spp", "64"], {"method": "ptracer", "seed": 0, "spp": 64, "passes": 32}),
    ],
)
def test_the_header_reproduces_the_file(run, tmp_path, options, told):
    write_scene(tmp_path / "s.xml")
    code, *_ = run("render", "s.xml", *options, "-D", "f_number=4", "-D", "distance=170", "-o", "first.exr")
    assert code == 0
    raw, image = header("first.exr"), fspt.read("first.exr")
    story = image.metadata
    assert {f"fspt:{key}" for key in story} == set(raw)
    expected = {"quantity": "power", "unit": "W", "scene": "s.xml f_number=4 distance=170"} | LENS_NUMBERS | told
    for key, value in expected.items():
        assert story[key] == (pytest.approx(value) if isinstance(value, float) else value), key
    for package in ("mitsuba-fspt", "mitsuba", "drjit", "numpy"):
        assert re.search(rf"(^|, ){package} \d+\.\d+", story["versions"])
    assert story["variant"].split("_")[0] in ("llvm", "cuda")
    assert 0 < story["wall_time"] < 600
    if told["method"] == "integral":
        assert story["nodes"] > 0
        again = ["--rtol", story["rtol"], "--domain", story["domain"]]
    else:
        again = ["--spp", story["spp"], "--seed", story["seed"]]
    scene, *parameters = story["scene"].split(" ")
    define = [word for parameter in parameters for word in ("-D", parameter)]
    assert run("render", scene, *define, "--method", story["method"], *again, "-o", "again.exr")[0] == 0
    repeated = fspt.read("again.exr")
    for name in ("power", "error", "coverage"):
        tolerance = 1e-5 * getattr(image, name).max() if told["method"] == "ptracer" else 0
        np.testing.assert_allclose(getattr(repeated, name), getattr(image, name), rtol=0, atol=tolerance)


# --- help ---


def commands(group, path=()):
    """Every verb below a group, with its words."""
    for name, command in group.commands.items():
        yield from commands(command, (*path, name)) if hasattr(command, "commands") else [((*path, name), command)]


VERBS = dict(commands(typer.main.get_command(app.app)))


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_help_shows_every_word_of_it(run, words):
    """Units in brackets, too: seen to fail with rich, which takes [s] for markup and prints 'Exposure time .'."""
    code, out, err = run(*words, "--help")
    assert (code, err) == (0, "")
    text = " ".join(out.split())
    assert "[mm]" in text or words != ("render",)
    for parameter in VERBS[words].params:
        told = getattr(parameter, "help", None)
        assert not told or " ".join(told.split()) in text.replace("- ", "-"), told


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_every_verb_takes_json_and_quiet(words):
    names = {name for parameter in VERBS[words].params for name in parameter.opts}
    assert {"--json", "--quiet"} <= names


def test_render_as_json_and_quiet(run, tmp_path):
    """A warning stays on stderr. Seen to fail with the warning among the results."""
    shapes = BALL_XML.replace('value="1e-3"', 'value="0"')
    for name, words in (("s", {}), ("dark", {"shapes": shapes})):
        write_scene(tmp_path / f"{name}.xml", **words)
    code, out, err = run("render", "s.xml", "--png", "--json")
    assert (code, err) == (0, "")
    (told,) = json.loads(out)["images"]
    image = fspt.read("s.exr")
    assert told == {
        "output": "s.exr",
        "picture": "s.png",
        "total_power": pytest.approx(image.power.sum(dtype=float)),
        "power_unit": "W",
        "peak": pytest.approx(image.power.max()),
        "unit": "W",
        "wall_time": image.metadata["wall_time"],
    }
    code, out, err = run("render", "dark.xml", "--quiet")
    assert (code, out) == (0, "")
    assert err.startswith("fspt: dark.exr: the picture is dark")
    code, out, _ = run("render", "dark.xml", "--json")
    assert "the picture is dark" in json.loads(out)["images"][0]["warnings"]


# --- the other verbs ---


@pytest.fixture
def two_images(tmp_path):
    y, x = np.mgrid[0:6, 0:8]
    for name, factor in (("a.exr", 1.0), ("b.exr", 1.1)):
        fspt.Image(1e-9 * (1 + x + factor * y)).write(tmp_path / name)
    return "a.exr", "b.exr"


def test_compare_prints_the_metrics(run, two_images):
    code, out, err = run("compare", *two_images)
    assert (code, err) == (0, "")
    truth = fspt.compare(*map(fspt.read, two_images))
    assert f"ME     {truth.me:.3e}" in out
    assert f"CF     {truth.cf:.7f}" in out
    assert f"max    {truth.max_error:.3e}" in out
    assert f"RMS    {truth.rms:.3e}" in out
    assert f"ratio  {truth.ratio:.6f}" in out


def test_compare_reports_an_image_without_errors(run, two_images, tmp_path):
    image = fspt.read("a.exr")
    fspt.Image(image.power, 1e-12 + 0 * image.power, metadata={"method": "integral"}).write("c.exr")
    code, out, err = run("compare", "c.exr", "b.exr")
    assert (code, err) == (0, "fspt: b.exr: it has no plane of errors; its power is taken as exact.\n")
    assert "beyond 40 " in out  # b differs from a in all rows but the first


def test_compare_as_json_is_one_object(run, two_images):
    code, out, err = run("compare", *two_images, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    truth = fspt.compare(*map(fspt.read, two_images))
    assert told["me"] == truth.me
    assert told["cf"] == truth.cf
    assert told["rms"] == truth.rms
    assert [profile["line"] for profile in told["profiles"]] == ["row", "column"]
    assert run("compare", *two_images, "--quiet") == (0, "", "")
    assert told["profiles"][0]["standard"] == pytest.approx(fspt.read("b.exr").power[5].tolist())


def test_expose_writes_electrons_and_counts(run, two_images, tmp_path):
    options = ["--exposure-time", "1", "--wavelength-nm", "600"]
    code, out, err = run("expose", "a.exr", "-o", "e.exr", *options, "--counts", "n.png")
    assert (code, err) == (0, "")
    assert re.fullmatch(r"e\.exr: brightest pixel \S+ electrons, \d+ pixels saturated\n", out)
    assert {"e.exr", "n.png"} < set(os.listdir(tmp_path))
    assert header("e.exr")["fspt:quantity"] == "electrons"
    code, out, err = run("expose", "a.exr", "-o", "e.exr", *options, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    with OpenEXR.File("e.exr") as file:
        assert told.pop("peak") == file.channels()["Y"].pixels.max() > 0
    assert told == {"output": "e.exr", "counts": None, "saturated_pixels": header("e.exr")["fspt:saturated_pixels"]}
    assert run("expose", "a.exr", "-o", "e.exr", *options, "--quiet") == (0, "", "")


@pytest.mark.parametrize("suffix", [".fits", ".npz"])  # how each format is written: tests/images/test_formats.py
def test_every_verb_takes_every_format(run, tmp_path, suffix):
    """The same image in each; seen to fail with .exr as the only suffix."""
    write_scene(tmp_path / "s.xml")
    assert run("render", "s.xml", "--rtol", "1e-2", "-o", f"a{suffix}", "--quiet") == (0, "", "")
    assert run("render", "s.xml", "--rtol", "1e-2", "-o", "b.exr", "--quiet") == (0, "", "")
    np.testing.assert_array_equal(fspt.read(f"a{suffix}").power, fspt.read("b.exr").power)
    code, out, err = run("compare", f"a{suffix}", "b.exr", "--json")
    assert (code, err, json.loads(out)["max_error"]) == (0, "", 0)
    options = ["--exposure-time", "1", "--wavelength-nm", "600"]
    assert run("expose", f"a{suffix}", "-o", f"e{suffix}", *options, "--quiet") == (0, "", "")
    assert run("plot", f"a{suffix}", "--quiet") == (0, "", "")
    words = ("sweep", "s.xml", "-D", "f_number=4,8", "--rtol", "1e-2", "--format", suffix[1:], "--json")
    for reused in (False, True):
        points = json.loads(run(*words)[1])["points"]
        assert [point["file"] for point in points] == [f"s_sweep/s_f_number={n}{suffix}" for n in (4, 8)]
        assert all(point["reused"] is reused for point in points)
    assert {f"a{suffix}", f"e{suffix}", "a.png"} < set(os.listdir(tmp_path))


def test_a_format_that_is_none(run, tmp_path):
    write_scene(tmp_path / "s.xml")
    code, out, err = run("sweep", "s.xml", "-D", "f_number=4", "--format", "jpg")
    assert (code, out) == (2, "")
    assert err == "fspt: sweep: 'format' must be one of exr, fits, h5, npz, tif, got 'jpg'. Give for example exr.\n"
    assert os.listdir(tmp_path) == ["s.xml"]


def test_plot_draws_images_from_their_files(run, two_images, tmp_path):
    code, out, err = run("plot", "a.exr")
    assert (code, out, err) == (0, "a.png: 1 image\n", "")
    code, out, err = run("plot", *two_images, "--range", "1e-12,1e-7", "--json")
    assert (code, err) == (0, "")
    powers = [fspt.read(name).power.sum(dtype=float) for name in two_images]
    record = {"output": "plot.png", "images": [*two_images], "total_power": pytest.approx(powers), "power_unit": "W"}
    record["masked"] = [0, 0]
    assert json.loads(out) == record
    assert run("plot", *two_images, "--log", "--per-panel", "-o", "b.png", "--quiet") == (0, "", "")
    assert set(os.listdir(tmp_path)) == {*two_images, "a.png", "b.png", "plot.png"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--range", "1"), "--range 1: must be two numbers A,B in W/pixel, for example --range 0,1e-9."),
        (("--range", "2,1"), "picture: the range must be A < B in W/pixel, got 2,1. Give 0,1e-9."),
        (("--outline",), "picture: an image without coverage has no outline. Leave it out, or give one that"),
        (("--per-panel",), "--per-panel has no meaning for one image, which has its own scale. Leave it out."),
        (("-o", "a.jpg"), "output file 'a.jpg' must end in .png. Give a name such as picture.png."),
        (("none.exr",), "image file 'none.exr' does not exist. Give the path of an image that fspt wrote."),
    ],
)
def test_plots_that_cannot_be_drawn(run, two_images, tmp_path, options, message):
    code, out, err = run("plot", "a.exr", *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"fspt: {message}")
    assert set(os.listdir(tmp_path)) == set(two_images)


EXPOSE = ("expose", "a.exr", "-o", "e.exr", "--exposure-time", "1", "--wavelength-nm", "600")


def test_plot_draws_electrons(run, two_images, tmp_path):
    assert run(*EXPOSE, "--quiet") == (0, "", "")
    assert run("plot", "e.exr") == (0, "e.png: 1 image\n", "")
    code, out, err = run("plot", "e.exr", "a.exr", "--per-panel", "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    total, power = fspt.read("a.exr").power.sum(dtype=float), record["total_power"]
    assert power == [None, pytest.approx(total)]
    with OpenEXR.File("e.exr", separate_channels=True) as file:
        electrons = file.channels()["Y"].pixels.sum(dtype=float)
    assert record["total_electrons"] == [pytest.approx(electrons), None]
    for options, message in [
        (("a.exr",), "W and e- have no common colour scale. Draw a scale for each panel"),
        (("--unit", "photons/s", "--wavelength-nm", "600"), "electrons have no unit 'photons/s' and no wavelength"),
        (("--outline",), "an image without coverage has no outline."),
    ]:
        code, out, err = run("plot", "e.exr", *options, "-o", "c.png")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"fspt: picture: {message}")
    assert not (tmp_path / "c.png").exists()


def test_expose_with_a_camera_of_ones_own(run, two_images, tmp_path):
    """An option replaces the file's number, and the file the typical camera's; the source's power scales all.

    Seen to fail with the file in place of the option, and with the power of the source left out.
    """
    table = "quantum_efficiency = 0.5\ndark_current = 0\nread_noise = 0\nfull_well = 1e6\ngain = 2\nbias = 7\nbits = 12"
    (tmp_path / "c.toml").write_text(f"[lens]\nfocal_length = 50\n[detector]\n{table}\n")
    options = ["--detector", "c.toml", "--gain", "4", "--bits", "16", "--source-power", "1e-5"]
    code, _, err = run(*EXPOSE, *options)
    assert (code, err) == (0, "")
    told = header("e.exr")
    expected = {"quantum_efficiency": 0.5, "dark_current": 0, "read_noise": 0, "full_well": 1e6, "gain": 4, "bias": 7}
    for name, value in (expected | {"bits": 16, "source_power": 1e-5}).items():
        assert np.asarray(told[f"fspt:{name}"]) == value
    with OpenEXR.File("e.exr", separate_channels=True) as file:
        electrons = file.channels()["Y"].pixels
    # 13 nW at 1 W of source, 1e-5 of it, 600 nm: 3.3107e-19 J a photon; shot noise of four standard deviations
    mean = 0.5 * 13e-9 * 1e-5 / 3.31074e-19
    assert electrons[-1, -1] == pytest.approx(mean, abs=4 * mean**0.5)


def test_the_power_of_the_source_is_given_once(run, tmp_path):
    """`render` records it, and `expose` does not multiply by it again."""
    write_scene(tmp_path / "s.xml")
    assert run("render", "s.xml", "--rtol", "1e-2", "-o", "one.exr")[0] == 0
    code, out, err = run("render", "s.xml", "--rtol", "1e-2", "-o", "a.exr", "--source-power", "2e-9")
    assert (code, err) == (0, "")
    one, scaled = fspt.read("one.exr"), fspt.read("a.exr")
    np.testing.assert_allclose(scaled.power, 2e-9 * one.power.astype(float), rtol=1e-6)
    np.testing.assert_allclose(scaled.error, 2e-9 * one.error.astype(float), rtol=1e-6)
    assert scaled.metadata["source_power"] == 2e-9
    assert float(re.search(r"total (\S+) W", out)[1]) == pytest.approx(scaled.power.sum(), rel=1e-5)
    assert run(*EXPOSE)[0] == 0
    os.remove("e.exr")
    code, out, err = run(*EXPOSE, "--source-power", "1")
    assert (code, out) == (2, "")
    assert err == (
        "fspt: image: 'source_power' is 2e-09 W already, got 1 W. Leave it out, or render the image without it.\n"
    )
    assert not (tmp_path / "e.exr").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--detector", "none.toml"), "'none.toml' cannot be read: No such file or directory. Check the name."),
        (("--gain", "0"), "detector: 'gain' must be finite and > 0 e-/DN, for example 1.6, got 0.0."),
        (("--source-power", "-1"), "image: 'source_power' must be finite and > 0 W, got -1. Give for example 1e-9."),
    ],
)
def test_cameras_and_sources_that_do_not_exist(run, two_images, tmp_path, options, message):
    before = set(os.listdir(tmp_path))
    assert run(*EXPOSE, *options) == (2, "", f"fspt: {message}\n")
    assert set(os.listdir(tmp_path)) == before


def test_a_source_without_power_is_refused_before_the_work(run, tmp_path, monkeypatch):
    monkeypatch.setattr(render, "render", lambda *_, **__: pytest.fail("the work began"))
    code, _, err = run("render", write_scene(tmp_path / "s.xml"), "--source-power", "nan")
    assert (code, err.count("\n")) == (2, 1)
    assert "'source_power' must be finite and > 0 W, got nan" in err
    assert os.listdir(tmp_path) == ["s.xml"]


@pytest.mark.parametrize("counts", ["n.jpg", "nowhere/n.png", ""])
def test_expose_leaves_both_files_or_none(run, two_images, tmp_path, counts):
    """Fails with the electrons written before the counts' place is looked at."""
    before = set(os.listdir(tmp_path))
    options = ["--exposure-time", "1", "--wavelength-nm", "600", "--counts", counts]
    code, _, err = run("expose", "a.exr", "-o", "e.exr", *options)
    assert code == 2
    assert err.count("\n") == 1
    assert set(os.listdir(tmp_path)) == before


def test_more_pixels_than_the_memory_suffices_for(run, tmp_path):
    sensor = LENS_XML.replace('"width" value="8"', '"width" value="1000000"').replace('value="6"', 'value="1000000"')
    code, _, err = run("render", write_scene(tmp_path / "s.xml", sensor=sensor), "-o", tmp_path / "o.exr")
    assert (code, err.count("\n")) == (2, 1)
    assert "a film of 1000000 x 1000000 pixels needs" in err
    assert not (tmp_path / "o.exr").exists()


@pytest.mark.parametrize("verb", ["render", "expose"])
def test_a_name_too_long_is_refused_before_the_work(run, two_images, tmp_path, monkeypatch, verb):
    """Seen to fail: code 1 with an OSError, and after the work."""
    write_scene(tmp_path / "s.xml")
    monkeypatch.setattr(render, "render", lambda *_, **__: pytest.fail("the work began"))
    before, name = sorted(os.listdir(tmp_path)), "x" * 252 + ".exr"
    what = ["s.xml"] if verb == "render" else ["a.exr", "--exposure-time", "1", "--wavelength-nm", "600"]
    code, out, err = run(verb, *what, "-o", name)
    assert (code, out) == (2, "")
    assert err == f"fspt: output file '{name}' cannot be written: File name too long. Give another name.\n"
    assert sorted(os.listdir(tmp_path)) == before


def test_expose_does_not_overwrite_the_power(run, two_images):
    before = fspt.read("a.exr").metadata
    code, _, err = run("expose", "a.exr", "-o", "a.exr", "--exposure-time", "1", "--wavelength-nm", "600")
    assert code == 2
    assert "output file 'a.exr': -o would overwrite 'a.exr', which is needed too. Give another name." in err
    assert fspt.read("a.exr").metadata == before


@pytest.mark.parametrize("counts", ["e.tif", "./e.tif", "a.tif"])
def test_expose_keeps_counts_apart_from_electrons_and_power(run, two_images, tmp_path, counts):
    """Seen to fail: exit code 0, and counts in the place of the electrons or of the power."""
    fspt.read("a.exr").write("a.tif")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    options = ["--exposure-time", "1", "--wavelength-nm", "600", "--counts", counts]
    code, out, err = run("expose", "a.tif", "-o", "e.tif", *options)
    assert (code, out) == (2, "")
    name = counts.removeprefix("./")
    assert err == (
        f"fspt: output file '{name}': --counts would overwrite '{name}', which is needed too. Give another name.\n"
    )
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("output", ["", ".exr", "picture"])
def test_render_wants_a_name_for_its_image(run, tmp_path, output):
    code, _, err = run("render", write_scene(tmp_path / "s.xml"), "-o", output)
    assert code == 2
    assert err.endswith("must end in .exr, .fits, .h5, .npz or .tif. Give a name such as image.exr.\n")


def test_flux_import_makes_a_phantom_that_renders(run, tmp_path):
    vertices = [(0, -3, -3), (0, 3, -3), (0, 3, 3), (0, -3, 3)]
    write_ply(tmp_path / "sheet.ply", vertices, [(0, 1, 2), (0, 2, 3)])
    (tmp_path / "values.txt").write_text("1e-3\n2e-3\n3e-3\n2e-3\n")
    options = ["--values", "values.txt", "--per", "vertex", "-o", "phantom.ply", "--json"]
    code, out, err = run("flux", "import", "sheet.ply", *options)
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["power"] == pytest.approx(36 * 2e-3)
    shapes = """
    <shape type="ply"><string name="filename" value="phantom.ply"/><emitter type="fspt_surface">
        <texture type="mesh_attribute" name="exitance"><string name="name" value="vertex_exitance"/></texture>
    </emitter></shape>"""
    write_scene(tmp_path / "s.xml", shapes=shapes)
    assert run("render", "s.xml", "--rtol", "1e-2")[0] == 0
    assert fspt.read("s.exr").power.max() > 0


@pytest.mark.parametrize("works", [True, False])
def test_doctor_says_whether_it_is_ready(run, monkeypatch, works):
    """The trials of the backends are another file's tests; here, what becomes of their outcome."""
    times = {name: 0.1 for name in ("import", "variant", "scene", "first", "second")}
    monkeypatch.setattr(doctor, "run_trial", lambda variant: times if works else "no LLVM here")
    code, out, err = run("doctor")
    assert err == ""
    assert code == (0 if works else 2)
    assert ("ready" in out) is works
    assert "LLVM" in out
    assert "mitsuba-fspt" in out
    code, out, err = run("doctor", "--json")
    assert (code, err) == (0 if works else 2, "")
    assert json.loads(out)["usable"] is works
    assert {"versions", "backends"} < {row["section"] for row in json.loads(out)["rows"]}


def test_an_output_without_the_letters_does_not_end_the_work(tmp_path):
    """Seen to fail with code 1 and a UnicodeEncodeError."""
    write_scene(tmp_path / "ü.xml")
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}

    def told(*arguments):
        command = [sys.executable, "-m", "mitsuba_fspt", *arguments]
        return subprocess.run(command, env=environment, check=True, capture_output=True).stdout.decode()

    assert told("render", "ü.xml", "--rtol", "0.5").startswith("ü.exr: total ")
    assert fspt.read("ü.exr").power.max() > 0
    assert "NAME=V1,V2,..." in told("sweep", "--help")


def test_version_and_help(run):
    code, out, err = run("--version")
    assert (code, err) == (0, "")
    assert re.fullmatch(r"mitsuba-fspt \d+\.\d+\.\d+\S*\n", out)
    code, out, err = run("--help")
    assert (code, err) == (0, "")
    for verb in ("render", "plot", "compare", "expose", "doctor", "flux", "converge"):
        assert verb in out
    for verb in ("render", "plot", "compare", "expose", "doctor", "flux", "converge"):
        code, out, err = run(verb, "--help")
        assert (code, err) == (0, "")
        assert "Usage: fspt " + verb in out


DOCUMENTS = [SCENES.parent / "README.md", *sorted((SCENES.parent / "docs").glob("*.md"))]
LINES = [line.strip() for document in DOCUMENTS for line in document.read_text().splitlines()]


@pytest.mark.parametrize("line", [line for line in LINES if line.startswith("fspt ")])
def test_the_documents_name_verbs_and_options_that_are_there(line):
    """Parsed like any call and not run; what stands for something else, in brackets or after |, is left out."""
    words = shlex.split(re.sub(r"\[|\]|\|\S+", " ", line), comments=True)[1:]
    verb, name = typer.main.get_command(app.app), "fspt"
    while hasattr(verb, "commands"):
        name = words.pop(0)
        assert name in verb.commands
        verb = verb.commands[name]
    verb.make_context(name, words)


# --- processes ---


def test_python_dash_m_is_the_command():
    done = subprocess.run([sys.executable, "-m", "mitsuba_fspt", "--version"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("mitsuba-fspt ")
    assert done.stderr == ""


def test_a_closed_pipe_is_no_error():
    """`fspt --help | head -1`."""
    done = subprocess.run(
        f"{sys.executable} -m mitsuba_fspt --help | head -c 1", shell=True, capture_output=True, text=True
    )
    assert done.stderr == ""


def test_ctrl_c_while_the_picture_is_drawn_leaves_no_image(run, tmp_path, monkeypatch):
    """Seen to fail with the image written first."""
    from matplotlib.figure import Figure

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", interrupted)
    write_scene(tmp_path / "s.xml")
    code, out, err = run("render", tmp_path / "s.xml", "-o", tmp_path / "a.exr", "--png")
    assert (code, out, err) == (130, "", "fspt: interrupted; nothing was written.\n")
    assert os.listdir(tmp_path) == ["s.xml"]


def test_ctrl_c_leaves_one_line_and_no_file(tmp_path):
    """On a terminal, which shows progress: the signal comes once the sampling has begun, whose passes are short."""
    write_scene(tmp_path / "s.xml")
    terminal, slave = pty.openpty()
    spp = "10000000" if backend.choose_variant().startswith("cuda") else "2000000"
    command = [sys.executable, "-m", "mitsuba_fspt", "render", "s.xml", "--method", "path", "--spp", spp]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, cwd=tmp_path)
    os.close(slave)
    shown, sent, deadline = b"", False, time.monotonic() + 100
    while time.monotonic() < deadline:
        ready, _, _ = select.select([terminal], [], [], 1)
        try:
            shown += os.read(terminal, 65536) if ready else b""
        except OSError:  # the process has gone
            break
        if not sent and b"sampling" in shown:
            process.send_signal(signal.SIGINT)
            sent = True
    os.close(terminal)
    assert process.wait(100) == 130
    out = process.stdout.read()
    process.stdout.close()
    assert sent
    text = re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]", b"", shown).decode()
    lines = [
        line for line in re.split(r"[\r\n]+", text) if line.strip() and "sampling" not in line and "loading" not in line
    ]
    assert lines == ["fspt: interrupted; nothing was written."]
    assert out == b""
    assert os.listdir(tmp_path) == ["s.xml"]


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_folder_in_the_place_of_a_file_is_refused_before_the_work(run, tmp_path, monkeypatch, name):
    """Seen to fail with the picture's place looked at last: all was rendered, and nothing written."""
    write_scene(tmp_path / "s.xml")
    (tmp_path / name).mkdir()
    monkeypatch.setattr("mitsuba_fspt.rendering.render.render", None)
    code, out, err = run("render", tmp_path / "s.xml", "-o", tmp_path / "a.exr", "--png")
    assert (code, out) == (2, "")
    assert err == f"fspt: output file '{tmp_path / name}' is a folder. Give the name of a file in it.\n"
