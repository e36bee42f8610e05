"""All places from which a camera looks straight at what glows, on all courses over specular surfaces (Eq. M.19)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from .place import Place, Unplaced

MOST_LOOKED_AT, MOST_PLACES = 256, 64  # of a camera: those that may see nothing that glows, and those that see it

Array = NDArray[np.float64]


class Deviating(Protocol):
    """A shape that deviates lines of sight."""

    @property
    def corners(self) -> Array:
        """Points (n, 3) between which it lies [mm]."""
        ...

    def onward(self, place: Place, most: int, least: float) -> Iterator[Place | Unplaced]:
        """Places on the courses that lead from a `place` by way of this shape, of up to `most` lobes and with
        the share `least` of the light or more.
        """
        ...

    def hides(self, place: Place, points: Array) -> bool:
        """True if no line of sight from a `place` leads straight to what lies between points (n, 3)."""
        ...


@dataclass(frozen=True)
class Places:
    """Places from which a camera sees what glows but its own, and lines of sight that end at places not known."""

    found: tuple[Place, ...]
    unplaced: tuple[Unplaced, ...]

    @classmethod
    def of(cls, shapes: Sequence[Deviating], camera: Camera, glowing: Array, most: int, least: float) -> Places:
        """Those of courses over these shapes, of up to `most` lobes and with the share `least` of the light or more.

        Those of the largest shares are looked at first. glowing : corners (n, 3) of the boxes of all that glows [mm]
        """
        found, unplaced, number = list[Place](), list[Unplaced](), itertools.count()
        left = [(-1.0, 0, next(number), Place(camera))]
        for looked_at in range(1 + MOST_LOOKED_AT):
            if not left or len(found) == MOST_PLACES:
                break
            place = heappop(left)[-1]
            hidden = any(shape.hides(place, glowing) for shape in shapes)
            seen = place.showing(glowing) if looked_at and not hidden else None
            if isinstance(seen, Place):
                found.append(seen)
            elif seen:
                unplaced.append(seen)
            for shape in shapes:
                if any(other.hides(place, shape.corners) for other in shapes if other is not shape):
                    continue
                for further in shape.onward(place, most, least):
                    if isinstance(further, Unplaced):
                        unplaced.append(further)
                    elif further.share >= least and further.lobes <= most:
                        heappush(left, (-further.share, further.lobes, next(number), further))
        return cls(tuple(found), (*unplaced, *(Unplaced(place.region, place.share) for *_, place in left)))
