"""Part of an image by slices, which stays at its place on the film."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

from ..runtime.errors import ImageError
from .formats import BESIDE
from .image_data import ImageData
from .noise_model import flat_digest, part_recorded
from .recorded_number import recorded_number

Part = TypeVar("Part", bound=ImageData)


def cropped(image: Part, key: Any) -> Part:
    """Part of an image, as of `Image.__getitem__`."""
    window = key if isinstance(key, tuple) else (key,)
    if not 1 <= len(window) <= 2 or not all(isinstance(one, slice) for one in window):
        raise _refused(key)
    rows, columns = (*window, slice(None))[:2]
    height, width = image.shape
    (top, bottom), (left, right) = _ends(rows, height, key), _ends(columns, width, key)
    known = dict(image.metadata)
    known.setdefault("film_width", width)
    known.setdefault("film_height", height)
    for name, first in (("crop_offset_x", left), ("crop_offset_y", top)):
        own = recorded_number(known, name, 0)
        known[name] = first + (int(own) if own == int(own) else own)
    planes = {name: getattr(image, name) for name in ("power", *BESIDE)}
    parts = {name: plane[top:bottom, left:right] for name, plane in planes.items() if plane is not None}
    if "masked_pixels" in known and "mask" in parts:
        known["masked_pixels"] = int(parts["mask"].sum())
    part = replace(image, **parts, metadata=known)
    return replace(part, metadata=part.metadata | part_recorded(part, flat_digest(image)))


def _ends(one: slice, length: int, key: Any) -> tuple[int, int]:
    """First row or column of a slice and the one after its last; ImageError for steps and for none."""
    try:
        start, stop, step = one.indices(length)
    except (TypeError, ValueError) as cause:
        raise _refused(key) from cause
    if step != 1 or stop <= start:
        raise _refused(key)
    return start, stop


def _refused(key: Any) -> ImageError:
    return ImageError(
        f"image: a part of it is image[top:bottom, left:right], without steps and not empty, got {key!r}. Take single "
        "pixels and others from image.power."
    )
