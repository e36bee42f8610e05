"""Flat mirrors and thin panes on courses of lines of sight (Eq. M.19), and shapes whose images are not known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .plane import Plane
from .pose import Pose, Unlocated

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mirror:
    """Flat mirrors, or thin panes with this refractive `index`; light goes straight `through` some."""

    planes: tuple[Plane, ...]
    index: float | None = None
    through: bool = False

    @property
    def corners(self) -> Array:
        """As of `poses.Deviating`."""
        return np.concatenate([plane.corners for plane in self.planes])

    def onward(self, pose: Pose, most: int, least: float) -> Iterator[Pose | Unlocated]:
        """As of `poses.Deviating`."""
        for plane in self.planes:
            if (here := pose.towards(plane.corners)) is None:
                continue
            share = 1.0
            if self.index is not None:
                once = float(reflected_share(np.abs(here.cosines(plane)), self.index).max())
                share = 2 * once / (1 + once)  # of both sides
            seen = here.reflected(plane, share)
            yield seen
            if abs(float(plane.height(np.array(pose.camera.centre)))) < pose.camera.pupil_reach and seen.after:
                yield replace(seen, after=replace(seen.after, normal=-seen.after.normal))  # for the rest of the pupil

    def hides(self, pose: Pose, points: Array) -> bool:
        """As of `poses.Deviating`."""
        return not self.through and any(pose.meets(plane, points) for plane in self.planes)


@dataclass(frozen=True, eq=False)
class Untraced:
    """A shape of which the poses are not known: curved, or of many sides.

    corners : of its box, (8, 3) [mm]
    """

    corners: Array

    def onward(self, pose: Pose, most: int, least: float) -> Iterator[Pose | Unlocated]:
        """As of `poses.Deviating`."""
        yield from pose.unlocated(self.corners)

    def hides(self, pose: Pose, points: Array) -> bool:
        """As of `poses.Deviating`: not known."""
        return False


def index_of(bsdf: mi.BSDF) -> float:
    """Refractive index of glass or a pane over that around it."""
    return float(np.ravel(mi.traverse(bsdf)["eta"])[0])


def reflected_share(cosine: Array, index: float) -> Array:
    """Fresnel's share of the light that the border of a medium reflects, for the polarisation of which it is larger.

    cosine : of the angle of incidence;  index : of refraction of the medium beyond, over that before it
    """
    beyond = np.sqrt(np.maximum(index**2 - 1 + cosine**2, 0))
    return np.asarray(((beyond - cosine) / np.maximum(beyond + cosine, np.finfo(np.float64).tiny)) ** 2)
