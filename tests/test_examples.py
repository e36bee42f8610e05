"""The examples run, each where the package that it shows is installed."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NEEDS = {
    "matrix_in_pylops": "pylops",
    "matrix_in_cil": "cil",
    "matrix_in_cuqipy": "cuqi",
    "recover_bitmap": "mitsuba",
}
ARGUMENTS = {"recover_bitmap": ["16", "12"]}  # pixels along a side, and steps


def test_every_example_is_listed():
    assert sorted(path.stem for path in (ROOT / "examples").glob("*.py")) == sorted([*NEEDS, "counts_to_exitance"])


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDS)
def test_an_example_runs(name):
    if find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / f"{name}.py", *ARGUMENTS.get(name, [])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
