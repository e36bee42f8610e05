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
        found = float(value)  # type: ignore[arg-type]  # a text may be a number
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise error(
            f"{thing}: '{name}' of the metadata must be a finite number, got {value!r}. Correct it, or make the image "
            "again."
        )
    return found
