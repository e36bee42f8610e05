"""Ctrl-C during a render: an exception raised in a plugin's method or in a recorded loop can be lost, or turned into
another exception, on its way through C++. SIGTERM is handled alike if the process has made it raise.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType
from typing import Any, TypeVar

from .errors import FsptError

Result = TypeVar("Result")
ENDED: ContextVar[threading.Event | None] = ContextVar("ended", default=None)  # of a thread of `in_threads`


@contextmanager
def ctrl_c_noted() -> Iterator[Callable[[], None]]:
    """Context manager that yields a function, which raises KeyboardInterrupt if Ctrl-C was pressed in the block.

    The usual handler runs as well. After Ctrl-C, an exception that leaves the block becomes KeyboardInterrupt unless it
    is an FsptError, and exceptions in destructors, which Python could only print, are suppressed. If `_handlers` is
    empty, the context manager has no effect.
    """
    pressed = False

    def record(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        before[number](number, frame)

    def report_unraisable(lost: sys.UnraisableHookArgs) -> None:
        if not pressed:
            hook_before(lost)

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = _handlers()
    if not before:
        yield check
        return
    hook_before = sys.unraisablehook
    for number in before:
        signal.signal(number, record)
    sys.unraisablehook = report_unraisable
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
        sys.unraisablehook = hook_before


@contextmanager
def ctrl_c_held() -> Iterator[None]:
    """Context manager that delays Ctrl-C to the end of the block.

    An interrupt inside C++ code that is not prepared for it may end the process. If `_handlers` is empty, the context
    manager has no effect.
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
    """Make SIGTERM raise KeyboardInterrupt from now on, so that files, folders and processes are cleaned up."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def in_threads(work: Callable[..., Result], *arguments: Sequence[Any]) -> list[Result]:
    """`work` of the first, second, … of each of the `arguments`, in as many threads as there are processors.

    After Ctrl-C, or where one raises, the others end at their next `end_if_asked`.
    """
    ended = threading.Event()

    def one(*given: Any) -> Result:
        ENDED.set(ended)
        end_if_asked()
        return work(*given)

    with ThreadPoolExecutor(min(len(arguments[0]), os.cpu_count() or 1)) as pool:
        futures = [pool.submit(one, *given) for given in zip(*arguments, strict=True)]
        try:
            done = wait(futures, return_when=FIRST_EXCEPTION).done
            for future in filter(done.__contains__, futures):
                future.result()
            return [future.result() for future in futures]
        except BaseException:
            ended.set()
            raise


def end_if_asked() -> None:
    """Raise KeyboardInterrupt in a thread of `in_threads` that has to end."""
    ended = ENDED.get()
    if ended is not None and ended.is_set():
        raise KeyboardInterrupt


def _handlers() -> dict[int, Callable[[int, FrameType | None], object]]:
    """Python handlers of SIGINT and SIGTERM by signal number; an ignored signal or a default action has none.

    Empty outside the main thread, the only one in which Python handles signals.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    return {number: handler for number, handler in found.items() if callable(handler)}
