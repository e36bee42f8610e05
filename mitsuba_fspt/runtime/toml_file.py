"""TOML files as dictionaries."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from .errors import BackendError, FsptError


def read_toml(path: str | os.PathLike[str], error: type[FsptError]) -> dict[str, Any]:
    """Content of a TOML file.

    Raises
    ------
    error : the file cannot be read, or is no TOML.
    BackendError : Python 3.10 without the package tomli.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        try:
            import tomli as tomllib
        except ImportError as cause:
            raise BackendError(f"'{path}': TOML needs tomli on Python 3.10 ({cause}). pip install tomli.") from cause
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as cause:
        raise error(f"'{path}' cannot be read: {cause.strerror}. Check the name.") from cause
    except ValueError as cause:  # of the encoding, or of TOML itself
        reason = " ".join(str(cause).split())
        raise error(f"'{path}' is no TOML file: {reason}. Correct it.") from cause
