"""The three plugins, registered with whichever JIT variant of Mitsuba is active. One plugin a file."""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from ..runtime.errors import BackendError

_NAMES = ("surface", "lens", "integral")
_registered: set[str] = set()


def register() -> None:
    """Register `fspt_surface`, `fspt_lens` and `fspt_integral` with the active variant; a no-op the second time.

    The classes derive from the active variant's base classes, so their modules run once for every variant.
    Scalar variants get only a refusal: Python plugins crawl there, and mesh attribute emitters crash.
    """
    variant = mi.variant()
    if variant is None or variant in _registered:
        return
    _refuse_in("scalar_rgb")
    if variant.startswith("scalar"):
        _refuse_in(variant)
        return
    _registered.add(variant)
    for name in _NAMES:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


def _refuse_in(variant: str) -> None:
    """Register plugins that refuse a scalar variant.

    Whatever the active variant, `mi.load_dict` asks scalar_rgb what kind of plugin a name is. Left without an answer
    it takes equal emitters of two shapes for copies of one, which then cannot stand on both.
    """
    if variant in _registered:
        return
    _registered.add(variant)
    kinds = importlib.import_module(f"mitsuba.{variant}")

    def refuse(props: mi.Properties) -> None:
        raise BackendError(
            f"{props.plugin_name()}: {variant} is scalar, mitsuba_fspt needs a vectorised variant. "
            "Call mi.set_variant('llvm_ad_mono') or 'cuda_ad_mono' before loading the scene."
        )

    kinds.register_emitter("fspt_surface", refuse)
    kinds.register_sensor("fspt_lens", refuse)
    kinds.register_integrator("fspt_integral", refuse)


if mi.variant() is not None:
    register()
