"""Progress of long work: a bar on a terminal and in a notebook, nothing in a pipe or a script."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .interrupt import ctrl_c_noted

NOTEBOOK_DELAY = 1.0  # s: shorter work shows no bar
Progress = Callable[[str, float], None]  # called with the name of the stage and the share done in [0, 1]


def in_notebook() -> bool:
    """True in a Jupyter kernel."""
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    shell = get_ipython()  # type: ignore[no-untyped-call]
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


@contextmanager
def progress_bar(quiet: bool = False, delay: float = 0.0) -> Iterator[Progress]:
    """Context manager that yields a function (name of the stage, share done in [0, 1]), which shows a progress bar.

    Nothing is shown in a pipe, if `quiet`, or before `delay` [s] have passed. The function, and the end of the block,
    raise KeyboardInterrupt if Ctrl-C was pressed before, because the exception of Ctrl-C can be lost in the renderer.
    """
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True, force_jupyter=in_notebook())
    hidden = quiet or not (console.is_terminal or console.is_jupyter)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    bar = Bar(*columns, console=console, transient=True)
    task, begun = bar.add_task("loading", total=None), time.monotonic()

    def show() -> None:
        if not (hidden or bar.live.is_started) and time.monotonic() >= begun + delay:
            bar.start()

    def report(what: str, share: float) -> None:
        check_interrupt()
        bar.update(task, description=what, total=1.0, completed=share)
        show()

    with ctrl_c_noted() as check_interrupt:
        show()
        try:
            yield report
            check_interrupt()
        finally:
            if bar.live.is_started:
                bar.stop()


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
