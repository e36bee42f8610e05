"""Exceptions of the package; each message states the object, the value, the rule and the fix in one line."""

from collections.abc import Iterator
from contextlib import contextmanager

LONGEST_TEXT = 200  # characters of another library's message within one of ours


class FsptError(ValueError):
    """Base class of the package's exceptions; the command line prints the message as one line and exits with code 2."""


class OpticsError(FsptError):
    """A lens that cannot exist or cannot form a real image."""


class ExitanceError(FsptError):
    """A surface flux density J_n that is missing, not finite or negative."""


class SceneError(FsptError):
    """A scene file, mesh or parameter that cannot be used."""


class ImageError(FsptError):
    """An image that cannot be read, written or compared."""


class FluxError(FsptError):
    """Tissue data (a mesh, values on it, a phantom description) that gives no surface flux density."""


class BackendError(FsptError, ImportError):
    """No usable LLVM or CUDA, or a missing system library or optional package."""


class DetectorError(FsptError):
    """A detector parameter, or a parameter of an exposure, outside its range."""


class TransportError(FsptError):
    """A transport matrix that cannot be made, stored, read, or applied to what is given."""


class ViewerError(FsptError):
    """A port that cannot be opened, or a request of a page that cannot be understood."""


class InversionError(FsptError):
    """Images from which J_n, a source or a camera's parameters cannot be inferred, or options that do not fit them."""


@contextmanager
def named(thing: str) -> Iterator[None]:
    """Context manager: puts `thing: ` before the message of an FsptError that its block raises."""
    try:
        yield
    except FsptError as error:
        raise type(error)(f"{thing}: {error}") from error


@contextmanager
def renamed(verb: str, other: str) -> Iterator[None]:
    """Context manager: `other: ` takes the place of the first `verb: ` in the message of an FsptError of its block."""
    try:
        yield
    except FsptError as error:
        raise type(error)(str(error).replace(f"{verb}: ", f"{other}: ", 1)) from error


def one_line(cause: object, longest: int | None = None) -> str:
    """Text of an exception, else the name of its class, on one line without full stop; at most `longest` characters."""
    return " ".join(str(cause).split())[:longest].rstrip(".") or type(cause).__name__
