"""Classes found by name: a folder with one class a file, where a new file is a new name and nothing else is edited."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from types import ModuleType


def names_in(folder: ModuleType) -> tuple[str, ...]:
    """Names of the files of a package, in alphabetical order."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(folder.__path__)))


def class_named(folder: ModuleType, name: str) -> type:
    """The class of the file `name`, which has the same name in capitals: `LastFlight` of last_flight.py.

    Raises
    ------
    KeyError : the package has no such file.
    """
    if name not in names_in(folder):
        raise KeyError(name)
    found: type = getattr(import_module(f"{folder.__name__}.{name}"), name.title().replace("_", ""))
    return found
