"""Power on the pixels of a lens before a uniform source that fills its field, as an integrating sphere does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .thin_lens import Lens


def uniform_power(
    lens: Lens, radiance: float, pixel_pitch: float, shape: tuple[int, int], transmittance: float = 1.0
) -> NDArray[np.float64]:
    """Power (h, w) [W] on pixels of side `pixel_pitch` [mm] of a source of `radiance` [W/mm²/sr], Eq. M.17.

    P = π L A_vd f, at the centre of each pixel, whatever the distance of the source: with the radiance L, no factor 4π.
    `shape` is (h, w), `transmittance` the share that lens and filters let through.
    """
    side = pixel_pitch * (lens.focus_distance - lens.focal_length) / lens.focal_length  # of a virtual pixel: p/t
    height, width = shape
    y, x = (side * (np.arange(n) - (n - 1) / 2) for n in (height, width))
    radius, u = lens.focal_length / lens.f_number / 2, lens.focus_distance
    z = u**2 + radius**2 + x[None, :] ** 2 + y[:, None] ** 2
    offset = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2)
    s = np.sqrt((z - 2 * radius * offset) * (z + 2 * radius * offset))
    factor = 2 * radius**2 * u**2 / (s * (s + z - 2 * radius**2))
    return transmittance * np.pi * radiance * side**2 * factor
