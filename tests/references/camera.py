"""ReferenceCamera of the references: a thin lens with a diaphragm, further stops, and a film of pixels.

Frame of the camera: lens plane z = 0, +z towards the object, +x to the left of the image, +y up; virtual detector
plane z = u. Lengths in mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from .shapes import Array


@dataclass(frozen=True)
class ReferenceCamera:
    """Thin lens with a diaphragm in the lens plane and a film of width × height pixels (paper, section 2).

    Parameters
    ----------
    focal_length : F [mm]
    f_number : F/D (Eq. 3)
    focus_distance : u [mm], > F, from the lens plane to the virtual detector plane
    pixel_pitch : p [mm] on the detector
    width, height : pixels
    to_world : (4, 4) rigid motion of the camera frame into the world

    Raises
    ------
    ValueError : u ≤ F, or `to_world` is not a rigid motion.
    """

    focal_length: float
    f_number: float
    focus_distance: float
    pixel_pitch: float
    width: int
    height: int
    to_world: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if not self.focus_distance > self.focal_length:
            raise ValueError(
                f"reference camera: focus_distance {self.focus_distance} must exceed focal_length"
                f" {self.focal_length}. Focus further away."
            )
        axes = self.to_world[:3, :3]
        if not (np.allclose(axes.T @ axes, np.eye(3), atol=1e-12) and np.linalg.det(axes) > 0):
            raise ValueError(f"reference camera: to_world {axes.tolist()} must be a rotation. Remove scale or mirror.")

    @property
    def magnification(self) -> float:
        """t = v/u, with the image distance v of the lens law 1/F = 1/u + 1/v."""
        return self.focal_length / (self.focus_distance - self.focal_length)

    @property
    def pupil_radius(self) -> float:
        """D/2 [mm]."""
        return self.focal_length / self.f_number / 2

    @property
    def pixel_side(self) -> float:
        """p/t [mm], the side of a virtual pixel."""
        return self.pixel_pitch / self.magnification

    @property
    def scale(self) -> float:
        """Pupil area × virtual pixel area / (π u²) [mm²]: the power in W when J_n cos⁴θ averages 1 W/mm²."""
        return (self.pupil_radius * self.pixel_side / self.focus_distance) ** 2

    def centres(self) -> Array:
        """Centres (x, y) of the virtual pixels on z = u, row by row, shape (height·width, 2) [mm]."""
        row, column = np.divmod(np.arange(self.width * self.height), self.width)
        x = (self.width / 2 - column - 0.5) * self.pixel_side
        return np.stack([x, (self.height / 2 - row - 0.5) * self.pixel_side], axis=1)

    def from_world(self, points: Array) -> Array:
        """World points in the camera frame, shape (n, 3)."""
        return (points - self.to_world[:3, 3]) @ self.to_world[:3, :3]

    def in_world(self, points: Array) -> Array:
        """Camera frame points in the world, shape (n, 3)."""
        return points @ self.to_world[:3, :3].T + self.to_world[:3, 3]


@dataclass(frozen=True)
class Stops:
    """Borders that a line of sight has to pass: entrance pupil, border of the lens and image-plane stop.

    Parameters
    ----------
    pupil_depth : depth z_p of the entrance pupil [mm], negative behind the lens plane (Eq. M.11)
    pupil_radius : R_p [mm]
    lens_radius : of the border in the lens plane [mm]
    field_radius : of the image-plane stop, on the virtual detector plane [mm]
    """

    pupil_depth: float
    pupil_radius: float
    lens_radius: float = math.inf
    field_radius: float = math.inf

    @classmethod
    def of(
        cls,
        camera: ReferenceCamera,
        lens_diameter: float = math.inf,
        distance: float = 0.0,
        image_stop: float = math.inf,
    ) -> Stops:
        """From `lens_diameter`, `diaphragm_distance` and `image_stop_diameter` [mm] of a lens."""
        focal, half = camera.focal_length, camera.focal_length / camera.f_number / 2
        depth, radius = 0.0, half
        if distance > 0:
            depth, radius = distance * focal / (distance - focal), half * focal / abs(distance - focal)
        elif distance < 0:
            depth = -distance
        return cls(depth, radius, lens_diameter / 2, image_stop / 2 / camera.magnification)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """`to_world` (4, 4) of a camera at `origin` with `target` in the middle of the image and `up` pointing upwards."""
    forward = np.subtract(target, origin) / np.linalg.norm(np.subtract(target, origin))
    left = np.cross(np.asarray(up), forward)
    left /= np.linalg.norm(left)
    to_world = np.eye(4)
    to_world[:3] = np.stack([left, np.cross(forward, left), forward, np.asarray(origin)], axis=1)
    return to_world
