"""What verbs print, and the error of an interrupt that leaves finished files behind."""

from __future__ import annotations

import json

import typer

from ..runtime.errors import FsptError


class Interrupted(FsptError):
    """Ctrl-C in a verb whose finished files stay; the message says how to continue."""


def print_result(text: str, record: object, *, as_json: bool, quiet: bool) -> None:
    """Print what a verb found on stdout: the `record` as JSON with --json, else the text, with --quiet nothing."""
    if as_json:
        typer.echo(json.dumps(record, allow_nan=False))
    elif not quiet:
        typer.echo(text)
