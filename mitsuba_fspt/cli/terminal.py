"""Progress on the terminal, and the error of an interrupt that leaves finished files behind."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console

from ..runtime.errors import FsptError
from ..runtime.interrupt import ctrl_c_noted


class Interrupted(FsptError):
    """Ctrl-C in a verb whose finished files stay; the message says how to continue."""


def print_result(text: str, record: object, *, as_json: bool, quiet: bool) -> None:
    """Print what a verb found on stdout: the `record` as JSON with --json, else the text, with --quiet nothing."""
    if as_json:
        typer.echo(json.dumps(record, allow_nan=False))
    elif not quiet:
        typer.echo(text)


@contextmanager
def progress_bar(quiet: bool = False) -> Iterator[Callable[[str, float], None]]:
    """A function of (what is being done, share done in [0, 1]) that shows a progress bar.

    In a pipe it shows nothing, nor if `quiet`.

    The function raises KeyboardInterrupt if Ctrl-C was pressed before, as the exception that Ctrl-C raises can get lost
    in the renderer.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    bar = Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal)
    with ctrl_c_noted() as check_interrupt, bar:
        task = bar.add_task("loading", total=None)

        def report(what: str, share: float) -> None:
            check_interrupt()
            bar.update(task, description=what, total=1.0, completed=share)

        yield report
