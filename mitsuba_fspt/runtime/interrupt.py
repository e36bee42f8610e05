"""Ctrl-C while the renderer calls back: what is raised in a plugin's method or a recorded loop can be lost or turned
into another exception on its way through C++. SIGTERM is treated alike where the process has made it raise, too.
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
    came in a destructor, is not told. Nothing is done where there are no `_handlers`.
    """
    pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        before[number](number, frame)

    def tell(lost: sys.UnraisableHookArgs) -> None:
        if not pressed:
            told_before(lost)

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = _handlers()
    if not before:
        yield check
        return
    told_before = sys.unraisablehook
    for number in before:
        signal.signal(number, note)
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
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = told_before


@contextmanager
def ctrl_c_held() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: what is written in C++ and not made to be interrupted may end the process.

    Nothing is done where there are no `_handlers`.
    """
    before = _handlers()
    pressed: list[tuple[int, FrameType | None]] = []
    for number in before:
        signal.signal(number, lambda number, frame: pressed.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if pressed:
            number, frame = pressed[0]
            before[number](number, frame)


def terminated_as_by_ctrl_c() -> None:
    """From here on SIGTERM raises KeyboardInterrupt, so that nothing is left behind: files, folders, processes."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def _handlers() -> dict[int, Callable[[int, FrameType | None], object]]:
    """What Ctrl-C and SIGTERM call; without those that are ignored or end the process at once.

    None in other threads than the main one, which alone hears of them.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    return {number: handler for number, handler in found.items() if callable(handler)}
