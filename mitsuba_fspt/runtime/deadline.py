"""Time limit of long work."""

from __future__ import annotations

import math
import time

from .errors import FsptError
from .numbers import number

LEAST_TIME = 1e-3  # s: time for a part of the work when none is left


class Deadline:
    """Time limit, after which work that is not indispensable is skipped.

    cut : True once work has been skipped
    """

    def __init__(self, seconds: float | None = None) -> None:
        """`seconds` from now; None: no limit."""
        self.end = math.inf if seconds is None else time.monotonic() + seconds
        self.cut = False

    @property
    def is_set(self) -> bool:
        """True if there is a limit."""
        return self.end < math.inf

    @property
    def left(self) -> float:
        """Time left [s], negative after the limit; inf without one."""
        return self.end - time.monotonic()

    def passed(self) -> bool:
        """True after the limit, which also sets `cut`: call it only where work is then skipped."""
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
