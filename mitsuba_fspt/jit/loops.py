"""Loops inside one kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


def repeat(count: int | mi.UInt32, body: Callable[..., tuple], *state: Any) -> tuple:
    """`state` after `count` rounds of state = body(k, *state), as one loop inside the kernel."""
    start = (mi.UInt32(0), *state)
    return dr.while_loop(start, lambda k, *_: k < count, lambda k, *state: (k + 1, *body(k, *state)))[1:]
