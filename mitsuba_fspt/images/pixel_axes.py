"""Positions of an image's columns and rows: mm on the virtual detector plane where its metadata hold the lens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .recorded_number import recorded_number, recorded_positive

CROP = ("film_width", "film_height", "crop_offset_x", "crop_offset_y")  # [pixels], metadata of a crop window's image


@dataclass(frozen=True, eq=False)
class PixelAxes:
    """Centres of the pixels, x to the right and y up, 0 on the optical axis, which is in the middle of the film.

    The image is the whole film unless its metadata have `film_width`, `film_height`, `crop_offset_x` and
    `crop_offset_y` [pixels].

    x, y : of the columns (w,) and of the rows (h,), the top one first [`unit`]
    side : of a pixel [mm]; None if it is unknown, then x and y count columns and rows from 0
    unit : 'mm' or 'pixel'
    label : unit and plane, for axes of pictures
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    side: float | None
    unit: str
    label: str

    @classmethod
    def of(cls, shape: tuple[int, ...], metadata: Mapping[str, object]) -> PixelAxes:
        """Axes of an image of `shape` (h, w)."""
        height, width = shape
        side = virtual_pitch(metadata)
        if not side:
            return cls(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64), None, "pixel", "pixel")
        plane = "virtual detector plane" if metadata.get("magnification") else "detector"
        x, y = (
            np.float64(side) * (np.arange(count) + 0.5 + _first(metadata, axis) - _film(metadata, name, count) / 2)
            for count, axis, name in ((width, "x", "film_width"), (height, "y", "film_height"))
        )
        return cls(x, -y, side, "mm", f"mm on the {plane}")

    @property
    def step(self) -> float:
        """From a column to the next one [`unit`]."""
        return self.side or 1.0

    @property
    def down(self) -> float:
        """From a row to the one below [`unit`]; < 0 where y points up."""
        return -self.side if self.side else 1.0


def _first(metadata: Mapping[str, object], axis: str) -> float:
    """Number of pixels of the film before the first one of the image, along an axis."""
    return recorded_number(metadata, f"crop_offset_{axis}", 0.0)


def _film(metadata: Mapping[str, object], name: str, count: int) -> float:
    """Number of pixels of the film along an axis; `count`, that of the image, if the image is the whole film."""
    return recorded_number(metadata, name, count)


def virtual_pitch(metadata: Mapping[str, object]) -> float | None:
    """Side of a pixel [mm] on the virtual detector plane, on the detector without a magnification; None if unknown.

    Other programs give the inverted image on a film a magnification < 0, whose sign says nothing about sizes: pictures
    are upright here. 0, of an object at infinity, is as none.
    """
    pitch = recorded_positive(metadata, "pixel_pitch")
    magnification = abs(recorded_number(metadata, "magnification", 0.0))
    return None if pitch is None else pitch / (magnification or 1.0)
