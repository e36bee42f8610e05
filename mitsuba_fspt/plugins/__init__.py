"""The three plugins, registered with the active JIT variant of Mitsuba; one plugin per file."""

from __future__ import annotations

import importlib
import sys
from functools import wraps
from typing import Any

import mitsuba as mi

from ..runtime.backend import SUPPORTED, refusal
from ..runtime.errors import BackendError, FsptError

_NAMES = ("surface", "lens", "integral")
# Kept when the module is reloaded, as Mitsuba 3.10 does after each switch of the variant.
_registered: set[str] = globals().get("_registered", set())


def register() -> None:
    """Register `fspt_surface`, `fspt_lens` and `fspt_integral` with the active variant, once per variant.

    The classes derive from the active variant's base classes, so their modules are executed once for every variant.
    Scalar variants get plugins that refuse: Python plugins are very slow there, and mesh attribute emitters crash.
    Metal variants do, too, for they have no float64.
    """
    variant = mi.variant()
    if variant is None:
        return
    _end_in_own_errors()
    if variant in _registered:
        return
    _refuse_in("scalar_rgb")
    if not variant.startswith(SUPPORTED):
        _refuse_in(variant)
        return
    _registered.add(variant)
    for name in _NAMES:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


def _end_in_own_errors() -> None:
    """Replace `mi.render` by a function that raises this package's own errors.

    `mi.render` calls the integrator through Dr.Jit, which wraps every error in a RuntimeError whose message only refers
    to the error above it. The replacement raises an FsptError itself; all other errors stay as they are.
    """
    inner = mi.render
    if getattr(inner, "ends_in_own_errors", False):
        return

    @wraps(inner)
    def render(*arguments: Any, **named: Any) -> Any:
        try:
            return inner(*arguments, **named)
        except RuntimeError as error:
            own = error.__cause__
            if not isinstance(own, FsptError):
                raise
        try:
            raise own  # outside of the handler, else the RuntimeError would be its context
        finally:
            del own  # it refers to this frame

    render.ends_in_own_errors = True  # type: ignore[attr-defined]
    mi.render = render


def _refuse_in(variant: str) -> None:
    """Register plugins that refuse a variant which is not supported.

    In every variant `mi.load_dict` asks scalar_rgb for the kind of a plugin's name. If the name is unknown there, it
    takes equal emitters of two shapes for one and the same emitter, which cannot belong to both.
    """
    if variant in _registered:
        return
    _registered.add(variant)
    kinds = importlib.import_module(f"mitsuba.{variant}")

    def refuse(props: mi.Properties) -> None:
        raise BackendError(
            f"{props.plugin_name()}: {refusal(variant)} "
            "Call mi.set_variant('llvm_ad_mono') or 'cuda_ad_mono' before loading the scene."
        )

    kinds.register_emitter("fspt_surface", refuse)
    kinds.register_sensor("fspt_lens", refuse)
    kinds.register_integrator("fspt_integral", refuse)


if mi.variant() is not None:
    register()
