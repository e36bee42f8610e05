"""Atomic writing of files: a temporary file beside the final path is written completely, then renamed."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import FsptError


@contextmanager
def atomic_path(path: str | os.PathLike[str], error: type[FsptError] = FsptError) -> Iterator[Path]:
    """Context manager that yields the path of an empty temporary file, renamed to `path` after the block.

    The temporary file lies beside `path` and keeps its suffix, for libraries that choose the format by it. If the
    block raises anything (an error, a full disk, Ctrl-C), the temporary file is removed and `path` is unchanged. An
    OSError is raised again as `error`, any other exception as it is. A symbolic link stays one: the file that it leads
    to is written.

        with atomic_path("phantom.ply", FluxError) as temporary:
            mesh.export(temporary)

    Raises
    ------
    error : `path` is a folder or write-protected, or its folder does not exist, is full or write-protected.
    """
    path = Path(path)
    require_place(path, error)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
        require_place(path, error)
    # A long stem is cut, so that the temporary name is allowed wherever the final one is.
    temporary = path.with_name(f".{path.stem[:40]}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        os.replace(temporary, path)
    except OSError as cause:
        reason = (cause.strerror or str(cause)).replace("\n", " ")
        raise error(f"output file '{path}' cannot be written: {reason}. Give another place for it.") from cause
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def file_path(thing: str, given: object, error: type[FsptError], example: str) -> Path:
    """Name of a file as a path; `error` if `given`, which the message calls `thing`, is no name of a file."""
    if isinstance(given, str) or (isinstance(given, os.PathLike) and isinstance(os.fspath(given), str)):
        return Path(given)
    raise error(f"{thing} must have a name, a text or path, got {given!r:.60}. Give for example '{example}'.")


def require_place(path: Path, error: type[FsptError] = FsptError) -> None:
    """Raise `error` if no file can be written at `path`: it is a folder or write-protected, or has no folder."""
    if os.path.isdir(path):
        raise error(f"output file '{path}' is a folder. Give the name of a file in it.")
    if os.path.isfile(path.parent):
        raise error(f"output file '{path}': '{path.parent}' is a file, not a folder. Give another place.")
    if not os.path.isdir(path.parent):
        raise error(f"output file '{path}': the folder '{path.parent}' does not exist. Create it first.")
    try:
        os.lstat(path)
    except FileNotFoundError:
        pass
    except OSError as cause:  # a name too long
        raise error(f"output file '{path}' cannot be written: {cause.strerror}. Give another name.") from cause
    if os.path.exists(path) and not os.access(path, os.W_OK):
        raise error(f"output file '{path}' is write-protected. Give another name or remove it first.")


def require_apart(output: Path, inputs: Iterable[Path], option: str = "-o", error: type[FsptError] = FsptError) -> None:
    """Raise `error` if the `output` file, named by the command line's `option`, is the same file as an input."""
    for other in inputs:
        same = os.path.realpath(output) == os.path.realpath(other)
        if same or (os.path.exists(output) and os.path.exists(other) and os.path.samefile(output, other)):
            raise error(
                f"output file '{output}': {option} would overwrite '{other}', which is needed too. Give another name."
            )
