"""Classes found by name in a package with one class per file; a new file adds a name without any other edit."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from types import ModuleType


def names_in(folder: ModuleType) -> tuple[str, ...]:
    """Names of the modules in the package `folder`, in alphabetical order."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(folder.__path__)))


def class_named(folder: ModuleType, name: str) -> type:
    """Class of the module `name` in the package `folder`, named like the module: `LastFlight` in last_flight.py.

    Raises
    ------
    KeyError : the package has no such module.
    """
    if name not in names_in(folder):
        raise KeyError(name)
    found: type = getattr(import_module(f"{folder.__name__}.{name}"), name.title().replace("_", ""))
    return found
