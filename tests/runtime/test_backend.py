"""The backend: which LLVM Dr.Jit gets, how a bad one is refused, when plugins register, which variant it is.

What happens at import happens once in a process, so those tests run small scripts in processes of their own.
"""

import glob
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mitsuba_fspt.runtime import backend, libllvm
from mitsuba_fspt.runtime.errors import BackendError

REPOSITORY = Path(backend.__file__).resolve().parents[2]
SCENE = Path(__file__).resolve().parents[2] / "scenes" / "textured_sphere.exr"  # beside the tests, not in a wheel
LLVM_15 = next(iter(glob.glob("/usr/lib/*-linux-gnu/libLLVM-15.so*")), None)
WORKING = libllvm.select({})

needs_llvm = pytest.mark.skipif(WORKING.version is None, reason="no usable LLVM on this machine")
needs_llvm_15 = pytest.mark.skipif(LLVM_15 is None, reason="no LLVM 15 on this machine to be refused")

# For all scripts: `attempt` turns an exception into text; the plugins record when they are registered.
PRELUDE = """
import json, os, sys, types
def attempt(function, *arguments):
    try:
        function(*arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
plugins = types.ModuleType("mitsuba_fspt.plugins")
plugins.seen = []
plugins.register = lambda: plugins.seen.append(sys.modules["mitsuba"].variant())
sys.modules["mitsuba_fspt.plugins"] = plugins
"""


def run_script(script: str, **environ: str) -> list[object]:
    """What the script prints as JSON; fails if its process dies, above all by an abort."""
    inherited = {k: v for k, v in os.environ.items() if k not in (libllvm.ENVIRONMENT_NAME, "MI_DEFAULT_VARIANT")}
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + script],
        env={**inherited, "PYTHONPATH": str(REPOSITORY), **environ},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    answer: list[object] = json.loads(done.stdout)
    return answer


def test_import_loads_no_renderer_and_sets_no_variant() -> None:
    script = """
import mitsuba_fspt
loaded = [name for name in ("drjit", "mitsuba") if name in sys.modules]
before = os.environ.get("DRJIT_LIBLLVM_PATH")
import mitsuba
print(json.dumps([loaded, before, mitsuba.variant(), plugins.seen]))
"""
    assert run_script(script) == [[], None, None, []]


@needs_llvm
def test_threads_may_be_first_to_use_mitsuba() -> None:
    """Seen to fail: "module 'mitsuba' has no attribute 'variant'" in all threads but one."""
    script = """
import threading
from mitsuba_fspt.runtime import backend
found, together = [], threading.Barrier(6)
sys.setswitchinterval(1e-5)
def work():
    together.wait()
    found.append(backend.ensure_variant())
threads = [threading.Thread(target=work) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(json.dumps(found))
"""
    assert len(run_script(script)) == 6


@needs_llvm
@pytest.mark.parametrize("order", ["mitsuba_fspt, mitsuba", "mitsuba, mitsuba_fspt"])
def test_plugins_register_after_every_switch_in_either_import_order(order: str) -> None:
    script = f"""
import {order}
for variant in ("llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono"):
    mitsuba.set_variant(variant)
print(json.dumps(plugins.seen))
"""
    path = {libllvm.ENVIRONMENT_NAME: str(WORKING.path)}  # for the second order, in which Dr.Jit comes first
    assert run_script(script, **path) == ["llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono"]


@needs_llvm
def test_plugins_register_at_once_where_a_variant_is_active() -> None:
    script = """
import mitsuba
mitsuba.set_variant("scalar_rgb")
mitsuba.set_variant("llvm_ad_rgb")
import mitsuba_fspt
active = mitsuba_fspt.runtime.backend.ensure_variant()
mitsuba.set_variant("scalar_rgb")  # loaded before: no import tells of this switch
print(json.dumps([active, plugins.seen]))
"""
    active, seen = run_script(script, **{libllvm.ENVIRONMENT_NAME: str(WORKING.path)})
    assert active == "llvm_ad_rgb"
    assert seen == ["llvm_ad_rgb", "scalar_rgb"]


def test_a_failing_registration_comes_out_of_set_variant() -> None:
    script = """
import mitsuba_fspt, mitsuba
def register():
    raise RuntimeError("cannot register")
plugins.register = register
print(json.dumps([attempt(mitsuba.set_variant, "scalar_rgb")]))
"""
    assert run_script(script) == ["RuntimeError: cannot register"]


