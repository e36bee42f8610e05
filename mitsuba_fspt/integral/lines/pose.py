"""Poses from which a camera looks straight at what it sees by specular surfaces, one for each course (Eq. M.19).

Light that a mirror sends to a point a of the lens goes straight to its mirror image a - 2 ((a - c)·n) n, with c on the
mirror and n its normal; light through a plate of glass comes straight to a point nearer by s along the normal
(Eq. M.56). On a course over several surfaces each step begins at the pose of the one before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import Region, window_around
from .plane import ROUNDING, Plane

ALONG = 5  # lines of sight along each side of a region of the film, of which the angles are taken
MISPLACED = 0.5  # pixels by which lines of other directions may miss the pose of one

Array = NDArray[np.float64]
WHOLE_FILM: Region = (-math.inf, -math.inf, math.inf, math.inf)


@dataclass(frozen=True)
class Unlocated:
    """Lines of sight that go on to poses that are not known: their region, and their largest share of the light."""

    region: Region
    share: float


@dataclass(frozen=True, eq=False)
class Pose:
    """The camera where it looks straight from, on one course.

    region : of the film, in which lines of sight may have this course
    share : of the light at its end that comes along it, at the most
    lobes : their number on the course, at the least
    misplaced : distance by which lines of sight may miss the pose [mm]
    after : the last plane, its normal on the side on which the course goes on; None at the camera itself
    """

    camera: Camera
    region: Region = WHOLE_FILM
    share: float = 1.0
    lobes: int = 0
    misplaced: float = 0.0
    after: Plane | None = None

    @property
    def where(self) -> tuple[float, ...]:
        """Rotation and position of the camera, rounded so that they are the same for poses that coincide."""
        return tuple(round(number, 4) + 0.0 for number in self.camera.placement)

    def towards(self, points: Array) -> Pose | None:
        """The pose in the part of its region whose lines of sight may meet what lies between points (n, 3).

        None if there is no such part; what lies behind the last plane does not count.
        """
        beyond = self.after.part_above(points) if self.after else points
        if not len(beyond):
            return None
        window, aside = window_around(beyond, self.camera), self._pixels_aside(beyond)
        (left, top), (height, width) = window.corner, window.shape
        low = np.maximum(self.region[:2], (left - aside, top - aside))
        high = np.minimum(self.region[2:], (left + width + aside, top + height + aside))
        if not (height * width and (low < high).all()):
            return None
        return replace(self, region=(*map(float, low), *map(float, high)))

    def _pixels_aside(self, points: Array) -> float:
        """Pixels by which lines of sight may miss what lies between points (n, 3), as the pose is not exact."""
        if not self.misplaced:
            return 0.0
        depth = float(self.camera.depths(points).min())
        pixel = self.camera.virtual_pitch * depth / self.camera.lens.focus_distance
        return self.misplaced / pixel if depth > 0 else math.inf

    def unlocated(self, points: Array) -> list[Unlocated]:
        """The lines of sight to what lies between points (n, 3), as ones that go on to poses that are not known."""
        seen = self.towards(points)
        return [Unlocated(seen.region, seen.share)] if seen else []

    def showing(self, points: Array) -> Pose | Unlocated | None:
        """The pose for what lies between points (n, 3); None if the course does not lead there."""
        seen = self.towards(points)
        if seen is None or self._pixels_aside(points) <= MISPLACED:
            return seen
        return Unlocated(seen.region, seen.share)

    def meets(self, plane: Plane, points: Array) -> bool:
        """True if all lines of sight to what lies between points (n, 3) meet the faces of a plane on the way.

        All crossings lie between those of lines from corners around the pupil to the points. False, too, if the
        pupil shifts with the point.
        """
        if not plane.filled or self.camera.lens.discs[0].shift:
            return False
        frame = np.reshape(self.camera.placement, (4, 4))[:3]
        across = self.camera.lens.pupil_radius * frame[:, :2] / np.linalg.norm(frame[:, 0])
        lens = frame[:, 3] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ across.T
        facing = plane.facing(self.camera)
        near, far = facing.height(lens)[:, None, None], facing.height(points)[:, None]
        if not (near.min() > 0 and far.max() < 0):
            return False
        crossing = lens[:, None] + near / (near - far) * (points - lens[:, None])
        if self.after and not (self.after.height(crossing) > ROUNDING * np.abs(crossing).max()).all():
            return False
        sides = plane.corners[[1, 3]] - plane.corners[0]
        along = (crossing - plane.corners[0]) @ sides.T / (sides**2).sum(axis=1)
        rim = self.misplaced / np.linalg.norm(sides, axis=1)
        return bool((along >= rim).all() and (along <= 1 - rim).all())

    def cosines(self, plane: Plane) -> Array:
        """Of lines of sight all over the region to the normal of a plane, of either sign, (n,)."""
        side = np.linspace(0, 1, ALONG)
        x, y = (low + side * (high - low) for low, high in zip(self.region[:2], self.region[2:], strict=True))
        rim = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        x, y, number = (c.ravel() for c in np.meshgrid(x, y, np.arange(len(rim)), indexing="ij"))
        position, pupil = (mi.Point2f(*pair.astype(np.float32)) for pair in (np.array([x, y]), rim[number].T))
        return np.asarray(plane.normal @ np.array(self.camera.line_of_sight(position, pupil)[0].d, np.float64))

    def reflected(self, plane: Plane, share: float, lobes: int = 1) -> Pose:
        """The pose on the course that goes on with this share of the light by reflection at a plane."""
        return replace(
            self,
            camera=self.camera.reflected(plane.point, plane.normal),
            share=self.share * share,
            lobes=self.lobes + lobes,
            after=plane.facing(self.camera),
        )
