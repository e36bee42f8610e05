"""What may not happen while a kernel is recorded: virtual calls record one function of every living plugin.

Also of those in scenes nobody needs any more.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any

import drjit as dr
import mitsuba as mi

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


def aside(build: Callable[[mi.Shape], Any], shape: mi.Shape) -> Any:
    """`build(shape)` evaluated now, even while this thread records a kernel; its gradients are not tracked.

    Light tracers first meet the emitter in the middle of a recording, when nothing can be evaluated. Dr.Jit records
    by thread, so a thread of its own is free to.
    """

    def run() -> Any:
        with dr.suspend_grad():
            return build(shape)

    with ThreadPoolExecutor(1) as pool:
        built = pool.submit(run).result()
    # What this thread records from now on comes after what that one left unevaluated: on CUDA the handle of a scene.
    dr.detail.new_scope(dr.backend_v(mi.Float))
    return built


def dark_elsewhere(*kinds: str) -> Callable[[Callable], Callable]:
    """Decorator of an emitter's method: zeros of these kinds where its surface is another scene's and unsound."""

    def decorate(method: Callable) -> Callable:
        @wraps(method)
        def guarded(emitter: Any, *arguments: Any, **named: Any) -> Any:
            if emitter.sound():
                return method(emitter, *arguments, **named)
            zeros = tuple(dr.zeros(getattr(mi, kind)) for kind in kinds)
            return zeros if len(zeros) > 1 else zeros[0]

        return guarded

    return decorate


def scene_is_checked() -> bool:
    """True while kernels of a scene are recorded whose own surfaces are known to be sound."""
    return _checked.get()
