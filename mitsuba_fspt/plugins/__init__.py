"""The three plugins, registered with whichever JIT variant of Mitsuba is active. One plugin a file."""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

_NAMES = ("surface", "lens", "integral")
_registered: set[str] = set()


def register() -> None:
    """Register `fspt_surface`, `fspt_lens` and `fspt_integral` with the active variant; a no-op the second time.

    The classes derive from the active variant's base classes, so their modules run once for every variant.
    Scalar variants get none: Python plugins crawl there, and mesh attribute emitters crash.
    """
    variant = mi.variant()
    if variant is None or variant.startswith("scalar") or variant in _registered:
        return
    _registered.add(variant)
    for name in _NAMES:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


if mi.variant() is not None:
    register()
