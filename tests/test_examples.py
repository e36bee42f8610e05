"""A sixth of the examples runs at a time, each with the number that it asserts; `scripts/docs` runs all of them."""

from __future__ import annotations

import datetime
import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))
NEEDS = {
    "counts_to_exitance": ["matplotlib"],  # tests/test_counts_to_exitance.py
    "flux_from_vtu": ["meshio"],
    "matrix_in_cil": ["cil"],
    "matrix_in_cuqipy": ["cuqi"],
    "matrix_in_pylops": ["pylops"],
    "source_in_a_cylinder": ["skfem"],
    "sweep_on_dask": ["distributed"],
}
SMALL = {"recover_bitmap": ["12"]}  # arguments: fewer pixels
# Which sixth: FSPT_EXAMPLES=0 … 5 or all; else by the day. In a sixth the examples stand by their names.
PARTS = 6
PART = os.environ.get("FSPT_EXAMPLES") or str(datetime.date.today().toordinal() % PARTS)
CHOSEN = NAMES if PART == "all" else NAMES[int(PART) :: PARTS]


RUNNER = """
import contextlib, io, json, os, runpy, sys, traceback
folder, found = sys.argv[1], {}
for number, (path, *arguments) in enumerate(json.loads(sys.argv[2])):
    os.makedirs(f"{folder}/{number}")
    os.chdir(f"{folder}/{number}")
    sys.argv, told, fault = [path, *arguments], io.StringIO(), None
    try:
        with contextlib.redirect_stdout(told):
            runpy.run_path(path, run_name="__main__")
    except BaseException:
        fault = traceback.format_exc()
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")
    found[path] = told.getvalue(), fault
print(json.dumps(found))
"""


def can_run(name):
    """Whether an example has no test of its own, and what it needs is installed."""
    needs = ("matplotlib", *NEEDS.get(name, []))
    return name != "counts_to_exitance" and all(find_spec(module) for module in needs)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Output and fault of each example by its path, one after the other in a process, as `scripts/docs` runs them.

    Outside of the checkout's folder, warnings as errors, without a display. A process for each takes 2.5 s more.
    """
    environment = os.environ | {"MPLBACKEND": "agg", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    given = [[str(EXAMPLES / f"{name}.py"), *SMALL.get(name, [])] for name in CHOSEN if can_run(name)]
    folder = tmp_path_factory.mktemp("examples")
    call = [sys.executable, "-W", "error", "-c", RUNNER, str(folder), json.dumps(given)]
    done = subprocess.run(call, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", CHOSEN)
def test_an_example_runs_and_finds_its_number(name, results):
    if not can_run(name):
        pytest.skip("it has a test of its own, or what it needs is not installed")
    told, fault = results[str(EXAMPLES / f"{name}.py")]
    assert not fault, fault
    assert told.strip()


@pytest.mark.parametrize("name", NAMES)
def test_an_example_asserts_a_number_and_draws(name):
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert "\nassert " in text or "\n    assert " in text
    assert text.startswith('"""\n')
    first = re.search(r"^(?:import|from) (mitsuba_fspt|mitsuba|drjit)\b", text, re.M)
    assert first is not None
    assert first[1] == "mitsuba_fspt"  # it finds the LLVM that Dr.Jit needs


def test_all_needs_are_of_examples():
    assert set(NEEDS) <= set(NAMES)
    assert find_spec("matplotlib") is None or set(CHOSEN) <= set(NAMES)
