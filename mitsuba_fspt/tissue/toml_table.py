"""Tables of a TOML file, read key by key with a check of each type; a key that is not read is an error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..runtime.errors import FluxError
from ..runtime.toml_file import read_toml

REQUIRED: Any = object()


class Table:
    """One table of a file. `left`: content of the keys not read yet; `name`: the table's name in messages."""

    def __init__(self, content: dict[str, Any], name: str) -> None:
        self.left = dict(content)
        self.name = name

    @classmethod
    def load(cls, path: Path) -> Table:
        """Table of the whole file.

        Raises
        ------
        FluxError : the file cannot be read, or is no TOML.
        BackendError : Python 3.10 without the package tomli.
        """
        return cls(read_toml(path, FluxError), f"'{path.name}'")

    def number(self, key: str, default: float = REQUIRED) -> float:
        """Value of `key`, a number, whole or not."""
        return float(self._take(key, default, (int, float), "a number, for example 1.5"))

    def whole(self, key: str, default: int = REQUIRED) -> int:
        """Value of `key`, a whole number."""
        return int(self._take(key, default, (int,), "a whole number, for example 2"))

    def text(self, key: str, default: str = REQUIRED) -> str:
        """Value of `key`, a text."""
        return str(self._take(key, default, (str,), 'a text in quotes, for example "mm"'))

    def optional_text(self, key: str) -> str | None:
        """Value of `key`, a text; None without the key."""
        return self.text(key) if key in self.left else None

    def text_or_number(self, key: str, default: str | float) -> str | float:
        """Value of `key`, a text or a number."""
        return self._take(key, default, (str, int, float), "a text in quotes or a number")

    def choice(self, key: str, choices: tuple[str, ...]) -> str:
        """Value of `key`, one of the texts `choices`."""
        value = self._take(key, REQUIRED, (str,), f"one of {', '.join(choices)}, in quotes")
        if value not in choices:
            raise FluxError(f"{self.name}: '{key}' must be one of {', '.join(choices)}, got '{value}'.")
        return value

    def vector(self, key: str, default: tuple[float, float, float] = REQUIRED) -> tuple[float, float, float]:
        """Value of `key`, three numbers."""
        value = self._take(key, default, (list, tuple), "three numbers, for example [8, 0, -1]")
        if len(value) != 3 or not all(_is(x, (int, float)) for x in value):
            raise FluxError(f"{self.name}: '{key}' must be three numbers, for example [8, 0, -1], got {value}.")
        return (float(value[0]), float(value[1]), float(value[2]))

    def table(self, key: str, default: dict[str, Any] = REQUIRED) -> Table:
        """Table [key] in this one."""
        return Table(self._take(key, default, (dict,), f"a table [{key}]"), f"{self.name} [{key}]")

    def tables(self, key: str) -> list[Table]:
        """Tables [[key]] in this one; an empty list without the key."""
        value = self._take(key, [], (list,), f"tables [[{key}]]")
        if not all(isinstance(item, dict) for item in value):
            raise FluxError(f"{self.name}: '{key}' must be tables [[{key}]].")
        return [Table(item, f"{self.name} [[{key}]] number {n}") for n, item in enumerate(value, start=1)]

    def done(self) -> None:
        """Raise FluxError if a key has not been read: it is unknown, or belongs to another kind of table."""
        if self.left:
            keys = ", ".join(f"'{key}'" for key in self.left)
            raise FluxError(f"{self.name}: {keys} means nothing here. Check the spelling, or leave it out.")

    def _take(self, key: str, default: Any, kinds: tuple[type, ...], wanted: str) -> Any:
        """Value of a key, which is removed from `left`; FluxError if it is missing or of another type."""
        value = self.left.pop(key, default)
        if value is REQUIRED:
            raise FluxError(f"{self.name}: '{key}' is missing. Give {wanted}.")
        if not _is(value, kinds):
            raise FluxError(f"{self.name}: '{key}' must be {wanted}, got {value!r}.")
        return value


def _is(value: Any, kinds: tuple[type, ...]) -> bool:
    """True if the value is of one of the types; true and false are no numbers."""
    return isinstance(value, kinds) and not isinstance(value, bool)
