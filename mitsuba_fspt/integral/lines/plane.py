"""Planes of flat mirrors, panes and plates of glass, on courses of lines of sight (Eq. M.19)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...jit.mesh_buffers import corners_of_faces

FLAT, ROUNDING = 1e-5, 1e-6  # of its size, and of its largest coordinate: how far points may leave their plane
ALIKE = 0.02  # rad: largest angle between normals of faces of one plane, which are rounded
MOST_PLANES = 8  # of one shape

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane: a point and the unit normal, (3,), and the corners (4, 3) of a rectangle around what lies in it [mm].

    filled : what lies in it is the whole rectangle
    """

    point: Array
    normal: Array
    corners: Array
    filled: bool = False

    @classmethod
    def of(cls, shape: mi.Shape) -> tuple[Plane, ...]:
        """The planes of a shape; none for one that is curved or has more than `MOST_PLANES`."""
        if shape.class_name() == "Disk":
            matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
            corners = matrix[:3, 3] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ matrix[:3, :2].T
            normal = np.cross(matrix[:3, 0], matrix[:3, 1])
            return (cls._around(corners[None], normal / np.linalg.norm(normal), matrix[:3, :1].T),)
        return cls._of_mesh(shape) if shape.is_mesh() else ()

    @classmethod
    def _of_mesh(cls, mesh: mi.Shape) -> tuple[Plane, ...]:
        """The planes of the faces of a mesh."""
        corners = corners_of_faces(mesh)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area, found = np.linalg.norm(normals, axis=1), list[Plane]()
        least = FLAT * float(np.ptp(corners, axis=(0, 1)).max()) + ROUNDING * float(np.abs(corners).max())
        while area.any():
            if len(found) == MOST_PLANES:
                return ()
            largest = int(area.argmax())
            alike = (area > 0) & (normals @ normals[largest] >= math.cos(ALIKE) * area * area[largest])
            normal, point = normals[largest] / area[largest], corners[largest].mean(axis=0)
            # The normal of one small face is rounded: that of all faces near its plane, weighted by area, is not.
            from_point = corners - point
            turned = 2 * ROUNDING * np.abs(corners).max() / np.sqrt(area[largest]) * np.linalg.norm(from_point, axis=-1)
            near = alike & (np.abs(from_point @ normal) <= least + turned).all(axis=1)
            normal = normals[near].sum(axis=0) / np.linalg.norm(normals[near].sum(axis=0))
            within = alike & (np.abs(from_point @ normal) <= least).all(axis=1)
            within[largest] = True
            found.append(cls._around(corners[within], normal, corners[largest] - np.roll(corners[largest], 1, axis=0)))
            area = np.where(within, 0, area)
        return tuple(found)

    @classmethod
    def _around(cls, faces: Array, normal: Array, edges: Array) -> Plane:
        """The plane with this unit normal and the corners (F, m, 3) of its faces.

        The rectangle around these has a side along one of the edges (n, 3), that of the smallest one.
        """
        points, smallest = faces.reshape(-1, 3), np.inf
        middle = points.mean(axis=0)
        for edge in edges - (edges @ normal)[:, None] * normal:
            axes = np.array([edge, np.cross(normal, edge)]) / np.linalg.norm(edge)
            aside = (points - middle) @ axes.T
            (left, low), (right, high) = aside.min(axis=0), aside.max(axis=0)
            if (size := (right - left) * (high - low)) < smallest:
                smallest, around = size, np.array([[left, low], [right, low], [right, high], [left, high]]) @ axes
        return cls(middle, normal, middle + around, _are_halves(faces, middle + around))

    def height(self, points: Array) -> Array:
        """Heights [mm] of points (..., 3) over the plane, > 0 on the side that the normal points to."""
        return np.asarray((points - self.point) @ self.normal)

    def part_above(self, points: Array) -> Array:
        """Corners (m, 3) of the part above the plane of what lies between points (n, 3).

        m = 0 if there is none: what lies in the plane but for rounding is not above it.
        """
        height, rounding = self.height(points), ROUNDING * np.abs(points).max()
        if not (height > rounding).any():
            return points[:0]
        is_above = height >= -rounding  # also what touches the plane
        above, below = points[is_above], points[~is_above]
        from_above, from_below = np.maximum(height[is_above], 0)[:, None, None], height[~is_above][:, None]
        crossed = above[:, None] + from_above / (from_above - from_below) * (below - above[:, None])
        return np.concatenate([above, crossed.reshape(-1, 3)])

    def facing(self, camera: Camera) -> Plane:
        """The same plane with the normal on the side of a camera's lens centre."""
        return self if self.height(np.array(camera.centre)) >= 0 else replace(self, normal=-self.normal)

    def above(self, height: float) -> Plane:
        """The plane at a height [mm] over this one."""
        return replace(self, point=self.point + height * self.normal)

    def separates(self, camera: Camera, points: Array) -> bool:
        """True if the plane lies between the whole pupil and all these points (n, 3)."""
        facing = self.facing(camera)
        clear = facing.height(np.array(camera.centre)) > camera.pupil_reach
        return bool(clear and (facing.height(points) < 0).all())


def _are_halves(faces: Array, rectangle: Array) -> bool:
    """True if faces (F, m, 3) are the two triangles on both sides of a diagonal of a rectangle (4, 3)."""
    if faces.shape[:2] != (2, 3):
        return False
    rounding = FLAT * float(np.ptp(rectangle, axis=0).max())
    apart = np.linalg.norm(faces[:, :, None] - rectangle, axis=-1)
    at_corners = bool((apart.min(axis=-1) < rounding).all())
    return at_corners and bool(np.abs(faces.mean(axis=1).sum(axis=0) - 2 * rectangle.mean(axis=0)).max() < rounding)
