"""Power on the pixels of a camera that sees only a uniform source, such as an integrating sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .pixel_etendue import pixel_etendues
from .thin_lens import Lens
from .vignetting import Vignetting


def uniform_power(
    lens: Lens,
    radiance: float,
    pixel_pitch: float,
    shape: tuple[int, int],
    transmittance: float = 1.0,
    vignetting: Vignetting | None = None,
) -> NDArray[np.float64]:
    """Power [W] on each pixel, shape (h, w): P = τ L G ⟨cos⁴θ⟩ (Eq. M.6), whatever the distance of the source.

    On the axis this is τ π L A_vd f (M.17). Borders of the lens and the image-plane stop are taken into account.

    Parameters
    ----------
    radiance : L of the source [W/mm²/sr]
    pixel_pitch : side of a pixel [mm]
    shape : (h, w) of the image
    transmittance : share τ of the power that lens and filters let through
    vignetting : share of each pixel that passes beyond that (Eq. M.45), on a film of this shape
    """
    side = pixel_pitch / lens.magnification  # of a virtual pixel: p/t
    y, x = (np.asarray(side * (np.arange(n) - (n - 1) / 2), np.float64) for n in shape)
    power = radiance * pixel_etendues(lens, side, x, y, transmittance)
    if vignetting is None:
        return power
    size = shape[1], shape[0]
    return power * vignetting.on_pixels(pixel_pitch, size, (0, 0), size)
