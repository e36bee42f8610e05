"""Power on the pixels of a lens before a uniform source that fills its field, as an integrating sphere does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .pixel_etendue import pixel_etendues
from .thin_lens import Lens


def uniform_power(
    lens: Lens, radiance: float, pixel_pitch: float, shape: tuple[int, int], transmittance: float = 1.0
) -> NDArray[np.float64]:
    """Power (h, w) [W] on pixels of side `pixel_pitch` [mm] of a source of `radiance` [W/mm²/sr]: Eq. M.6 times it.

    P = τ L G ⟨cos⁴θ⟩ whatever the distance of the source, π L A_vd f (M.17) on the axis: no factor 4π. Borders and stop
    of the lens count.
    `shape` is (h, w), `transmittance` the share τ that lens and filters let through.
    """
    side = pixel_pitch / lens.magnification  # of a virtual pixel: p/t
    y, x = (np.asarray(side * (np.arange(n) - (n - 1) / 2), np.float64) for n in shape)
    return radiance * pixel_etendues(lens, side, x, y, transmittance)
