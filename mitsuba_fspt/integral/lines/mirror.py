"""Flat mirrors and panes, and the places from which a camera looks in them.

Light that a mirror sends to a point a of the lens goes straight to its mirror image a - 2 ((a - c)·n) n, with c on the
mirror and n its normal. On a course over several mirrors (Eq. M.19) the image is that of an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...jit.mesh_buffers import box_of, triangles

FLAT = 1e-5  # of its size: how far a flat shape may leave its plane
MOST_PLANES = 8  # of one shape
MOST_IMAGES = 64  # of a camera in all mirrors together

Array = NDArray[np.float64]
Box = tuple[float, ...]  # x, y, z of the lowest and of the highest corner [mm]


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane: a point and the unit normal, (3,), and the corners of the box of what lies in it, (8, 3) [mm]."""

    point: Array
    normal: Array
    corners: Array

    @classmethod
    def of(cls, shape: mi.Shape) -> tuple[Mirror, ...]:
        """The planes of a shape; none for one that is curved or has more than `MOST_PLANES`."""
        if shape.class_name() == "Disk":
            matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
            normal, box = np.cross(matrix[:3, 0], matrix[:3, 1]), box_of([shape])
            corners = corners_of([(*map(float, box.min), *map(float, box.max))])
            return (cls(matrix[:3, 3], normal / np.linalg.norm(normal), corners),)
        return cls._of_mesh(shape) if shape.is_mesh() else ()

    @classmethod
    def _of_mesh(cls, mesh: mi.Shape) -> tuple[Mirror, ...]:
        """The planes of the faces of a mesh."""
        positions, faces = triangles(mesh)
        corners = positions.numpy().reshape(-1, 3).astype(np.float64)[faces.numpy().reshape(-1, 3)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normals, axis=1)
        least, found = FLAT * float(np.ptp(corners, axis=(0, 1)).max()), list[Mirror]()
        while area.any():
            if len(found) == MOST_PLANES:
                return ()
            largest = int(area.argmax())
            point, normal = corners[largest].mean(axis=0), normals[largest] / area[largest]
            within = (np.abs((corners - point) @ normal) <= least).all(axis=1) & (normals @ normal >= 0)
            low, high = (end(corners[within], axis=(0, 1)) for end in (np.min, np.max))
            found.append(cls(point, normal, corners_of([(*low.tolist(), *high.tolist())])))
            area = np.where(within, 0, area)
        return tuple(found)

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


def images_in(mirrors: Sequence[Mirror], camera: Camera, corners: Array, most: int) -> list[Camera] | None:
    """Mirror images of a camera from which it may see some of the points `corners` (n, 3).

    In up to `most` mirrors one after the other, each image once; None if there are more than `MOST_IMAGES`.
    """
    known = {_place(camera)}
    found, left = [], list[tuple[Camera, Mirror | None]]([(camera, None)])
    for _ in range(most):
        further = list[tuple[Camera, Mirror | None]]()
        for seen, last in left:
            for mirror in mirrors:
                if mirror is last:
                    continue
                image = seen.reflected(mirror.point, mirror.normal)
                if _place(image) in known:
                    continue
                known.add(_place(image))
                if mirror.shows(seen, corners):
                    found.append(image)
                if any(mirror.shows(seen, other.corners) for other in mirrors if other is not mirror):
                    further.append((image, mirror))
        if len(found) + len(further) > MOST_IMAGES:
            return None
        left = further
    return found


def _place(camera: Camera) -> tuple[float, ...]:
    """Rounded numbers of its rotation and place, which differ between images."""
    return tuple(round(number, 4) + 0.0 for number in camera.placement)