@needs_llvm
def test_llvm_is_handed_over_before_drjit_loads_and_works() -> None:
    script = """
import mitsuba_fspt, mitsuba, drjit
mitsuba.set_variant("llvm_ad_mono")
least = drjit.minimum(mitsuba.Float([3.0, -1.0]), 2.0)  # aborts the process on LLVM 15 and 16
chosen = mitsuba_fspt.runtime.backend.selection()
print(json.dumps([chosen.path, os.environ["DRJIT_LIBLLVM_PATH"], drjit.detail.llvm_version(), list(least)]))
"""
    assert WORKING.version is not None
    assert run_script(script) == [WORKING.path, WORKING.path, list(WORKING.version), [2.0, -1.0]]


@needs_llvm
def test_a_users_own_path_is_obeyed() -> None:
    """The path is spelt as no search would spell it, so that it can only come from the user."""
    own = os.path.join(os.path.dirname(str(WORKING.path)), ".", os.path.basename(str(WORKING.path)))
    script = """
import mitsuba_fspt, mitsuba
mitsuba.set_variant("llvm_ad_mono")
chosen = mitsuba_fspt.runtime.backend.selection()
print(json.dumps([os.environ["DRJIT_LIBLLVM_PATH"], chosen.path, chosen.why]))
"""
    answer = run_script(script, **{libllvm.ENVIRONMENT_NAME: own})
    assert answer == [own, own, "DRJIT_LIBLLVM_PATH is set"]


BAD_LIBRARIES = [
    pytest.param("/nowhere/libLLVM.so", "cannot be loaded", id="missing"),
    pytest.param("libc.so.6" if sys.platform == "linux" else "libSystem.dylib", "lacks the function", id="libc"),
    pytest.param(LLVM_15, "LLVM 15 is too old", id="LLVM-15", marks=needs_llvm_15),
]


@pytest.mark.parametrize(("path", "reason"), BAD_LIBRARIES)
def test_a_users_own_bad_library_is_refused_before_the_switch(path: str, reason: str) -> None:
    script = """
import mitsuba_fspt, mitsuba
refused = attempt(mitsuba.set_variant, "llvm_ad_mono")
variant = mitsuba.variant()
mitsuba.set_variant("llvm_ad_rgb", "scalar_rgb")  # Mitsuba tries the next after an ImportError
print(json.dumps([refused, variant, mitsuba.variant(), os.environ["DRJIT_LIBLLVM_PATH"]]))
"""
    refused, variant, fallback, kept = run_script(script, **{libllvm.ENVIRONMENT_NAME: path})
    assert str(refused).startswith("BackendError: llvm_ad_mono: ")
    assert f"DRJIT_LIBLLVM_PATH is set to {path}: {reason}" in str(refused)
    assert "\n" not in str(refused)
    assert (variant, fallback, kept) == (None, "scalar_rgb", path)


@pytest.mark.parametrize(("path", "reason"), BAD_LIBRARIES)
def test_a_bad_library_bound_before_us_is_refused(path: str, reason: str) -> None:
    script = """
import mitsuba
del os.environ["DRJIT_LIBLLVM_PATH"]
import mitsuba_fspt
print(json.dumps([attempt(mitsuba.set_variant, "llvm_ad_mono"), mitsuba.variant()]))
"""
    refused, variant = run_script(script, **{libllvm.ENVIRONMENT_NAME: path})
    bound = "LLVM 15" if path == LLVM_15 else "no LLVM"
    assert str(refused).startswith(f"BackendError: llvm_ad_mono: Dr.Jit has bound {bound}")
    if WORKING.path:
        assert f"Import mitsuba_fspt first: {WORKING.path} works" in str(refused)
    assert variant is None


@needs_llvm_15
def test_import_is_refused_while_a_variant_runs_on_llvm_15() -> None:
    script = """
import mitsuba
mitsuba.set_variant("llvm_ad_mono")
print(json.dumps([attempt(__import__, "mitsuba_fspt")]))
"""
    (refused,) = run_script(script, **{libllvm.ENVIRONMENT_NAME: str(LLVM_15)})
    assert str(refused).startswith("BackendError: llvm_ad_mono: Dr.Jit has bound LLVM 15")


# --- the choice of a variant, by the real Dr.Jit and Mitsuba, told of other hardware ---


