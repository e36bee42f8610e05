"""Plates of glass, and the poses from which a camera looks straight through and off them.

A line of sight at the angle θ to the normal of a plate of thickness d and index n leaves it parallel to itself, as if
the camera were nearer by the length s of Eq. M.56 along the normal; after two reflections inside, as if it
were farther away. After one or three it leaves the plate on the side on which it came, as from a mirror inside.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...jit.mesh_buffers import corners_of_faces, is_shaded_smoothly
from .mirror import index_of, reflected_share
from .plane import FLAT, Plane
from .pose import Pose, Unlocated

CORNERS_OF_CUBE = np.array(list(itertools.product((-1, 1), repeat=3)))
PARALLEL = 2e-5  # rad: largest angle between the sides of a plate, by rounding

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Glass:
    """A convex body of glass with flat sides, such as a plate.

    planes : of the sides, with normals that point outwards
    index : of refraction, over that around it
    """

    planes: tuple[Plane, ...]
    index: float

    @classmethod
    def of(
        cls,
        shape: mi.Shape,
        bsdf: mi.BSDF,
        planes: tuple[Plane, ...],
        others: Sequence[Array],
    ) -> Glass | None:
        """That of a shape with these planes.

        None if it is no such body, or if one of the `others`, which lie between these points, may lie inside.
        """
        flat = bool(planes) and shape.is_mesh() and not is_shaded_smoothly(shape)
        if bsdf.class_name() != "SmoothDielectric" or not flat:
            return None
        corners = corners_of_faces(shape)
        rounding = FLAT * np.abs(corners).max()
        convex = all((plane.height(corners) < rounding).all() for plane in planes)
        outside = all(any((plane.height(one) > -rounding).all() for plane in planes) for one in others)
        return cls(planes, index_of(bsdf)) if convex and outside else None

    @property
    def corners(self) -> Array:
        """As of `poses.Deviating`."""
        return np.concatenate([plane.corners for plane in self.planes])

    def onward(self, pose: Pose, most: int, least: float) -> Iterator[Pose | Unlocated]:
        """As of `poses.Deviating`."""
        lens, radius = np.array(pose.camera.centre), pose.camera.pupil_reach
        heights = [float(plane.height(lens)) for plane in self.planes]
        if max(heights) < radius:  # the pupil, or a part of it, is inside
            yield from pose.unlocated(self.corners)
            return
        for side, height in zip(self.planes, heights, strict=True):
            if abs(height) < radius:
                yield from pose.unlocated(side.corners)
            elif height > 0 and (here := pose.towards(side.corners)):
                yield from self._through(side, here, most, least)

    def hides(self, pose: Pose, points: Array) -> bool:
        """As of `poses.Deviating`."""
        return any(pose.meets(side, points) for side in self.planes)

    def _through(self, near: Plane, pose: Pose, most: int, least: float) -> Iterator[Pose | Unlocated]:
        """As `onward`, for lines of sight that all meet the side `near`."""
        signed = pose.cosines(near)
        cosine = np.abs(signed) if (signed < 0).all() else np.append(np.abs(signed), 0.0)
        once, inside = float(reflected_share(cosine, self.index).max()), self.index**2 - 1 + cosine**2
        yield pose.reflected(near, once)
        far = next((side for side in self.planes if np.linalg.norm(near.normal + side.normal) < PARALLEL), None)
        if far is None or not inside.min() > 0:  # a prism, or total reflection
            yield Unlocated(pose.region, pose.share)
            return
        thickness = float(-near.height(far.point))
        aside = thickness * max(3 / np.sqrt(max(self.index**2 - 1, 1e-3)), 1)  # in three passes, at grazing angles
        for rim in self.planes:
            if rim is not near and rim is not far:
                yield from pose.unlocated((rim.corners[:, None] + aside * CORNERS_OF_CUBE).reshape(-1, 3))
        depth, sine = thickness * cosine / np.sqrt(inside), float(np.sqrt(1 - cosine.min() ** 2))
        share, passes = 1.0, 1
        while share * pose.share >= least and pose.lobes + passes < most:
            middle = 0.5 * passes * float(depth.min() + depth.max())
            there = replace(pose, misplaced=pose.misplaced + 0.5 * passes * float(np.ptp(depth)) * sine)
            if passes % 2:
                camera = pose.camera.moved((middle - thickness) * near.normal)
                lobes = pose.lobes + passes + 1
                yield replace(there, camera=camera, share=pose.share * share, lobes=lobes, after=far)
            else:  # at a mirror inside
                yield replace(there.reflected(near.above(-middle / 2), share, passes + 1), after=near)
            share, passes = share * once, passes + 1
