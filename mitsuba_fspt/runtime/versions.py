"""Versions of installed packages."""

from functools import cache
from importlib import metadata

PACKAGES = ("mitsuba-fspt", "mitsuba", "drjit", "numpy")  # on which every result depends


@cache
def version(package: str) -> str:
    """Version of an installed package. Read once a process: a render needs several, each of some 0.1 ms."""
    return metadata.version(package)


def versions() -> dict[str, str]:
    """Version of each of `PACKAGES`, by its name."""
    return {package: version(package) for package in PACKAGES}
