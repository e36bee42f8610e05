"""What verbs print, and the error of an interrupt that leaves finished files behind."""

from __future__ import annotations

import json
from collections.abc import Iterable

import typer

from ..runtime.errors import FsptError


class Interrupted(FsptError):
    """Ctrl-C in a verb whose finished files stay; the message says how to continue."""


def print_warnings(thing: object, warnings: Iterable[str]) -> None:
    """Print one line on stderr for each warning about a thing, such as a file."""
    for text in warnings:
        typer.echo(f"fspt: {thing}: {text}.", err=True)


def print_result(text: str, record: object, *, as_json: bool, quiet: bool) -> None:
    """Print what a verb found on stdout: the `record` as JSON with --json, else the text, with --quiet nothing."""
    if as_json:
        typer.echo(json.dumps(record, allow_nan=False))
    elif not quiet:
        typer.echo(text)
