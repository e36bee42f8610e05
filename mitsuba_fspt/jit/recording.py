"""Recording of kernels: a virtual call records the function of every existing plugin, those of other scenes included.

Plugins must therefore not be deleted during a recording, and invalid surfaces of other scenes must not raise in it.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import drjit as dr
import mitsuba as mi

_checked = ContextVar("scene_is_checked", default=False)


@contextmanager
def recording() -> Iterator[None]:
    """Context manager for kernels of a checked scene: no garbage collection; invalid surfaces of other scenes are dark.

    If a plugin were deleted between two calls in one kernel, the calls would differ, and Dr.Jit would define one
    function twice and abort the process.
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


def evaluated_outside(build: Callable[[mi.Shape], Any], shape: mi.Shape) -> Any:
    """Result of `build(shape)`, evaluated at once even while this thread records a kernel; without gradients.

    Light tracers first call the emitter in the middle of a recording, when its thread cannot evaluate arrays. Dr.Jit
    records per thread, so that another thread can.
    """

    def run() -> Any:
        with dr.suspend_grad():
            return build(shape)

    with ThreadPoolExecutor(1) as pool:
        built = pool.submit(run).result()
    # On CUDA the other thread leaves the handle of a scene unevaluated. In a new scope the operations of this thread
    # follow that evaluation.
    dr.detail.new_scope(dr.backend_v(mi.Float))
    return built


def scene_is_checked() -> bool:
    """True while kernels are recorded for a scene whose own surfaces have been checked."""
    return _checked.get()
