"""Tables of Markdown files that scripts write, between a line <!-- table: NAME --> and the next line <!-- /table -->.

In README.md NAME is the script that measures the table: `python scripts/NAME.py --readme README.md` writes it anew.
"""

from __future__ import annotations

import re
from pathlib import Path

from mitsuba_fspt.runtime.atomic_files import atomic_path

OPEN, CLOSE = re.compile(r"^<!-- table: (\S+) -->$", re.M), "<!-- /table -->"


def names(text: str) -> list[str]:
    """Names of the marked tables, in order. Raises ValueError where a marker is not closed before the next one."""
    parts = OPEN.split(text)  # text, name, text, name, …
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        if body.count(CLOSE) != 1:
            raise ValueError(f"table '{name}' has {body.count(CLOSE)} lines {CLOSE}. Give it one.")
    return parts[1::2]


def replace(text: str, name: str, table: str) -> str:
    """The text with this table between the markers of its name. Raises ValueError where it is not marked just once."""
    if names(text).count(name) != 1:
        raise ValueError(
            f"the text has no table '{name}', or several. Mark it with <!-- table: {name} --> and {CLOSE}."
        )
    marked = rf"(<!-- table: {re.escape(name)} -->\n).*?({re.escape(CLOSE)})"
    return re.sub(marked, lambda found: f"{found[1]}\n{table}\n\n{found[2]}", text, flags=re.S)


def write(path: Path, name: str, table: str) -> None:
    """Replace one table of a file, which is written whole or not at all."""
    text = replace(path.read_text(encoding="utf-8"), name, table)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def last_table(text: str) -> str:
    """The last Markdown table of a printed text, its cells without padding. Raises ValueError where there is none."""
    tables = re.findall(r"(?:^\|.*\|[ ]*$\n?)+", text, flags=re.M)
    if not tables:
        raise ValueError("the text has no Markdown table.")
    head, _, *rows = [[cell.strip() for cell in line.strip(" |").split("|")] for line in tables[-1].splitlines()]
    return "\n".join([_line(head), "|" + "---|" * len(head), *map(_line, rows)])


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
