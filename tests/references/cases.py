"""What the tests of the reference share: a camera, exitances, a sheet that fills every line of sight."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh

from .camera import ReferenceCamera
from .shapes import Rectangle

EXITANCE = 3e-7  # W/mm²


def camera(**changes) -> ReferenceCamera:
    """55 mm f/2.8 at magnification 1/2 before 6 × 5 coarse pixels, unless changed."""
    return dataclasses.replace(ReferenceCamera(55.0, 2.8, 165.0, 1.0, 6, 5), **changes)


def pose() -> np.ndarray:
    """A rigid motion in general position."""
    turn = trimesh.transformations.euler_matrix(0.4, -1.1, 2.0)
    turn[:3, 3] = 20, -35, 10
    return turn


def uniform(points, shape):
    return np.full(len(points), EXITANCE)


def wavy(points, shape):
    x, y, z = points.T
    return EXITANCE * (1 + 0.5 * np.sin(0.21 * x + 0.4) * np.cos(0.13 * y - 0.17 * z))


def sheet(distance):
    """A tilted rectangle across every line of sight, facing the lens."""
    width, height = np.array([0, 1, -0.2]), np.cross([0, 1, -0.2], [0.3, 0, 1.0])
    return Rectangle([0.0, 0.0, distance], 400 * width, 400 * height)


def rms(image):
    return np.sqrt(np.mean(np.square(image)))
