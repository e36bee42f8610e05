"""`fspt reduce` and `fspt invert`: from counts to J_n, files, JSON and bad input."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sphere_views import sphere_views, write_sphere

import mitsuba_fspt as fspt
from mitsuba_fspt.cli.invert import _unknown
from mitsuba_fspt.inverse.invert import Problem

CAMERA = """[detector]
name = "CCD"
quantum_efficiency = 0.85
dark_current = 1e-3
read_noise = 3.5
full_well = 1e5
gain = 1.6
bias = 500
bits = 16

[lens]
focal_length = 55
f_number = 2.8
magnification = 0.5
"""
SETTINGS = ("--wavelength-nm", 650, "--exposure-time", 600, "--pixel-pitch", 0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, mono):
    """Matrix T.npz, the camera, counts of four views as NPY, and the total power of the surface [W]."""
    folder = tmp_path_factory.mktemp("counts")
    matrix = sphere_views()
    write_sphere(folder)
    matrix.save(folder / "T.npz")
    (folder / "camera.toml").write_text(CAMERA)
    detector = fspt.Detector.from_toml(folder / "camera.toml")
    power = matrix.forward(np.ones(matrix.shape[1]))
    scale = 3e-18 / power.max()
    for k, plane in enumerate(power):
        exposure = detector.expose(fspt.Image(scale * plane, metadata={"pixel_pitch": 0.5}), 600, 650, seed=k)
        np.save(folder / f"counts_{k}.npy", exposure.counts)
        exposure.write(folder / f"exposure_{k}.exr")
    return folder, scale * matrix.areas.sum()


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def test_from_counts_to_the_phantom(run, folder):
    """Counts → W → J_n: the total lies in its interval, and the phantom is one that scenes take."""
    folder, total = folder
    counts = [folder / f"counts_{k}.npy" for k in range(4)]
    code, out, err = run("reduce", *counts, "--detector", folder / "camera.toml", *SETTINGS, "-o", folder / "p.exr",
                         "--json")  # fmt: skip
    assert (code, err) == (0, "")
    names = [image["output"] for image in json.loads(out)["images"]]
    code, out, err = run("invert", folder / "T.npz", *names, "-o", folder / "phantom.ply", "--samples", 100, "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    low, high = record["total_interval"]
    assert low < total < high
    assert (high - low) / total < 0.05
    assert fspt.Phantom.read(folder / "phantom.ply").power == pytest.approx(record["total"], rel=1e-6, abs=0)
    exposures = [folder / f"exposure_{k}.exr" for k in range(4)]
    code, out, err = run("invert", folder / "T.npz", *exposures, "-o", folder / "other.vtu", "--quiet")
    assert (code, out, err) == (0, "", "")


def test_calibration_writes_a_camera(run, folder, tmp_path):
    folder, _ = folder
    from mitsuba_fspt.optics.thin_lens import Lens
    from mitsuba_fspt.optics.uniform_source import uniform_power

    power = uniform_power(Lens.focused(55, 2.8, magnification=0.5), 2e-16, 0.5, (16, 16))
    detector = fspt.Detector.from_toml(folder / "camera.toml")
    stack = [detector.expose(fspt.Image(power), 600, 650, seed=k).counts for k in range(20)]
    np.save(tmp_path / "sphere.npy", 0.8 * (np.array(stack) - 500.0) + 500)
    arguments = ("reduce", tmp_path / "sphere.npy", "--detector", folder / "camera.toml", *SETTINGS, "--calibrate")
    code, out, _ = run(*arguments, "--radiance", 2e-16, "--radiance-error", 0.02, "-o", tmp_path / "c.toml", "--json")
    assert code == 0
    assert json.loads(out)["gain_error"] == pytest.approx(0.02, rel=0.05)
    assert fspt.Detector.from_toml(tmp_path / "c.toml").quantum_efficiency == pytest.approx(0.8 * 0.85, rel=5e-3)
    dn = (np.load(tmp_path / "sphere.npy").mean(axis=0) - 500).sum() - power.size * 1e-3 * 600 / 1.6
    assert json.loads(out)["watts_per_dn"] == pytest.approx(power.sum() / dn, rel=1e-3, abs=0)
    code, _, err = run(*arguments, "-o", tmp_path / "d.toml")
    assert (code, err.count("\n")) == (2, 1)
    assert "--radiance" in err
    assert files(tmp_path) == ["c.toml", "sphere.npy"]
    # a lens that lets 0.8 of the light through explains the loss: the scene's own transmittance would count it twice
    (tmp_path / "lens.toml").write_text(CAMERA + "transmittance = 0.8\n")
    arguments = ("reduce", tmp_path / "sphere.npy", "--detector", tmp_path / "lens.toml", *SETTINGS, "--calibrate")
    assert run(*arguments, "--radiance", 2e-16, "-o", tmp_path / "d.toml")[0] == 0
    assert fspt.Detector.from_toml(tmp_path / "d.toml").quantum_efficiency == pytest.approx(0.85, rel=5e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("T.npz", "counts_0.npy", "-o", "out.ply"), "Reduce it with 'fspt reduce'"),
        (("T.npz", "exposure_0.exr", "-o", "out.ply"), "1 images for 4 views"),
        (("sphere.xml", *(f"exposure_{k}.exr" for k in range(4)), "-o", "out.ply"), "sphere.xml"),
        (("T.npz", *(f"exposure_{k}.exr" for k in range(4)), "-o", "out.stl"), "must end in .ply or .vtu"),
        (("T.npz", *(f"exposure_{k}.exr" for k in range(4)), "-o", "out.ply", "--weight", "-1"), "'weight'"),
        (("none.npz", "exposure_0.exr", "-o", "out.ply"), "does not exist"),
        (("counts_0.npy", "exposure_0.exr", "-o", "out.ply"), "no zip archive"),
    ],
)
def test_bad_input_of_invert(run, folder, monkeypatch, arguments, words):
    """Exit code 2, one line that says what is wrong, and no file."""
    folder, _ = folder
    monkeypatch.chdir(folder)
    before = files(folder)
    code, out, err = run("invert", *arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert words in err
    assert files(folder) == before


def test_ctrl_c_leaves_no_file(run, folder, monkeypatch):
    """Ctrl-C in the middle of the fit: exit code 130, one line, neither mesh nor report."""
    folder, _ = folder
    monkeypatch.chdir(folder)
    before, improved, pressed = files(folder), Problem._improved, []

    def press(self, *arguments):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:  # lost, as in a callback of C++
            pressed.append(True)
        return improved(self, *arguments)

    monkeypatch.setattr(Problem, "_improved", press)
    images = [f"exposure_{k}.exr" for k in range(4)]
    code, out, err = run("invert", "T.npz", *images, "-o", "out.ply", "--samples", 50, "--report", "out.png")
    assert (code, out, err) == (130, "", "fspt: interrupted; nothing was written.\n")
    assert len(pressed) == 1
    assert files(folder) == before


def test_bad_input_of_reduce(run, folder, monkeypatch, tmp_path):
    folder, _ = folder
    monkeypatch.chdir(folder)
    before = files(folder)
    for arguments, words in (
        (("counts_0.npy", "--detector", "camera.toml", "-o", "x.exr", "--wavelength-nm", 650), "exposure time"),
        (("none.tif", "--detector", "camera.toml", *SETTINGS, "-o", "x.exr"), "do not exist"),
        (("exposure_0.exr", "--detector", "camera.toml", "-o", "x.exr"), "as of 'fspt expose --counts'"),
        (("counts_0.npy", "--detector", "camera.toml", *SETTINGS, "-o", "x.png"), "must end in"),
        (("counts_0.npy", "--detector", "none.toml", *SETTINGS, "-o", "x.exr"), "none.toml"),
        (("counts_0.npy", "--detector", "camera.toml", *SETTINGS, "-o", "x.exr", "--radiance", 1), "--calibrate"),
    ):
        code, out, err = run("reduce", *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert words in err
    assert files(folder) == before


def test_what_the_images_do_not_determine_is_told():
    """A PLY has J_n = 0 there, so that a rendering of it is dark where the phantom is not; a VTU has NaN."""
    found = SimpleNamespace(seen=np.array([True, False, False]), matrix=SimpleNamespace(on="vertex"))
    assert "2 of 3 vertices are not determined" in _unknown(found, Path("phantom.ply"))
    assert not _unknown(found, Path("phantom.vtu"))
    found.seen[:] = True
    assert not _unknown(found, Path("phantom.ply"))
