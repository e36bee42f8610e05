"""The way between the film and the virtual detector plane: one pair of functions, each the inverse of the other.

A point (x, y) [mm] of the virtual detector plane z = u, in Mitsuba's camera frame with +x to the left and +y up in the
upright image, has its image at the film position [pixels from the top left corner, x to the right, y downwards]

    position = middle − (x, y)/p,   p = pixel_pitch/t,   dA_vd = p² dA_film                                  (Eq. M.6)

with the `middle` of the film, through which the optical axis passes, and the side p of a virtual pixel. A lens with
distortion takes (x_d, y_d) in place of (x, y) (Eq. M.44), so that a film pixel is the preimage of its square and
dA_vd = p² dA_film/det(∂x_d/∂x). Positions without the distortion are called ideal.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..optics.distortion import continued, preimage, shrink_in_double
from ..optics.thin_lens import Lens

STRETCH_MARGIN = 1.02  # of the largest stretch, which is searched for on points of the film alone
GRID = 65  # of those points along each side

Plane = NDArray[np.float64]


class FilmMap:
    """Map between film positions [pixels] and points of the virtual detector plane [mm].

    lens : in focus, with its distortion
    middle : film position (x, y) of the optical axis [pixels]
    side : of a virtual pixel [mm]; `opaque_side` as a parameter of kernels
    stretch : largest factor by which the distortion enlarges a length on the film

    Raises
    ------
    OpticsError : the distortion folds the image inside the film.
    """

    def __init__(self, lens: Lens, middle: tuple[float, float], side: float) -> None:
        self.middle, self.side, self.stretch = middle, side, 1.0
        # Opaque: films of all sizes share the kernels.
        self._middle = mi.Point2f(*(dr.opaque(mi.Float, n) for n in middle))
        self.opaque_side = dr.opaque(mi.Float, side)
        self.distorted = lens.distortion is not None
        if lens.distortion is None:
            return
        length = lens.pupil_distance
        limit = lens.distortion.limit(np.hypot(*middle) * side / length, lens.magnification * length)
        self._own = (lens.distortion.coefficients, length, limit)
        coefficients = tuple(dr.opaque(mi.Float, k) for k in lens.distortion.coefficients)
        self._opaque = (coefficients, *(dr.opaque(mi.Float, n) for n in (length, limit)))
        x, y = np.meshgrid(np.linspace(-limit, limit, GRID), np.linspace(-limit, limit, GRID))
        _, _, a, b, d = continued(x, y, self._own[0], shrink_in_double(x, y, limit))
        largest = np.abs(a + d) / 2 + np.hypot((a - d) / 2, b)
        self.stretch = STRETCH_MARGIN * float(largest.max())

    def to_plane(self, position: mi.Point2f) -> mi.Point2f:
        """Point of the virtual detector plane [mm] whose image is at a film position [pixels]."""
        x = self.ideal_to_plane(position)
        return self._preimage(x)[0] if self.distorted else x

    def to_film(self, x: mi.Point2f) -> mi.Point2f:
        """Film position [pixels] of the image of a point x [mm] of the virtual detector plane."""
        return self.from_ideal(mi.Point2f(self._middle - mi.Vector2f(x) / self.opaque_side))

    def area_share(self, position: mi.Point2f) -> mi.Float | float:
        """dA_vd/(p² dA_film) at a film position: what a pixel there sees of the virtual plane, over a virtual pixel."""
        return self._preimage(self.ideal_to_plane(position))[1] if self.distorted else 1.0

    def ideal_to_plane(self, position: mi.Point2f) -> mi.Point2f:
        """Point of the virtual detector plane [mm] whose image would be at this position [pixels] undistorted."""
        return mi.Point2f(self._middle - position) * self.opaque_side

    def ideal_to_film(self, x: mi.Point2f, scale: Any = 1.0) -> mi.Point2f:
        """Ideal position [pixels] of the image of the point x/`scale` [mm] of the virtual detector plane."""
        return mi.Point2f(self._middle - mi.Vector2f(x) / (scale * self.opaque_side))

    def from_ideal(self, position: mi.Point2f) -> mi.Point2f:
        """Film position [pixels] of what would be at the ideal `position` undistorted."""
        if not self.distorted:
            return position
        coefficients, length, limit = self._opaque
        slope = self.ideal_to_plane(position) / -length
        x_d, y_d, *_ = continued(slope.x, slope.y, coefficients, _shrink(slope.x, slope.y, limit))
        return mi.Point2f(self._middle + mi.Vector2f(x_d, y_d) * (length / self.opaque_side))

    def to_ideal(self, position: mi.Point2f) -> mi.Point2f:
        """Ideal position [pixels] of what has its image at a film position."""
        return self.ideal_to_film(self.to_plane(position)) if self.distorted else position

    def ideal_in_double(self, x: Plane, scale: Plane) -> Plane:
        """`ideal_to_film` of NumPy arrays: x (…, 2), `scale` (…, 1)."""
        return np.array(self.middle, np.float64) - x / (scale * self.side)

    def from_ideal_in_double(self, position: Plane) -> Plane:
        """`from_ideal` of NumPy arrays (…, 2)."""
        if not self.distorted:
            return position
        coefficients, length, limit = self._own
        x, y = np.moveaxis((position - self.middle) * (self.side / length), -1, 0)
        x_d, y_d, *_ = continued(x, y, coefficients, shrink_in_double(x, y, limit))
        return self.middle + np.stack([x_d, y_d], axis=-1) * (length / self.side)

    def _preimage(self, x: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Point whose distorted image is that of x undistorted, and the share of area there."""
        coefficients, length, limit = self._opaque
        wanted = x / -length
        u, v, share = preimage(wanted.x, wanted.y, coefficients, lambda u, v: _shrink(u, v, limit))
        return mi.Point2f(u * -length, v * -length), share


def _shrink(x: mi.Float, y: mi.Float, limit: mi.Float) -> mi.Float:
    """`shrink` of `continued` for Dr.Jit arrays."""
    radius = dr.sqrt(dr.square(x) + dr.square(y))
    return dr.select(radius > limit, limit / radius, 1)
