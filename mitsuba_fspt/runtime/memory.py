"""Memory that this process can still allocate, by the operating system and the limits of a container."""

from __future__ import annotations

import contextlib
from pathlib import Path

MEMINFO = Path("/proc/meminfo")
LIMITS = (  # of a container: limit and use, of control groups of version 2 and 1
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def available_memory() -> int | None:
    """Bytes that can be allocated without paging; None if the system does not state it."""
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        rows = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines() if ":" in line)
        if "MemAvailable" in rows:
            found.append(1024 * int(rows["MemAvailable"].split()[0]))
    for limit, use in LIMITS:
        with contextlib.suppress(OSError, ValueError):  # 'max' where there is no limit
            found.append(max(0, int(limit.read_text()) - int(use.read_text())))
    return min(found, default=None)
