"""Cache of one result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class CachedValue:
    """Cache of one result, which is valid while the `state` that it depends on is unchanged."""

    def __init__(self) -> None:
        self._state: object = None
        self._found: Any = None

    def recall(self, state: object, find: Callable[[], Any]) -> Any:
        """Result of `find` for this state, computed if the state has changed."""
        if state != self._state:
            self._found = find()
            self._state = state
        return self._found
