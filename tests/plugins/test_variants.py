"""Every LLVM variant of the wheel computes the same watts; switching between them and to scalar ones breaks nothing.

What happens at import happens once in a process, so these run small scripts in processes of their own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsuba_fspt.runtime import backend, libllvm

TESTS = Path(__file__).resolve().parents[1]
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_mono_polarized", "llvm_ad_spectral", "llvm_ad_spectral_polarized")
SWITCHES = (*VARIANTS, VARIANTS[0])
SCALAR_FIRST = "import mitsuba; mitsuba.set_variant('scalar_rgb'); import mitsuba_fspt"

PRELUDE = """
import json, sys, warnings
warnings.simplefilter("error")
def attempt(function, *arguments, **options):
    try:
        return str(function(*arguments, **options))
    except Exception as error:
        return f"{type(error).__name__}: {error}"
"""

# A mesh with an attribute and a sphere far brighter than 1, that hides a part of it.
PICTURES = """
import mitsuba_fspt as fspt
import mitsuba as mi
import numpy as np
def pictures():
    from small_scenes import attribute, ball, glow, lens, world_scene
    mesh = {"type": "ply", "filename": sys.argv[1], "face_normals": True, "emitter": glow(attribute())}
    coarse = {"type": "fspt_integral", "rtol": 1e-2}
    scene = world_scene(mesh, ball(700.0, radius=1.5, center=(9, 1, 1)), sensor=lens(8, 1.0), integrator=coarse)
    integral = fspt.render(scene)
    plain = np.array(mi.render(scene)).mean(-1)
    tracers = [fspt.render(scene, method=method, spp=256) for method in ("path", "ptracer")]
    noisy = [picture.tolist() for tracer in tracers for picture in (tracer.power, tracer.error)]
    return [integral.power.tolist(), plain.tolist(), *noisy, integral.metadata["variant"]]
def all_pictures():
    answers = []
    for variant in sys.argv[2:]:
        mi.set_variant(variant)
        answers.append(pictures())
    return answers
print(json.dumps(all_pictures()))
"""


def start(script, *arguments, environ=None):
    """A fresh process that runs `script` with the tests' folder on its path."""
    paths = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-c", PRELUDE + script, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, **(environ or {})},
    )


