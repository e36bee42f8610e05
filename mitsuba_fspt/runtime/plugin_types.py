"""Which of Mitsuba's objects are this package's own plugins.

Told by the names of their classes: every variant has classes of its own, and to import one for `isinstance` would
register it with whatever variant is set.
"""

from __future__ import annotations


def is_surface(emitter: object) -> bool:
    """True of an `fspt_surface`."""
    return type(emitter).__name__ == "FsptSurface"


def is_lens(sensor: object) -> bool:
    """True of an `fspt_lens`."""
    return type(sensor).__name__ == "FsptLens"


def is_integral(integrator: object) -> bool:
    """True of an `fspt_integral`."""
    return type(integrator).__name__ == "FsptIntegral"
