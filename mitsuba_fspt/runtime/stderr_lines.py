"""Warnings as lines on stderr."""

from __future__ import annotations

import logging
from collections.abc import Sequence

LOG = logging.getLogger("mitsuba_fspt")


def told(verb: str, lines: Sequence[str]) -> list[str]:
    """The lines, each written to stderr as a warning of `verb`."""
    for line in lines:
        LOG.warning("fspt: %s: %s", verb, line)
    return list(lines)
