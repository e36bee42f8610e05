"""Time limit of long work."""

from __future__ import annotations

import math
import time

from .errors import FsptError
from .numbers import number

LEAST_TIME = 1e-3  # s: what a part of the work gets when no time is left


class Deadline:
    """Moment from which on work that may be left out is left out.

    cut : True once work was left out
    """

    def __init__(self, seconds: float | None = None) -> None:
        """`seconds` from now; None: never."""
        self.end = math.inf if seconds is None else time.monotonic() + seconds
        self.cut = False

    @property
    def is_set(self) -> bool:
        """True unless it is never."""
        return self.end < math.inf

    @property
    def left(self) -> float:
        """Time until then [s], negative afterwards; inf if it is never."""
        return self.end - time.monotonic()

    def passed(self) -> bool:
        """True from that moment on. Ask where work can be left out, and leave it out then: `cut` becomes True."""
        if self.left > 0:
            return False
        self.cut = True
        return True


def required_time(thing: str, seconds: object, error: type[FsptError]) -> float | None:
    """Time limit [s] as a float, None for None; `error`, in the name of `thing`, unless it is > 0 and finite."""
    if seconds is None:
        return None
    found = number(f"{thing}: 'max_time'", seconds, error, "60")
    if not 0 < found < math.inf:
        raise error(f"{thing}: 'max_time' must be > 0 s and finite, got {found:g}. Give for example 60.")
    return found
