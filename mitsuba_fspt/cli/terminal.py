"""Progress on the terminal, and the error of an interrupt that leaves finished files behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console

from ..runtime.errors import FsptError
from ..runtime.interrupt import ctrl_c_noted


class Interrupted(FsptError):
    """Ctrl-C in a verb whose finished files stay; the message says how to continue."""


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A function of (what is being done, share done in [0, 1]) that shows a progress bar; in a pipe it shows nothing.

    The function raises KeyboardInterrupt if Ctrl-C was pressed before, as the exception that Ctrl-C raises can get lost
    in the renderer.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    with ctrl_c_noted() as check_interrupt, bar:
        task = bar.add_task("loading", total=None)

        def report(what: str, share: float) -> None:
            check_interrupt()
            bar.update(task, description=what, total=1.0, completed=share)

        yield report