def answer(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """What `all_pictures` says of each of `SWITCHES`: power by integral and plain mi.render, power and error by path
    and by ptracer, the variant.
    """
    from small_scenes import write_ply

    vertices = [(0, -3, -3), (0, 3, -3), (0, 3, 3), (0, -3, 3)]
    path = tmp_path_factory.mktemp("variants") / "sheet.ply"
    write_ply(path, vertices, [(0, 1, 2), (0, 2, 3)], vertex=[100, 900, 500, 300])
    return [[*map(np.array, parts), tag] for *parts, tag in answer(start(PICTURES, path, *SWITCHES))]


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_computes_the_same_watts(pictures, variant):
    """The integral and plain `mi.render` to 1e-5 of the peak, `path` and `ptracer` within their noise."""
    integral, plain, *noisy, _ = next(row for row in pictures if row[-1] == variant)
    truth, _, *references, _ = pictures[0]
    peak = truth.max()
    assert peak > 0
    np.testing.assert_allclose(integral, truth, rtol=0, atol=1e-5 * peak)
    np.testing.assert_allclose(plain, integral, rtol=0, atol=1e-6 * peak)
    for k in (0, 2):
        (power, error), (reference, reference_error) = noisy[k : k + 2], references[k : k + 2]
        noise = np.hypot(error, reference_error)
        assert np.all(np.abs(power - reference) < 5 * noise + 1e-6 * peak)
        assert abs(power.sum() - reference.sum()) < 4 * np.linalg.norm(noise)
        assert abs(power.sum() - integral.sum()) < 4 * np.linalg.norm(error) + 1e-3 * truth.sum()


def test_path_has_the_watts_of_the_integral_at_all_wavelengths():
    """Where nothing but wavelengths scatters. Seen to fail, by 0.9e-3, with a film that is given flat spectra of 1."""
    script = """
import mitsuba_fspt as fspt
import mitsuba as mi
mi.set_variant("llvm_ad_spectral")
from small_scenes import glow, lens, world_scene
turned = mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale(60)
scene = world_scene({"type": "disk", "to_world": turned, "emitter": glow()}, sensor=lens(size=16, pitch=0.2))
path, integral = (fspt.render(scene, method=method) for method in ("path", "integral"))
print(json.dumps(path.power.sum() / integral.power.sum() - 1))
"""
    assert abs(answer(start(script))) < 2e-4


def test_switching_there_and_back_changes_nothing(pictures):
    first, *_, again = pictures
    assert first[-1] == again[-1] == "llvm_ad_mono"
    # Not ptracer's last bits: its threads add to pixels in any order.
    for before, after in zip(first[:4], again[:4], strict=True):
        np.testing.assert_array_equal(before, after)


def test_scalar_variants_are_refused_in_one_line():
    script = """
import mitsuba_fspt as fspt
import mitsuba as mi
answers = []
for variant in ("scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"):
    mi.set_variant(variant)
    answers.append([attempt(function, sys.argv[1]) for function in (fspt.load, fspt.render, mi.load_file)])
print(json.dumps(answers))
"""
    scene = TESTS.parent / "scenes" / "two_spheres.xml"
    for load, render, plain in answer(start(script, scene)):
        assert load.startswith("BackendError: the active variant scalar_")
        assert "mi.set_variant('llvm_ad_mono')" in load
        assert render == load
        assert "mitsuba_fspt needs a vectorised variant. Call mi.set_variant('llvm_ad_mono')" in plain
        assert "\n" not in load


def test_metal_variants_are_refused_in_one_line(monkeypatch, mono):
    """By `load`, and by the plugins under plain Mitsuba."""
    from types import SimpleNamespace

    import mitsuba_fspt as fspt
    from mitsuba_fspt import plugins

    made = {}
    kinds = {f"register_{kind}": made.__setitem__ for kind in ("emitter", "sensor", "integrator")}
    monkeypatch.setitem(sys.modules, "mitsuba.metal_ad_mono", SimpleNamespace(**kinds))
    monkeypatch.setattr(mono, "variant", lambda: "metal_ad_mono")
    monkeypatch.setattr(plugins, "_registered", set(plugins._registered))
    expected = "metal_ad_mono is none of LLVM and CUDA, .*Metal has no float64. Call mi.set_variant\\('llvm_ad_mono'\\)"
    with pytest.raises(fspt.FsptError, match=f"^the active variant {expected}"):
        fspt.load(TESTS.parent / "scenes" / "two_spheres.xml")
    plugins.register()
    for name in ("fspt_surface", "fspt_lens", "fspt_integral"):
        with pytest.raises(fspt.FsptError, match=f"^{name}: {expected}"):
            made[name](SimpleNamespace(plugin_name=lambda name=name: name))


def test_plugins_that_are_registered_twice_are_registered_once(monkeypatch, mono):
    """Mitsuba 3.10 reloads the entry point after each switch of the variant: no class is made anew.

    Living objects would otherwise be of another class than new ones. Seen to fail with an empty set after a reload.
    """
    import importlib

    from mitsuba_fspt import plugins

    lens = {"type": "fspt_lens", "focal_length": 50, "f_number": 4, "magnification": 1, "pixel_pitch": 1}
    before = type(mono.load_dict(lens))
    for _ in range(2):
        importlib.reload(plugins)
        plugins.register()
    assert type(mono.load_dict(lens)) is before


@pytest.mark.parametrize("order", ["import mitsuba, mitsuba_fspt", "import mitsuba_fspt, mitsuba", SCALAR_FIRST])
def test_import_orders(order):
    """Under a scalar variant too, nothing breaks before a scene is loaded."""
    script = f"""
{order}
mitsuba.set_variant("llvm_ad_mono")
numbers = {{"focal_length": 50, "f_number": 4, "magnification": 1, "pixel_pitch": 1}}
lens = mitsuba.load_dict({{"type": "fspt_lens", **numbers}})
print(json.dumps([str(lens)[:9], attempt(lambda: mitsuba_fspt.load("nowhere.xml"))]))
"""
    chosen = libllvm.select()
    made, refused = answer(start(script, environ={libllvm.ENVIRONMENT_NAME: str(chosen.path)}))
    assert made == "FsptLens["
    assert refused.startswith("SceneError: nowhere.xml")


def test_loading_sets_a_variant_and_keeps_one():
    script = """
import mitsuba_fspt as fspt, mitsuba as mi
before = mi.variant()
fspt.load(sys.argv[1])
chosen = mi.variant()
mi.set_variant("llvm_ad_rgb")
fspt.load(sys.argv[1])
print(json.dumps([before, chosen, mi.variant()]))
"""
    before, chosen, kept = answer(start(script, TESTS.parent / "scenes" / "two_spheres.xml"))
    assert before is None
    assert chosen in ("llvm_ad_mono", "cuda_ad_mono")
    assert kept == "llvm_ad_rgb"


def test_the_wheel_has_no_other_llvm_variant():
    """The list above is complete."""
    backend.ensure_variant()
    import mitsuba as mi

    assert {name for name in mi.variants() if name.startswith("llvm")} == set(VARIANTS)
