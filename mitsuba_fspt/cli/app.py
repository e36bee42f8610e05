"""The command line `fspt`: its verbs, its exit codes, and one line on stderr for every error."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from io import TextIOWrapper
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from ..runtime.errors import FsptError
from ..runtime.interrupt import ctrl_c_noted, terminated_as_by_ctrl_c
from .calibrate import calibrate
from .camera import app as camera
from .checks import doctor, explain, stability
from .converge import converge
from .expose import expose
from .flux import app as flux
from .images import compare, plot, roi
from .invert import invert
from .locate import locate
from .matrix import matrix
from .reduce import reduce
from .render import render
from .scene import app as scene
from .sweep import sweep
from .terminal import Interrupted
from .view import view

app = typer.Typer(
    name="fspt",
    help="Calibrated CCD images of glowing phantoms, in watts per pixel.",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich would take units in brackets for markup and leave them out
    pretty_exceptions_enable=False,
)
VERBS = (
    *(render, plot, compare, roi, expose, doctor, stability, explain, sweep, converge),
    *(matrix, reduce, invert, locate, calibrate, view),
)
for verb in VERBS:
    app.command()(verb)
app.add_typer(flux, name="flux")
app.add_typer(scene, name="scene")
app.add_typer(camera, name="camera")

INTERRUPTED = 130  # exit code after Ctrl-C or SIGTERM


@app.callback(invoke_without_command=True)
def fspt(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Calibrated CCD images of glowing phantoms, in watts per pixel."""
    if version:
        from importlib.metadata import version as of

        typer.echo(f"mitsuba-fspt {of('mitsuba-fspt')}")
        raise typer.Exit()


def main() -> None:
    """Entry point: run the command line and exit with 0, 2 for bad input or 130 for Ctrl-C and SIGTERM."""
    terminated_as_by_ctrl_c()
    if isinstance(sys.stdout, TextIOWrapper):  # characters that the terminal or pipe cannot encode are escaped
        sys.stdout.reconfigure(errors="backslashreplace")
    code = run(sys.argv[1:])
    if code == INTERRUPTED:  # no orderly exit: the renderer, stopped while it recorded a kernel, may crash in it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


@cache
def _command() -> Callable[..., Any]:
    """The verbs of `app` with their options, read from the signatures once in a process."""
    return _with_options_once(typer.main.get_command(app))


def _with_options_once(command: Any) -> Any:
    """The command, and those of its group, which refuse a second value for an option of one value.

    Of two values the first would be passed over without a word, as of `--free A --free B` for `--free A,B`.
    """
    for part in getattr(command, "commands", {}).values():
        _with_options_once(part)
    original = command.make_parser

    def make_parser(context: Any) -> Any:
        parser = original(context)
        parse = parser.parse_args

        def parse_args(args: list[str]) -> Any:
            found = parse(args=args)
            given = [one for one in found[2] if one.param_type_name == "option" and not (one.multiple or one.is_flag)]
            for one in given if not context.resilient_parsing else ():  # not while a shell completes a line
                if given.count(one) > 1:
                    context.fail(f"Option '{one.opts[-1]}' is given {given.count(one)} times. Give it once")
            return found

        parser.parse_args = parse_args
        return parser

    command.make_parser = make_parser
    return command


def run(arguments: list[str]) -> int:
    """Exit code of `fspt` with these arguments; an error is printed as one line on stderr."""
    try:
        with ctrl_c_noted():
            code = _command()(args=arguments, prog_name="fspt", standalone_mode=False)
        if code == INTERRUPTED:  # typer returns this after a KeyboardInterrupt
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except Interrupted as error:
        return _fail(str(error), INTERRUPTED)
    except FsptError as error:
        return _fail(str(error))
    except TyperException as error:
        message = getattr(error, "format_message", error.__str__)() or "Missing command"
        context = getattr(error, "ctx", None)
        return _fail(f"{message.rstrip('.')}. See '{context.command_path if context else 'fspt'} --help'.")
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written.", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except MemoryError as error:
        return _fail(f"out of memory: {error}. Give fewer pixels, or a smaller mesh.")
    except Exception as error:
        if os.environ.get("FSPT_DEBUG"):
            raise
        return _fail(f"{type(error).__name__}: {error} (FSPT_DEBUG=1 shows where)", 1)


def _fail(message: str, code: int = 2) -> int:
    """Print the message as one line on stderr and return the exit code."""
    with suppress(OSError):  # stderr is closed
        typer.echo(f"fspt: {' '.join(message.split())}", err=True)
    return code
