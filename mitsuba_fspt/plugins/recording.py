"""What may not happen while a kernel is recorded: virtual calls record one function of every living plugin.

Also of those in scenes nobody needs any more.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_checked = ContextVar("scene_is_checked", default=False)


@contextmanager
def recording() -> Iterator[None]:
    """Record kernels of a scene that was checked: nothing is collected, and a bad surface elsewhere is dark.

    Did a plugin disappear between two calls in the same kernel, they would differ, and Dr.Jit would define one function
    twice and abort the process.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    token = _checked.set(True)
    try:
        yield
    finally:
        _checked.reset(token)
        if was_enabled:
            gc.enable()


def scene_is_checked() -> bool:
    """True while kernels of a scene are recorded whose own surfaces are known to be sound."""
    return _checked.get()
