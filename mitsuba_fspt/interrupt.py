"""Ctrl-C while the renderer calls back: what is raised in a plugin's method or a recorded loop can be lost or turned
into another exception on its way through C++.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from .errors import FsptError


@contextmanager
def ctrl_c_noted() -> Iterator[Callable[[], None]]:
    """A function that raises KeyboardInterrupt if Ctrl-C was pressed before; the usual exception comes, too.

    What else but our own errors comes after Ctrl-C becomes KeyboardInterrupt; what Python could only tell of, as it
    came in a destructor, is not told. Nothing is done where there is no `_handler`.
    """
    pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        before(number, frame)

    def tell(lost: sys.UnraisableHookArgs) -> None:
        if not pressed:
            told_before(lost)

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = _handler()
    if before is None:
        yield check
        return
    told_before = sys.unraisablehook
    signal.signal(signal.SIGINT, note)
    sys.unraisablehook = tell
    try:
        yield check
    except FsptError:
        raise
    except Exception as error:
        if pressed:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = told_before


@contextmanager
def ctrl_c_held() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: what is written in C++ and not made to be interrupted may end the process.

    Nothing is done where there is no `_handler`.
    """
    before = _handler()
    if before is None:
        yield
        return
    pressed: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda number, frame: pressed.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pressed:
            before(signal.SIGINT, pressed[0])


def _handler() -> Callable[[int, FrameType | None], object] | None:
    """What Ctrl-C calls; None where it is ignored, and in other threads than the main one, which alone hears of it."""
    handler = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    return handler if in_main and callable(handler) else None
