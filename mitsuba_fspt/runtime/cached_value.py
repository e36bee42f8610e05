"""Cache of one result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class CachedValue:
    """Cache of one result, which is valid while the `state` that it depends on is unchanged."""

    def __init__(self) -> None:
        self._state: object = None
        self._found: Any = None
        self._held: object = None

    def recall(self, state: object, find: Callable[[], Any], held: object = None) -> Any:
        """Result of `find` for this state, computed if the state has changed.

        held : what the state identifies by numbers that others may have once it is gone; kept as long as the result
        """
        if state != self._state:
            self._found = find()
            self._state, self._held = state, held
        return self._found
