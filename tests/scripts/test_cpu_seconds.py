"""The summary of CPU seconds at the end of a run of the tests, and its limit."""

from __future__ import annotations

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
    command += ["--cpu-table", "spent.csv", "test_busy.py"]
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
        f"test_busy.py::test_{name}" for name in ("asleep", "here", "in_a_child")
    ]


def test_a_quick_run_leaves_out_the_functions_of_the_table(monkeypatch, tmp_path):
    """All cases of the function in the table, no other one; a quick run adds to the table, a whole one writes it anew.

    The committed table names functions that are there.
    """
    for name in cpu_seconds.dear_tests():
        file, *_, function = name.split("::")
        assert f"def {function}(" in (TESTS.parent / file).read_text(), name
    table = tmp_path / "dear_tests.csv"
    table.write_text("cpu_seconds,test\n5.0,a.py::test\n")
    monkeypatch.setattr(cpu_seconds, "DEAR", table)
    names = ["b.py::test", "a.py::test[1, 2]", "a.py::test", "a.py::test_b"]
    left_out, lines = [], []
    hook = SimpleNamespace(pytest_deselected=lambda items: left_out.extend(item.nodeid for item in items))
    reporter = SimpleNamespace(section=lambda text: None, write_line=lambda text, **marks: lines.append(text))
    for quick, stay, written in (
        (False, names, {"a.py::test": 5.0}),
        (True, ["b.py::test", "a.py::test_b"], {"a.py::test": 5.0, "a.py::test_b": 1.5}),
        (False, names, {"a.py::test_b": 1.5}),
    ):
        items = [SimpleNamespace(nodeid=name) for name in names]
        options = {"quick": quick, "list_dear": len(lines) > 0}
        config = SimpleNamespace(getoption=options.get, hook=hook)
        spent = cpu_seconds.Spent()
        spent.pytest_collection_modifyitems(config, items)
        assert [item.nodeid for item in items] == stay
        spent.tests |= {"a.py::test_b[x]": 1.5, "a.py::test_b[y]": 0.5, "b.py::test": 0.9}
        spent.pytest_terminal_summary(reporter, config)
        assert cpu_seconds.dear_tests() == written
    assert left_out == ["a.py::test[1, 2]", "a.py::test"]
    assert "--quick: the cases of 2 functions were left out" in lines
