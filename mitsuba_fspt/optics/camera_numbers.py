"""Numbers that follow from those of a lens and its film: what a camera shows, how brightly and how sharply."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .distortion import distorted
from .pixel_etendue import pixel_etendues
from .thin_lens import Lens
from .transmittance import t_stop
from .vignetting import Vignetting


@dataclass(frozen=True)
class CameraNumbers:
    """Numbers of a camera in focus, lengths in mm.

    focus_distance, image_distance, magnification : u, v and t of the lens law (M.1)
    working_f_number : f_num (1 + t/P) (M.40)
    t_stop : f_num/√τ
    field_of_view : width and height of what the film shows in the plane in focus
    scale : side of a pixel in that plane
    depth_of_field : depths between which the blur disc of a point on the axis is at most a pixel wide (M.8)
    airy_radius : on the film (M.32), in `airy_pixels` also in pixels
    corner_illumination : power on a corner pixel over that on the middle, of a uniform source, with the vignetting
    corner_distortion : change of the corner's distance from the middle, over that distance; 0 without distortion
    """

    focus_distance: float
    image_distance: float
    magnification: float
    working_f_number: float
    t_stop: float
    field_of_view: tuple[float, float]
    scale: float
    depth_of_field: tuple[float, float]
    airy_radius: float
    airy_pixels: float
    corner_illumination: float
    corner_distortion: float

    @classmethod
    def of(
        cls,
        lens: Lens,
        pixel_pitch: float,
        size: tuple[int, int],
        *,
        transmittance: float = 1.0,
        wavelength_nm: float = 600.0,
        vignetting: Vignetting | None = None,
    ) -> CameraNumbers:
        """Numbers of a lens before a film of `size` (width, height) pixels [mm of pitch].

        Raises OpticsError where the distortion folds inside the film.
        """
        side = pixel_pitch / lens.magnification
        width, height = size
        x = side * np.array([0.5 - width / 2, 0.0 if width % 2 else 0.5])
        y = side * np.array([0.5 - height / 2, 0.0 if height % 2 else 0.5])
        powers = pixel_etendues(lens, side, x, y)
        if vignetting is not None:
            shares = vignetting.on_pixels(pixel_pitch, size, (0, 0), size)
            powers = powers * shares[np.ix_((0, height // 2), (0, width // 2))]
        radius = lens.airy_radius(wavelength_nm)
        return cls(
            focus_distance=lens.focus_distance,
            image_distance=lens.image_distance,
            magnification=lens.magnification,
            working_f_number=lens.working_f_number,
            t_stop=t_stop(lens.f_number, transmittance),
            field_of_view=(width * side, height * side),
            scale=side,
            depth_of_field=_sharp_depths(lens, side),
            airy_radius=radius,
            airy_pixels=radius / pixel_pitch,
            corner_illumination=float(powers[0, 0] / powers[1, 1]),
            corner_distortion=_corner_distortion(lens, side, size),
        )


def _sharp_depths(lens: Lens, side: float) -> tuple[float, float]:
    """Depths z [mm] at which the blur radius of M.8 is half a virtual pixel: R b/m = ± side/2, solved for b and z.

    The farther one is inf where the blur never grows to it.
    """
    if lens.pupil_radius == 0:
        return 0.0, math.inf
    disc, u = lens.discs[0], lens.focus_distance
    share = side / (2 * disc.radius)
    turn = (1 - disc.shift) * share
    return u * (1 - share / (1 + turn)), u * (1 + share / (1 - turn)) if turn < 1 else math.inf


def _corner_distortion(lens: Lens, side: float, size: tuple[int, int]) -> float:
    """Share by which the distortion moves the corner of the undistorted field away from the middle; the largest."""
    if lens.distortion is None:
        return 0.0
    corners = np.array([[1, 1, -1, -1], [1, -1, 1, -1]]) * np.array(size)[:, None] * side / 2 / lens.pupil_distance
    moved = np.hypot(*distorted(corners[0], corners[1], lens.distortion.coefficients)) / np.hypot(*corners) - 1
    return float(moved[np.argmax(np.abs(moved))])
