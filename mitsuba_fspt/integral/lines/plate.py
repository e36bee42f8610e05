"""A plate of glass between a camera and all that glows, and the places from which the camera looks straight at that.

A line of sight at the angle θ to the normal of a plate of thickness d and index n leaves it parallel to itself, as if
the camera were nearer by the length s of Eq. M.56 along the normal; after two reflections inside, which leave the share
R² of the light, it comes from a place farther away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera.camera import Camera
from ...jit.mesh_buffers import is_shaded_smoothly
from .mirror import ALIKE, Box, Mirror

PLACES = 5  # of a box along each axis, at which lines of sight are taken
MISPLACED = 0.5  # pixels by which lines of other directions may miss the place of one

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plate:
    """A solid of glass with two parallel sides: the plane of the one `towards` the camera, its thickness [mm], the
    index of refraction over that around it, and the planes of its other sides."""

    towards: Mirror
    thickness: float
    index: float
    rims: tuple[Mirror, ...]

    @classmethod
    def of(
        cls, shape: mi.Shape, bsdf: mi.BSDF, planes: Sequence[Mirror], camera: Camera, corners: Array
    ) -> Plate | None:
        """That of a shape with these planes, if both of its sides lie between the pupil and all points `corners`
        (n, 3); else None."""
        if bsdf.class_name() != "SmoothDielectric" or not shape.is_mesh() or is_shaded_smoothly(shape):
            return None
        lens = np.array(camera.centre)
        for near in planes:
            for far in planes:
                opposite = float(near.normal @ far.normal) <= -np.cos(ALIKE)
                thickness = float((near.point - far.point) @ near.normal)
                if not (opposite and thickness > 0 and float((lens - near.point) @ near.normal) > 0):
                    continue
                if near.separates(camera, corners) and far.separates(camera, corners):
                    rims = tuple(plane for plane in planes if plane is not near and plane is not far)
                    return cls(near, thickness, float(mi.traverse(bsdf)["eta"]), rims)
        return None

    @property
    def rim_boxes(self) -> tuple[Box, ...]:
        """Boxes of the places of the plate from which lines, reflected twice or not, may meet its other sides."""
        far = self.thickness * max(3 / np.sqrt(max(self.index**2 - 1, 1e-3)), 1)  # aside at grazing angles
        return tuple((*(x - far for x in rim.box[:3]), *(x + far for x in rim.box[3:])) for rim in self.rims)

    def images(self, camera: Camera, boxes: Sequence[Box]) -> list[Camera] | None:
        """The camera at the places from which it looks straight at boxes behind the plate: without a reflection inside
        and after two; None where lines of sight to different parts of the boxes come from places too far apart."""
        cosine, inside, depth = self._cosines(camera, boxes)
        if depth <= 0 or not inside.min() > 0:  # behind the lens, or beyond total reflection
            return None
        pixel = camera.virtual_pitch * depth / camera.lens.focus_distance
        aside, found = float(np.sqrt(max(1 - cosine.min() ** 2, 0))), []
        for passes in (1, 3):
            nearer = self.thickness * (1 - passes * cosine / inside)
            if 0.5 * float(np.ptp(nearer)) * aside > MISPLACED * pixel:
                return None
            found.append(camera.moved(-0.5 * float(nearer.min() + nearer.max()) * self.towards.normal))
        return found

    def reflected_more(self, camera: Camera, boxes: Sequence[Box]) -> float:
        """Largest share of the light of boxes behind the plate that is reflected inside more than twice, of any
        polarisation."""
        cosine, inside, _ = self._cosines(camera, boxes)
        return float((((inside - cosine) / (inside + cosine)) ** 8).max())

    def _cosines(self, camera: Camera, boxes: Sequence[Box]) -> tuple[Array, Array, float]:
        """Of lines of sight from all over the pupil to all over the boxes: cosθ (n,), n times that in the glass (n,), 0
        where all light is reflected; and the least depth of the boxes."""
        frame = np.reshape(camera.placement, (4, 4))[:3]
        rim = camera.lens.pupil_radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        pupil = frame[:, 3] + rim @ frame[:, :2].T / np.linalg.norm(frame[:, 0])
        way = np.concatenate([_places(box) for box in boxes]) - pupil[:, None]
        cosine = np.abs(way @ self.towards.normal) / np.linalg.norm(way, axis=-1)
        axis = frame[:, 2] / np.linalg.norm(frame[:, 2])
        inside = np.sqrt(np.maximum(self.index**2 - 1 + cosine**2, 0))
        return cosine.ravel(), inside.ravel(), float((way @ axis).min())


def _places(box: Box) -> Array:
    """Places all over a box, (125, 3)."""
    ends = np.reshape(box, (2, 3))
    axes = np.linspace(ends[0], ends[1], PLACES).T
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
