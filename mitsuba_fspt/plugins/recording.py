"""What may not happen while a kernel is recorded."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def nothing_collected() -> Iterator[None]:
    """Hold garbage collection back.

    A virtual call records one function per living plugin. Did a scene nobody needs any more disappear between two calls
    in the same kernel, they would differ, and Dr.Jit would define one function twice and abort the process.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
