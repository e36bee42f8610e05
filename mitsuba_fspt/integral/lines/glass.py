"""Plates of glass, and the places from which a camera looks straight through and off them.

A line of sight at the angle θ to the normal of a plate of thickness d and index n leaves it parallel to itself, as if
the camera were nearer by the length s of Eq. M.56 along the normal; after two reflections inside, it comes from a place
farther away. After one or three it leaves the plate on the side on which it came, as from a mirror inside.
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
from .place import Place, Unplaced
from .plane import ALIKE, MARGIN, Plane

CUBE = np.array(list(itertools.product((-1, 1), repeat=3)))

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

        None if it is no such body, or if one of the `others`, given by the corners of their boxes, may lie inside.
        """
        flat = bool(planes) and shape.is_mesh() and not is_shaded_smoothly(shape)
        if bsdf.class_name() != "SmoothDielectric" or not flat:
            return None
        corners = corners_of_faces(shape)
        rounding = MARGIN * np.abs(corners).max()
        convex = all((plane.height(corners) < rounding).all() for plane in planes)
        outside = all(any((plane.height(one) > -rounding).all() for plane in planes) for one in others)
        return cls(planes, index_of(bsdf)) if convex and outside else None

    @property
    def corners(self) -> Array:
        """As of `places.Deviating`."""
        return np.concatenate([plane.corners for plane in self.planes])

    def onward(self, place: Place, most: int, least: float) -> Iterator[Place | Unplaced]:
        """As of `places.Deviating`."""
        lens, radius = np.array(place.camera.centre), place.camera.lens.pupil_radius
        heights = [float(plane.height(lens)) for plane in self.planes]
        if max(heights) < radius:  # the pupil, or a part of it, is inside
            yield from place.unplaced(self.corners)
            return
        for side, height in zip(self.planes, heights, strict=True):
            if abs(height) < radius:
                yield from place.unplaced(side.corners)
            elif height > 0 and (here := place.towards(side.corners)):
                yield from self._by(side, here, most, least)

    def hides(self, place: Place, points: Array) -> bool:
        """As of `places.Deviating`."""
        return any(place.meets(side, points) for side in self.planes)

    def _by(self, near: Plane, place: Place, most: int, least: float) -> Iterator[Place | Unplaced]:
        """As `onward`, for lines of sight that all meet the side `near`."""
        signed = place.cosines(near)
        cosine = np.abs(signed) if (signed < 0).all() else np.append(np.abs(signed), 0.0)
        once, inside = float(reflected_share(cosine, self.index).max()), self.index**2 - 1 + cosine**2
        yield place.reflected(near, once)
        far = next((side for side in self.planes if near.normal @ side.normal <= -np.cos(ALIKE)), None)
        if far is None or not inside.min() > 0:  # a prism, or total reflection
            yield Unplaced(place.region, place.share)
            return
        thickness = float(-near.height(far.point))
        aside = thickness * max(3 / np.sqrt(max(self.index**2 - 1, 1e-3)), 1)  # in three passes, at grazing angles
        for rim in self.planes:
            if rim is not near and rim is not far:
                yield from place.unplaced((rim.corners[:, None] + aside * CUBE).reshape(-1, 3))
        depth, sine = thickness * cosine / np.sqrt(inside), float(np.sqrt(1 - cosine.min() ** 2))
        share, passes = 1.0, 1
        while share * place.share >= least and place.lobes + passes < most:
            middle = 0.5 * passes * float(depth.min() + depth.max())
            there = replace(place, misplaced=place.misplaced + 0.5 * passes * float(np.ptp(depth)) * sine)
            if passes % 2:
                camera = place.camera.moved((middle - thickness) * near.normal)
                lobes = place.lobes + passes + 1
                yield replace(there, camera=camera, share=place.share * share, lobes=lobes, after=far)
            else:  # at a mirror inside
                yield replace(there.reflected(near.above(-middle / 2), share, passes + 1), after=near)
            share, passes = share * once, passes + 1
