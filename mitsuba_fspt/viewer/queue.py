"""Requests that wait for the one thread that renders: the latest of each page and lens, drafts before full images."""

from __future__ import annotations

import threading
from typing import Protocol

from .answers import Answer, Request, Superseded


class Page(Protocol):
    """A page that waits for answers."""

    def put_from_thread(self, answer: Answer) -> None:
        """Add an answer, from any thread."""


class RequestQueue:
    """Latest request of each page, lens and kind; those of a page that has gone are dropped."""

    def __init__(self) -> None:
        self._waiting: dict[tuple[Page, str, str, bool], Request] = {}
        self._changed = threading.Condition()
        self._newest: dict[tuple[Page, str], int] = {}  # number of the last image requested

    def put(self, page: Page, request: Request) -> None:
        """Add a request. It replaces those of the same page, lens and kind; but a full image replaces no draft."""
        with self._changed:
            for fine in (True,) if request.fine else (True, False):
                self._waiting.pop((page, request.slot, request.kind, fine), None)
            self._waiting[(page, request.slot, request.kind, request.fine)] = request
            if request.kind == "picture":
                self._newest[(page, request.slot)] = request.number
            self._changed.notify()

    def take(self, timeout: float) -> tuple[Page, Request] | None:
        """Next request and its page: a draft if there is one, else the oldest; None if none comes in `timeout` [s]."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout)
            if not self._waiting:
                return None
            key = next((key for key, request in self._waiting.items() if not request.fine), next(iter(self._waiting)))
            return key[0], self._waiting.pop(key)

    def put_back(self, page: Page, request: Request) -> None:
        """Add a request again that was interrupted, unless a newer one replaces it."""
        with self._changed:
            if self._is_newest(page, request):
                self._waiting.setdefault((page, request.slot, request.kind, request.fine), request)

    def forget(self, page: Page) -> None:
        """Drop the requests of a page."""
        with self._changed:
            for key in [key for key in self._waiting if key[0] is page]:
                del self._waiting[key]
            for place in [place for place in self._newest if place[0] is page]:
                del self._newest[place]

    def check(self, page: Page, request: Request) -> None:
        """Raise Superseded if a draft waits, or if a newer image has been requested in place of `request`."""
        with self._changed:
            draft_waits = any(not waiting.fine for waiting in self._waiting.values())
            if draft_waits or not self._is_newest(page, request):
                raise Superseded

    def _is_newest(self, page: Page, request: Request) -> bool:
        return request.kind != "picture" or self._newest.get((page, request.slot)) == request.number
