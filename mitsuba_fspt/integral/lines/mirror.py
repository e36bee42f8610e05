"""Flat mirrors and panes, and the places from which a camera looks in them.

Light that a mirror sends to a point a of the lens goes straight to its mirror image a - 2 ((a - c)·n) n, with c on the
mirror and n its normal. On a course over several mirrors (Eq. M.19) the image is that of an image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...camera.window import window_of
from ...jit.mesh_buffers import box_of, triangles

FLAT, ROUNDING = 1e-5, 1e-6  # of its size, and of its largest coordinate: how far a flat shape may leave its plane
ALIKE = 0.02  # rad: largest angle between normals of faces of one plane, which are rounded
MOST_PLANES = 8  # of one shape
MOST_IMAGES = 64  # of a camera in all mirrors together, those included that show other mirrors alone

Array = NDArray[np.float64]
Box = tuple[float, ...]  # x, y, z of the lowest and of the highest corner [mm]


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane: a point and the unit normal, (3,), and the box of what lies in it [mm]."""

    point: Array
    normal: Array
    box: Box

    @classmethod
    def of(cls, shape: mi.Shape) -> tuple[Mirror, ...]:
        """The planes of a shape; none for one that is curved or has more than `MOST_PLANES`."""
        if shape.class_name() == "Disk":
            matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
            normal, box = np.cross(matrix[:3, 0], matrix[:3, 1]), box_of([shape])
            return (cls(matrix[:3, 3], normal / np.linalg.norm(normal), (*map(float, box.min), *map(float, box.max))),)
        return cls._of_mesh(shape) if shape.is_mesh() else ()

    @classmethod
    def _of_mesh(cls, mesh: mi.Shape) -> tuple[Mirror, ...]:
        """The planes of the faces of a mesh."""
        positions, faces = triangles(mesh)
        corners = positions.numpy().reshape(-1, 3).astype(np.float64)[faces.numpy().reshape(-1, 3)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area, found = np.linalg.norm(normals, axis=1), list[Mirror]()
        least = FLAT * float(np.ptp(corners, axis=(0, 1)).max()) + ROUNDING * float(np.abs(corners).max())
        while area.any():
            if len(found) == MOST_PLANES:
                return ()
            largest = int(area.argmax())
            alike = (area > 0) & (normals @ normals[largest] >= math.cos(ALIKE) * area * area[largest])
            normal = normals[alike].sum(axis=0)  # weighted by area: that of one small face is rounded
            normal /= np.linalg.norm(normal)
            point = corners[largest].mean(axis=0)
            within = alike & (np.abs((corners - point) @ normal) <= least).all(axis=1)
            within[largest] = True
            low, high = (end(corners[within], axis=(0, 1)).tolist() for end in (np.min, np.max))
            found.append(cls(corners[within].mean(axis=(0, 1)), normal, (*low, *high)))
            area = np.where(within, 0, area)
        return tuple(found)

    @property
    def corners(self) -> Array:
        """Corners of the box, (8, 3)."""
        return corners_of([self.box])

    def seen_by(self, camera: Camera) -> bool:
        """True if a line of sight of a pixel of the camera's crop window may meet the box."""
        return math.prod(window_of((self.box,), camera).shape) > 0

    def separates(self, camera: Camera, corners: Array) -> bool:
        """True if the plane lies between the whole pupil and all these points (n, 3)."""
        own = self._height(camera)
        return abs(own) > camera.lens.pupil_radius and not self._beside(camera, corners).any()

    def shows(self, camera: Camera, corners: Array) -> bool:
        """True if some of the pupil and some of these points (n, 3) are on the same side of the plane."""
        return abs(self._height(camera)) < camera.lens.pupil_radius or bool(self._beside(camera, corners).any())

    def _height(self, camera: Camera) -> float:
        """Height of the lens centre over the plane [mm]."""
        return float((np.array(camera.centre) - self.point) @ self.normal)

    def _beside(self, camera: Camera, corners: Array) -> NDArray[np.bool_]:
        """True for points that are not beyond the plane as the lens centre sees it."""
        return np.copysign(1.0, self._height(camera)) * ((corners - self.point) @ self.normal) >= 0


def corners_of(boxes: Sequence[Box]) -> Array:
    """Corners of boxes, (8 n, 3)."""
    ends = np.array(boxes, np.float64).reshape(-1, 2, 3)
    return ends[:, (np.arange(8)[:, None] >> np.arange(3)) & 1, range(3)].reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class MirrorImages:
    """Mirror images of a camera, each with the mirror that its lines of sight meet first.

    complete : False where there are more than `MOST_IMAGES`, of which those of the fewest mirrors are listed
    """

    images: tuple[tuple[Camera, Mirror], ...]
    complete: bool

    @classmethod
    def of(cls, mirrors: Sequence[Mirror], camera: Camera, corners: Array, most: int) -> MirrorImages:
        """Those from which the camera may see parts of boxes with these `corners` (n, 3).

        In up to `most` mirrors one after the other; images that coincide count once.
        """
        known, found = {_place(camera)}, list[tuple[Camera, Mirror]]()
        left = list[tuple[Camera, Mirror | None, Mirror | None]]([(camera, None, None)])
        for _ in range(most):
            further = list[tuple[Camera, Mirror | None, Mirror | None]]()
            for seen, first, last in left:
                for mirror in mirrors:
                    if mirror is last or not mirror.seen_by(seen):
                        continue
                    image = seen.reflected(mirror.point, mirror.normal)
                    if _place(image) in known:
                        continue
                    known.add(_place(image))
                    if mirror.shows(seen, corners):
                        found.append((image, first or mirror))
                    if any(mirror.shows(seen, other.corners) for other in mirrors if other is not mirror):
                        further.append((image, first or mirror, mirror))
                    if len(known) > MOST_IMAGES:
                        return cls(tuple(found), False)
            left = further
        return cls(tuple(found), True)


def _place(camera: Camera) -> tuple[float, ...]:
    """Rotation and place of a camera, rounded so that they are the same for images that coincide."""
    return tuple(round(number, 4) + 0.0 for number in camera.placement)
