"""A third of the examples runs at a time, each with the number that it asserts; `scripts/docs` runs all of them."""

from __future__ import annotations

import datetime
import os
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
# Which third: FSPT_EXAMPLES=0, 1, 2 or all; else by the day. In a third the examples stand by their names.
THIRD = os.environ.get("FSPT_EXAMPLES") or str(datetime.date.today().toordinal() % 3)
CHOSEN = NAMES if THIRD == "all" else NAMES[int(THIRD) :: 3]


@pytest.mark.slow
@pytest.mark.parametrize("name", CHOSEN)
def test_an_example_runs_and_finds_its_number(name, tmp_path):
    """Outside of the checkout's folder, warnings as errors, without a display."""
    if name == "counts_to_exitance":
        pytest.skip("it has a test of its own")
    for module in ["matplotlib", *NEEDS.get(name, [])]:
        pytest.importorskip(module)
    environment = os.environ | {"MPLBACKEND": "agg", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    call = [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py"), *SMALL.get(name, [])]
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.parametrize("name", NAMES)
def test_an_example_asserts_a_number_and_draws(name):
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert "\nassert " in text or "\n    assert " in text
    assert text.startswith('"""\n')


def test_all_needs_are_of_examples():
    assert set(NEEDS) <= set(NAMES)
    assert find_spec("matplotlib") is None or set(CHOSEN) <= set(NAMES)
