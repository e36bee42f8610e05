"""Plugin of pytest: CPU seconds of the tests, the dearest ten of them, ten files and all processes, at the end.

Wall times on a busy machine say little, so that the budget of the suite is one of CPU time. The time of a test is that
of this process with all its threads and of the child processes that have ended meanwhile. With `--quick`, the tests
that a committed table of these times lists are left out.
"""

from __future__ import annotations

import csv
import os
from collections import Counter
from pathlib import Path

import pytest

BUDGET = 600.0  # seconds of CPU of the whole suite with an empty kernel cache: five minutes of two cores
DEAREST = 10
DEAR = Path(__file__).with_name("dear_tests.csv")  # one test in nine, with three quarters of the time


def cpu() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


class Spent:
    """CPU seconds of each test, and of the workers of pytest-xdist."""

    def __init__(self) -> None:
        self.last, self.tests, self.workers = cpu(), Counter(), 0.0
        self.total = 0.0

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self):
        """Set `cpu` of the report of set-up, test or tear-down to the seconds since the report before it."""
        outcome = yield
        self.last, before = cpu(), self.last
        outcome.get_result().cpu = self.last - before

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config, items) -> None:
        if config.getoption("quick"):
            with DEAR.open(newline="", encoding="utf-8") as file:
                dear = {row["test"] for row in csv.DictReader(file)}
            left_out = [item for item in items if item.nodeid in dear]
            items[:] = [item for item in items if item.nodeid not in dear]
            config.hook.pytest_deselected(items=left_out)

    def pytest_runtest_logreport(self, report) -> None:
        self.tests[report.nodeid] += getattr(report, "cpu", 0.0)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node) -> None:
        self.workers += getattr(node, "workeroutput", {}).get("cpu", 0.0)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session) -> None:
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["cpu"] = cpu()
            return
        self.total = sum(os.times()[:2]) + (self.workers or sum(os.times()[2:4]))
        limit = session.config.getoption("cpu_limit")
        if limit is not None and self.total > limit and not session.exitstatus:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter, config) -> None:
        files: Counter[str] = Counter()
        for name, seconds in self.tests.items():
            files[name.partition("::")[0]] += seconds
        for what, spent in (("tests", self.tests), ("files", files)):
            terminalreporter.section(f"dearest {DEAREST} {what}, CPU seconds")
            for name, seconds in spent.most_common(DEAREST):
                terminalreporter.write_line(f"{seconds:7.1f}  {name}")
        if table := config.getoption("cpu_table"):
            with Path(table).open("w", newline="", encoding="utf-8") as file:
                least, spent = config.getoption("cpu_least"), self.tests.most_common()
                rows = [(f"{seconds:.2f}", name) for name, seconds in spent if seconds >= least]
                csv.writer(file).writerows([("cpu_seconds", "test"), *rows])
        limit = config.getoption("cpu_limit")
        verdict = "over" if self.total > (BUDGET if limit is None else limit) else "within"
        text = f"{self.total:7.1f}  in all, {verdict} the budget of {BUDGET if limit is None else limit:.0f}"
        terminalreporter.write_line(text, yellow=verdict == "over")


def pytest_addoption(parser) -> None:
    text = "fail if the tests take more CPU seconds than this; without it, the summary tells it"
    parser.addoption("--cpu-limit", type=float, default=None, metavar="SECONDS", help=text)
    parser.addoption("--cpu-table", metavar="FILE.csv", help="write the CPU seconds of every test")
    text = "leave out of the table tests that take less"
    parser.addoption("--cpu-least", type=float, default=0.0, metavar="SECONDS", help=text)
    parser.addoption("--quick", action="store_true", help=f"leave out the tests listed in tests/{DEAR.name}")


def pytest_configure(config) -> None:
    config.pluginmanager.register(Spent(), "cpu_seconds_spent")
