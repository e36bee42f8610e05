"""Numbers in the metadata of images: what a file says there, which any program may have written, is checked."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..runtime.errors import FsptError, ImageError


def recorded_number(
    metadata: Mapping[str, object],
    name: str,
    default: float,
    thing: str = "image",
    error: type[FsptError] = ImageError,
) -> float:
    """The number `name` of the metadata, `default` where it is missing or None.

    Raises `error`, which calls the image `thing`, for what is no finite number.
    """
    if (value := metadata.get(name)) is None:
        return default
    try:
        found = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]  # a text may be a number
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise error(
            f"{thing}: '{name}' of the metadata must be a finite number, got {value!r}. Correct it, or make the image "
            "again."
        )
    return found


def recorded_positive(
    metadata: Mapping[str, object], name: str, thing: str = "image", error: type[FsptError] = ImageError
) -> float | None:
    """The number `name` > 0 of the metadata, such as the pixel pitch [mm]; None where it is missing.

    Raises `error` as `recorded_number`, and for numbers <= 0.
    """
    found = recorded_number(metadata, name, math.inf, thing, error)
    if found <= 0:
        raise error(
            f"{thing}: '{name}' of the metadata must be > 0, got {found:g}. Correct it, or make the image again."
        )
    return None if found == math.inf else found
