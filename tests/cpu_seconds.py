"""Plugin of pytest: CPU seconds of the tests, the dearest ten of them, ten files and all processes, at the end.

Wall times on a busy machine say little, so that the budget of the suite is one of CPU time. The time of a test is that
of this process with all its threads and of the child processes that have ended meanwhile. With `--quick`, the tests
that a committed table lists are left out.
"""

from __future__ import annotations

import csv
import os
from collections import Counter
from pathlib import Path

import pytest

BUDGET = 600.0  # seconds of CPU of the whole suite with an empty kernel cache: five minutes of two cores
DEAREST = 10
DEAR = Path(__file__).with_name("dear_tests.csv")  # functions of which a case takes `LEAST_DEAR` seconds
LEAST_DEAR = 1.0


def cpu() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def dear_tests() -> dict[str, float]:
    """CPU seconds of the dearest case of each function in the table."""
    with DEAR.open(newline="", encoding="utf-8") as file:
        return {row["test"]: float(row["cpu_seconds"]) for row in csv.DictReader(file)}


def function_of(name: str) -> str:
    """Name of a test without its case."""
    return name.partition("[")[0]


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
        """With `--quick`, leave out all cases of the functions of the table: they share what is made once."""
        if config.getoption("quick"):
            dear = dear_tests()
            left_out = [item for item in items if function_of(item.nodeid) in dear]
            items[:] = [item for item in items if function_of(item.nodeid) not in dear]
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
                rows = [(f"{seconds:.2f}", name) for name, seconds in self.tests.most_common()]
                csv.writer(file).writerows([("cpu_seconds", "test"), *rows])
        if config.getoption("list_dear"):
            dear = dear_tests() if config.getoption("quick") else {}
            for name, seconds in self.tests.items():
                if seconds >= LEAST_DEAR:
                    dear[function_of(name)] = max(dear.get(function_of(name), 0.0), seconds)
            with DEAR.open("w", newline="", encoding="utf-8") as file:
                rows = [(f"{seconds:.1f}", name) for name, seconds in Counter(dear).most_common()]
                csv.writer(file, lineterminator="\n").writerows([("cpu_seconds", "test"), *rows])
        if config.getoption("quick"):
            terminalreporter.write_line(f"--quick: the cases of {len(dear_tests())} functions were left out")
        limit = config.getoption("cpu_limit")
        verdict = "over" if self.total > (BUDGET if limit is None else limit) else "within"
        text = f"{self.total:7.1f}  in all, {verdict} the budget of {BUDGET if limit is None else limit:.0f}"
        terminalreporter.write_line(text, yellow=verdict == "over")


def pytest_addoption(parser) -> None:
    text = "fail if the tests take more CPU seconds than this; without it, the summary tells it"
    parser.addoption("--cpu-limit", type=float, default=None, metavar="SECONDS", help=text)
    parser.addoption("--cpu-table", metavar="FILE.csv", help="write the CPU seconds of every test")
    parser.addoption("--quick", action="store_true", help=f"leave out the tests listed in tests/{DEAR.name}")
    text = f"write that list: functions of which a case took {LEAST_DEAR:.0f} s of CPU; with --quick, add to it"
    parser.addoption("--list-dear", action="store_true", help=text)


def pytest_configure(config) -> None:
    config.pluginmanager.register(Spent(), "cpu_seconds_spent")
