"""Plugin of pytest: with `--plain-kernels` this process and all that it starts compile kernels quickly.

Half of the CPU time of the suite is compilation; the settings are in tests/plain/sitecustomize.py. The cache's key does
not tell all such kernels from others, so that they need a folder of their own, DRJIT_CACHE_DIR.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

FOLDER = Path(__file__).with_name("plain")


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option of the command line."""
    parser.addoption("--plain-kernels", action="store_true", help="kernels of narrow vectors without optional passes")


def pytest_configure(config: pytest.Config) -> None:
    """Act before a variant of Mitsuba is set, here and in the processes that tests start."""
    inherited = str(FOLDER) in os.environ.get("PYTHONPATH", "").split(os.pathsep)  # by a worker of pytest-xdist
    if config.getoption("--plain-kernels") and not inherited:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(FOLDER), os.environ.get("PYTHONPATH")]))
        spec = importlib.util.spec_from_file_location("plain_settings", FOLDER / "sitecustomize.py")
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
