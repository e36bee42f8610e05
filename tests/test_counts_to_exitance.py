"""The examples run, and what they find is right."""

from __future__ import annotations

import importlib.util
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name, *arguments):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main(*arguments)


def test_counts_to_exitance(tmp_path, mono):
    """The total is in its interval, which is a few percent wide; the image of the result is that of the phantom."""
    found = run("counts_to_exitance", tmp_path)
    assert found["low"] < found["true"] < found["high"]
    assert 0 < found["high"] - found["low"] < 0.05 * found["total"]
    assert found["cf"] > 0.999
    assert abs(found["chi2"] - 1) < 0.1
