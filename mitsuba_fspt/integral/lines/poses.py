"""All poses from which a camera looks straight at what glows, on all courses over specular surfaces (Eq. M.19)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from .pose import Pose, Unlocated

MOST_POSES = 64  # of a camera that see what glows
MOST_EXAMINED = 1024  # poses times shapes: of the poses that are examined, some see nothing that glows

Array = NDArray[np.float64]


class Deviating(Protocol):
    """A shape that deviates lines of sight."""

    @property
    def corners(self) -> Array:
        """Points (n, 3) between which it lies [mm]."""
        ...

    def onward(self, pose: Pose, most: int, least: float) -> Iterator[Pose | Unlocated]:
        """Poses on the courses that lead from a `pose` by way of this shape, of up to `most` lobes and with
        the share `least` of the light or more.
        """
        ...

    def hides(self, pose: Pose, points: Array) -> bool:
        """True if no line of sight from a `pose` leads straight to what lies between points (n, 3)."""
        ...


@dataclass(frozen=True)
class Poses:
    """Poses, other than the camera's own, that see what glows, and lines of sight to poses that are not known."""

    found: tuple[Pose, ...]
    unlocated: tuple[Unlocated, ...]

    @classmethod
    def of(cls, shapes: Sequence[Deviating], camera: Camera, glowing: Array, most: int, least: float) -> Poses:
        """Those of courses over these shapes, of up to `most` lobes and with the share `least` of the light or more.

        Those of the largest shares are examined first. glowing : corners (n, 3) of the boxes of all that glows [mm]
        """
        found, unlocated, number = list[Pose](), list[Unlocated](), itertools.count()
        left = [(-1.0, 0, next(number), Pose(camera))]
        for examined in range(1 + min(max(MOST_EXAMINED // max(len(shapes), 1), MOST_POSES), MOST_EXAMINED // 4)):
            if not left or len(found) == MOST_POSES:
                break
            pose = heappop(left)[-1]
            hidden = any(shape.hides(pose, glowing) for shape in shapes)
            seen = pose.showing(glowing) if examined and not hidden else None
            if isinstance(seen, Pose):
                found.append(seen)
            elif seen:
                unlocated.append(seen)
            for shape in shapes:
                if any(other.hides(pose, shape.corners) for other in shapes if other is not shape):
                    continue
                for further in shape.onward(pose, most, least):
                    if isinstance(further, Unlocated):
                        unlocated.append(further)
                    elif further.share >= least and further.lobes <= most:
                        heappush(left, (-further.share, further.lobes, next(number), further))
        return cls(tuple(found), (*unlocated, *(Unlocated(pose.region, pose.share) for *_, pose in left)))