@pytest.fixture
def hardware(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What Dr.Jit says of the machine, as the test sets it: `cuda`, and `llvm`, the version that is bound."""
    import drjit
    import mitsuba  # noqa: F401  # with Dr.Jit's own answers

    hardware = SimpleNamespace(cuda=False, llvm=(-1, -1, -1))
    real = drjit.has_backend
    told = lambda backend: hardware.cuda if backend == drjit.JitBackend.CUDA else real(backend)  # noqa: E731
    monkeypatch.setattr(drjit, "has_backend", told)
    monkeypatch.setattr(drjit.detail, "llvm_version", lambda: hardware.llvm)
    return hardware


LOADS = "libc.so.6" if sys.platform == "linux" else "libSystem.dylib"  # as OptiX would, from a complete driver


def test_cuda_is_taken_where_it_works(hardware: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail with LLVM asked first and with OptiX not looked for."""
    hardware.cuda = True
    hardware.llvm = (19, 1, 7)
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", LOADS)
    assert backend.choose_variant() == "cuda_ad_mono"
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", "/nowhere/libnvoptix.so.1")  # as in many containers
    assert backend.choose_variant("rgb") == "llvm_ad_rgb"


def test_llvm_is_taken_where_there_is_no_cuda(hardware: SimpleNamespace) -> None:
    hardware.llvm = (17, 0, 6)
    assert backend.choose_variant() == "llvm_ad_mono"
    with pytest.raises(BackendError, match=r"'grey' is none of Mitsuba's\. Give one of rgb, mono, "):
        backend.choose_variant("grey")


@pytest.mark.parametrize("llvm", [(-1, -1, -1), (16, 0, 6)])
def test_without_a_backend_one_line_names_what_to_install(
    hardware: SimpleNamespace, llvm: libllvm.Version, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine whose only library of that name is broken."""
    rejected = (libllvm.Rejected("/a/b", "broken"),)
    nothing = libllvm.Selection(None, None, "no usable LLVM library found", rejected)
    monkeypatch.setattr(backend._watch, "selection", nothing)
    hardware.llvm = llvm
    with pytest.raises(BackendError) as refused:
        backend.choose_variant()
    message = str(refused.value)
    assert "\n" not in message
    for part in (
        "no CUDA device",
        "needs 17 or newer",
        "/a/b: broken",
        "pip install 'mitsuba-fspt[llvm]'",
        "Debian 12+, Ubuntu 24.04+: sudo apt install libllvm19 libatomic1",
        "Fedora: sudo dnf install",
        "macOS: brew install llvm",
        "Windows: winget install LLVM.LLVM",
        "conda install -c conda-forge libllvm19",
        "DRJIT_LIBLLVM_PATH",
    ):
        assert part in message


def test_without_a_backend_no_variant_is_set() -> None:
    """In a process that sees no CUDA device and is given the name of an LLVM that does not exist."""
    script = """
import mitsuba_fspt, mitsuba
refused = attempt(mitsuba_fspt.runtime.backend.ensure_variant)
print(json.dumps([refused, mitsuba.variant()]))
"""
    hidden = {"CUDA_VISIBLE_DEVICES": "", libllvm.ENVIRONMENT_NAME: "/nowhere/libLLVM.so"}
    refused, variant = run_script(script, **hidden)
    assert str(refused).startswith("BackendError: no backend to compute on: no CUDA device")
    assert variant is None


def test_a_missing_libatomic_is_named_when_drjit_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(backend, "_loads", lambda library: library != "libatomic.so.1")
    watch = backend.ImportWatch()
    assert watch.find_spec("numpy") is None
    with pytest.raises(BackendError, match=r"libatomic\.so\.1.*sudo apt install libatomic1"):
        watch.find_spec("drjit")


@pytest.mark.parametrize("cores", ["one", "all"])
def test_an_exr_is_read_with_one_core_or_thread(cores: str) -> None:
    """Seen to hang, in Mitsuba's reader, where Dr.Jit has no worker thread beside the main one."""
    if cores == "one" and not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system binds no process to a core")
    script = f"""
if {cores == "one"}:
    os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])
from mitsuba_fspt.runtime import backend
backend.ensure_variant()
if {cores == "all"}:
    backend.set_threads(1)
import mitsuba
print(json.dumps(list(mitsuba.Bitmap({str(SCENE)!r}).size())))
"""
    assert run_script(script) == [512, 256]
