"""Size of a film and its crop window."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass(frozen=True)
class Film:
    """Size (width, height) of a film, first pixel (x, y) of its crop window and the window's size, all in pixels."""

    size: tuple[int, int]
    crop_offset: tuple[int, int]
    crop_size: tuple[int, int]

    @classmethod
    def of(cls, film: mi.Film) -> Film:
        """The sizes of a film of Mitsuba."""
        pairs = (film.size(), film.crop_offset(), film.crop_size())
        return cls(*((int(pair[0]), int(pair[1])) for pair in pairs))

    @classmethod
    def whole(cls, width: int, height: int) -> Film:
        """A film without a crop window."""
        return cls((width, height), (0, 0), (width, height))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the crop window, the shape of an image."""
        return self.crop_size[1], self.crop_size[0]

    def numbers(self) -> dict[str, int]:
        """Size of the film and first pixel of its crop window by name, for an image's metadata; empty without one."""
        if self.crop_size == self.size:
            return {}
        names = ("film_width", "film_height", "crop_offset_x", "crop_offset_y")
        return dict(zip(names, (*self.size, *self.crop_offset), strict=True))
