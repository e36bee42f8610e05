"""Tests of whether a Mitsuba object is one of this package's plugins.

They compare class names: every variant has classes of its own, and importing one for `isinstance` would register it
with the active variant.
"""

from __future__ import annotations


def is_surface(emitter: object) -> bool:
    """True if `emitter` is an `fspt_surface`."""
    return type(emitter).__name__ == "FsptSurface"


def is_lens(sensor: object) -> bool:
    """True if `sensor` is an `fspt_lens`."""
    return type(sensor).__name__ == "FsptLens"


def is_integral(integrator: object) -> bool:
    """True if `integrator` is an `fspt_integral`."""
    return type(integrator).__name__ == "FsptIntegral"
