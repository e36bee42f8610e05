"""The doctor reports what is there, survives what is not, and is content only if a backend computes right."""

import re
from importlib import metadata
from pathlib import Path

import pytest

from mitsuba_fspt.runtime import doctor, libllvm
from mitsuba_fspt.runtime.extras import EXTRAS


def test_report_of_this_machine() -> None:
    diagnosis = doctor.diagnose()
    rows = {(row.section, row.name): row for row in diagnosis.rows}
    assert rows["versions", "mitsuba"].value.startswith("3.9")
    assert rows["backends", "llvm_ad_mono"].ok == (libllvm.select().version is not None)
    assert diagnosis.usable
    text = diagnosis.render_text()
    assert all(row.value in text for row in diagnosis.rows)
    assert text.endswith("ready")


def test_a_broken_llvm_is_a_line_of_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(libllvm.ENVIRONMENT_NAME, "/nowhere/libLLVM.so")
    monkeypatch.setattr(doctor.backend._watch, "selection", None)
    monkeypatch.setattr(doctor, "cuda_devices", list)
    diagnosis = doctor.diagnose()
    (failed,) = (row for row in diagnosis.rows if row.name == "llvm_ad_mono")
    assert not failed.ok
    assert failed.value.startswith("llvm_ad_mono: Dr.Jit has bound no LLVM")
    assert not diagnosis.usable
    assert f" ! llvm_ad_mono  {failed.value}" in diagnosis.render_text()
    assert diagnosis.render_text().endswith("no backend works: see the lines marked !")


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("import os; os.abort()", "the process was ended by SIGABRT"),
        ("raise SystemExit(3)", "exit status 3"),
        ("raise ImportError('no such driver')", "ImportError: no such driver"),
    ],
)
def test_a_trial_that_dies_is_reported_in_one_line(script: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_TRIAL", script)
    assert doctor.run_trial("llvm_ad_mono") == reason


def test_a_trial_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_TRIAL", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "_TRIAL_TIMEOUT", 0.5)
    assert doctor.run_trial("llvm_ad_mono") == "did not finish within 0.5 s"


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    rows = {row.name: row for row in [*doctor._versions(), *doctor._optional()]}
    assert rows["scikit-fem"].value == "not installed: pip install 'mitsuba-fspt[tissue]'"
    assert rows["scikit-fem"].ok  # optional
    assert rows["numpy"].value == "not installed"
    assert not rows["numpy"].ok


def test_extras_are_those_of_the_project() -> None:
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    brought = {
        (re.match(r"[\w-]+", requirement)[0], extra)
        for extra in set(extras) - {"llvm", "dev", "docs"}  # no package to look for, those of others, of no verb
        for requirement in extras[extra]
        if ";" not in requirement
    }
    assert brought == {(one.distribution, one.extra) for one in EXTRAS}
