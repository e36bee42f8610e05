"""What the verbs of the command line show while they work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console

from ..runtime.interrupt import ctrl_c_noted


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A progress bar on a terminal, nothing in a pipe; called with what is being done and the share done.

    The call raises KeyboardInterrupt where Ctrl-C was pressed and its exception lost on the way.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    with ctrl_c_noted() as check_interrupt, bar:
        task = bar.add_task("loading", total=None)

        def tell(what: str, share: float) -> None:
            check_interrupt()
            bar.update(task, description=what, total=1.0, completed=share)

        yield tell
