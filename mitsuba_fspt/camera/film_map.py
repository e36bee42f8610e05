"""The way between the film and the virtual detector plane: one pair of functions, each the inverse of the other.

A point (x, y) [mm] of the virtual detector plane z = u, in Mitsuba's camera frame with +x to the left and +y up in the
upright image, has its image at the film position [pixels from the top left corner, x to the right, y downwards]

    position = middle − (x, y)/p,   p = pixel_pitch/t,   dA_vd = p² dA_film                                  (Eq. M.6)

with the `middle` of the film, through which the optical axis passes, and the side p of a virtual pixel.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class FilmMap:
    """Map between film positions [pixels] and points of the virtual detector plane [mm].

    middle : film position (x, y) of the optical axis [pixels]
    side : of a virtual pixel [mm]; `opaque_side` as a parameter of kernels
    """

    def __init__(self, middle: tuple[float, float], side: float) -> None:
        self.middle, self.side = middle, side
        # Opaque: films of all sizes share the kernels.
        self._middle = mi.Point2f(*(dr.opaque(mi.Float, n) for n in middle))
        self.opaque_side = dr.opaque(mi.Float, side)

    def to_plane(self, position: mi.Point2f) -> mi.Point2f:
        """Point of the virtual detector plane [mm] whose image is at a film position [pixels]."""
        return mi.Point2f(self._middle - position) * self.opaque_side

    def to_film(self, x: mi.Point2f, scale: Any = 1.0) -> mi.Point2f:
        """Film position [pixels] of the image of the point x/`scale` [mm] of the virtual detector plane."""
        return mi.Point2f(self._middle - mi.Vector2f(x) / (scale * self.opaque_side))

    def to_film_in_double(self, x: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
        """`to_film` of NumPy arrays: x (…, 2), `scale` (…, 1)."""
        return np.array(self.middle, np.float64) - x / (scale * self.side)
