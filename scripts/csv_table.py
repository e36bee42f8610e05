"""Tables that scripts write as CSV."""

from __future__ import annotations

import csv
from collections.abc import Collection, Mapping
from pathlib import Path

from mitsuba_fspt.runtime.atomic_files import atomic_path


def write_rows(path: Path, rows: Collection[Mapping[str, object]]) -> None:
    """Write rows with the same names, at least one, the names on the first line; whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(next(iter(rows))), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
