"""The summary of CPU seconds at the end of a run of the tests, and its limit."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cpu_seconds

TESTS = Path(__file__).resolve().parents[1]
BUSY = """
import subprocess, sys, time

def spend(seconds):
    start = time.process_time()
    while time.process_time() < start + seconds:
        pass

def test_here():
    spend(0.6)

def test_in_a_child():
    code = "import time\\nwhile time.process_time() < 0.6: pass"
    subprocess.run([sys.executable, "-c", code], check=True)

def test_asleep():
    time.sleep(0.6)
"""


def test_dearest_tests_and_the_limit(tmp_path):
    """0.6 s of a worker and of its child count, sleep does not; the total has all, and a limit below it fails."""
    (tmp_path / "test_busy.py").write_text(BUSY)
    plugins = ("-p", "no:cacheprovider", "-p", "xdist", "-p", "cpu_seconds")
    command = [sys.executable, "-m", "pytest", "-q", *plugins, "-n", "2", "--cpu-limit", "1"]
    command += ["--cpu-table", "spent.csv", "--cpu-least", "0.5", "test_busy.py"]
    paths = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    found = {name: float(s) for s, name in re.findall(r"^ +([\d.]+)  (\S+)", done.stdout, re.MULTILINE)}
    here, child, asleep = (found[f"test_busy.py::test_{name}"] for name in ("here", "in_a_child", "asleep"))
    assert min(here, child) > 0.55
    assert asleep < 0.3
    assert found["in"] > here + child
    assert "in all, over the budget of 1" in done.stdout
    assert done.returncode == 1
    head, *rows = (tmp_path / "spent.csv").read_text().splitlines()
    assert head == "cpu_seconds,test"
    assert sorted(row.partition(",")[2] for row in rows) == [
        f"test_busy.py::test_{name}" for name in ("here", "in_a_child")
    ]


def test_a_quick_run_leaves_out_the_tests_of_the_table(monkeypatch, tmp_path):
    """Of three tests the one in the table; the others, and their order, stay. The committed table names files that are
    there."""
    with cpu_seconds.DEAR.open(newline="") as file:
        assert all((TESTS.parent / row["test"].partition("::")[0]).exists() for row in csv.DictReader(file))
    table = tmp_path / "dear_tests.csv"
    table.write_text('cpu_seconds,test\n5.00,"a.py::test[1, 2]"\n')
    monkeypatch.setattr(cpu_seconds, "DEAR", table)
    left_out = []
    hook = SimpleNamespace(pytest_deselected=lambda items: left_out.extend(items))
    items = [SimpleNamespace(nodeid=name) for name in ("b.py::test", "a.py::test[1, 2]", "a.py::test")]
    for quick in (False, True):
        config = SimpleNamespace(getoption={"quick": quick}.get, hook=hook)
        cpu_seconds.Spent().pytest_collection_modifyitems(config, items)
        assert [item.nodeid for item in items] == ["b.py::test", *["a.py::test[1, 2]"] * (not quick), "a.py::test"]
    assert [item.nodeid for item in left_out] == ["a.py::test[1, 2]"]
