"""Progress of long work: a bar on a terminal and in a notebook, a line a minute in a pipe, nothing in a script."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from threading import Event, Thread
from typing import TYPE_CHECKING

from .interrupt import ctrl_c_noted

if TYPE_CHECKING:
    from rich.console import Console

NOTEBOOK_DELAY = 1.0  # s: shorter work shows no bar
LINE_EVERY = 60.0  # s between the lines in a pipe
Progress = Callable[[str, float], None]  # called with the name of the stage and the share done in [0, 1]


def in_notebook() -> bool:
    """True in a Jupyter kernel."""
    python = sys.modules.get("IPython")  # a kernel has imported it, and the import takes 0.15 s
    shell = python.get_ipython() if python else None
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


@contextmanager
def progress_bar(quiet: bool = False, delay: float = 0.0) -> Iterator[Progress]:
    """Context manager that yields a function (name of the stage, share done in [0, 1]), which shows a progress bar.

    The bar has the time passed and an estimate of the time left, as if the rest took its share of the time. In a pipe,
    a line on stderr says the same after every minute. Nothing is shown if `quiet`, or before `delay` [s] have passed.
    The function, and the end of the block,
    raise KeyboardInterrupt if Ctrl-C was pressed before, because the exception of Ctrl-C can be lost in the renderer.
    """
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True, force_jupyter=in_notebook())
    shown = console.is_terminal or console.is_jupyter
    hidden = quiet or not shown
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[left]}")
    bar = Bar(*columns, console=console, transient=True)
    task, begun = bar.add_task("loading", total=None, left=""), time.monotonic()
    stage = _Stage(begun)

    def show() -> None:
        if not (hidden or bar.live.is_started) and time.monotonic() >= begun + delay:
            bar.start()

    def report(what: str, share: float) -> None:
        check_interrupt()
        stage.reached(what, share)
        bar.update(task, description=what, total=1.0, completed=share, left=stage.left())
        show()

    with ctrl_c_noted() as check_interrupt, _lines(stage, None if quiet or shown else console):
        show()
        try:
            yield report
            check_interrupt()
        finally:
            if bar.live.is_started:
                bar.stop()


class _Stage:
    """Stage of long work that was reported last, and the times that follow from it; `begun` by the monotonic clock."""

    def __init__(self, begun: float) -> None:
        self._begun = begun
        self._what, self._share, self._whole = "loading", 0.0, 0.0

    def reached(self, what: str, share: float) -> None:
        """Set the name of the stage and the share done, from which the whole time follows."""
        self._what, self._share = what, share
        self._whole = self._passed() / share if share > 0 else 0.0

    def _passed(self) -> float:
        return time.monotonic() - self._begun

    def left(self) -> str:
        """The time left as text, empty where nothing is done that it could be estimated from."""
        return f"about {_clock(self._whole - self._passed())} left" if self._whole else ""

    def line(self) -> str:
        """Stage, share done, time passed and time left in one line."""
        texts = (self._what, f"{100 * self._share:.0f} % after {_clock(self._passed())}", self.left())
        return ", ".join(filter(None, texts))


def _clock(seconds: float) -> str:
    """Hours, minutes and seconds as 0:01:30."""
    return str(timedelta(seconds=round(max(seconds, 0.0))))


@contextmanager
def _lines(stage: _Stage, console: Console | None) -> Iterator[None]:
    """Context manager: writes the line of a stage to the console, if there is one, every `LINE_EVERY` seconds."""
    ended = Event()

    def tell(console: Console) -> None:
        while not ended.wait(LINE_EVERY):
            console.print(f"fspt: {stage.line()}", markup=False, highlight=False, soft_wrap=True)

    if console:
        Thread(target=tell, args=(console,), daemon=True).start()
    try:
        yield
    finally:
        ended.set()


@contextmanager
def reported(progress: Progress | None) -> Iterator[Progress]:
    """Context manager that yields the function to which long work in Python reports: `progress`, or a notebook's bar.

    The function, and the end of the block, raise KeyboardInterrupt if Ctrl-C was pressed before.
    """
    if progress is None and in_notebook():
        with progress_bar(delay=NOTEBOOK_DELAY) as report:
            yield report
        return
    with ctrl_c_noted() as check_interrupt:

        def report(what: str, share: float) -> None:
            check_interrupt()
            if progress:
                progress(what, share)

        yield report
        check_interrupt()
