"""Progress bars: on a terminal and in a notebook, for long work alone there; nothing in a pipe."""

from __future__ import annotations

import io
import re
import signal
import time

import pytest
from rich.console import Console

from mitsuba_fspt.runtime import progress_bar as module
from mitsuba_fspt.runtime.progress_bar import progress_bar, reported


@pytest.fixture
def screen(monkeypatch):
    """What is written to a terminal of 60 columns."""
    written = io.StringIO()

    def on_terminal(**_):
        return Console(file=written, force_terminal=True, width=60)

    monkeypatch.setattr("rich.console.Console", on_terminal)
    return written


def test_a_terminal_shows_what_is_done_and_a_pipe_nothing(screen, monkeypatch, capsys):
    with progress_bar() as report:
        report("sampling", 0.5)
    assert "sampling" in screen.getvalue()
    monkeypatch.undo()
    with progress_bar() as report:
        report("sampling", 0.5)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_the_time_left(screen, monkeypatch):
    """As if the rest took its share: a quarter in 100 s leaves 300 s. Seen to fail with the time passed for it."""
    clock = iter([0.0, 0.0, *[100.0] * 1000])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    with progress_bar() as report:
        report("sampling", 0.25)
    assert "about 0:05:00 left" in screen.getvalue()


def test_a_pipe_shows_a_line_now_and_then(monkeypatch, capsys):
    """A line after each interval, none before the first and none if quiet."""
    monkeypatch.setattr(module, "LINE_EVERY", 0.2)
    with progress_bar(quiet=True) as report:
        report("sampling", 0.5)
        time.sleep(0.5)
    assert capsys.readouterr().err == ""
    with progress_bar() as report:
        report("sampling", 0.5)
        assert capsys.readouterr().err == ""
        time.sleep(0.7)
    out, err = capsys.readouterr()
    assert out == ""
    assert 1 <= err.count("\n") <= 3
    assert re.fullmatch(r"fspt: sampling, 50 % after 0:00:0\d, about 0:00:0\d left", err.splitlines()[0])
    time.sleep(0.5)
    assert capsys.readouterr().err == ""


def test_quiet_and_short_work_show_nothing(screen):
    with progress_bar(quiet=True) as report:
        report("sampling", 0.5)
    with progress_bar(delay=60) as report:
        report("sampling", 0.5)
    assert screen.getvalue() == ""


def test_a_given_function_is_called_and_a_notebook_shows_a_bar_without_one(screen, monkeypatch):
    monkeypatch.setattr(module, "in_notebook", lambda: True)
    monkeypatch.setattr(module, "NOTEBOOK_DELAY", 0.0)
    calls = []
    with reported(lambda *call: calls.append(call)) as report:
        report("view 1 of 2", 0.5)
    assert calls == [("view 1 of 2", 0.5)]
    assert screen.getvalue() == ""
    with reported(None) as report:
        report("view 1 of 2", 0.5)
    assert "view 1 of 2" in screen.getvalue()


def pressed(call):
    """Press Ctrl-C, whose exception gets lost, in a block of `reported`, and go on with `call` of its function."""
    with reported(None) as report:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            call(report)


def test_ctrl_c_ends_the_work_at_its_next_report():
    after = []
    with pytest.raises(KeyboardInterrupt):
        pressed(lambda report: after.append(report("view 1 of 2", 0.5)))
    assert not after


def test_ctrl_c_after_the_last_report_ends_the_work_too():
    with pytest.raises(KeyboardInterrupt):
        pressed(lambda report: None)
