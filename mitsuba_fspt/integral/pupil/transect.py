"""Transects: curves through pixel × pupil that cross every straight edge at right angles to them just once.

Light from a surface point through pupil point a arrives at film position c + r a; r is the signed radius of the blur
disc (Eq. M.7). A straight edge with normal n divides pixel × pupil at one value of n·(p - r a) for any blur. A transect
goes from the smallest to the largest value. Three more coordinates in [0, 1] run along the edge. The mean along a
transect hardly depends on them: where edges are nearly straight, a few transects suffice.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...camera.pupil import turned
from ...jit.disc_segments import segment, segment_double_integral, segment_height, segment_integral

# Blur radii [pixels] at which smaller and larger ones are clipped; the position of the edge then depends on `place`.
LEAST_BLUR, MOST_BLUR = 0.01, 32.0
CENTRE_WIDTH = 0.1  # of the blur radius: width taken for a pixel that is evaluated at its centre


@dataclass
class Transect:
    """Curve s ∈ [-1, 1] through pixel × pupil, on which h x + b y = (h/2 + b) s.

    x ∈ [-½, ½] is the position in the pixel along the film's `axis` nearest to n, h the `width` of the pixel across n;
    y ∈ [-1, 1] the position in the pupil along `lean`, b the `blur`. The coordinates `place` ∈ [0, 1]³ are: the share
    of the pupil with the same sum that has a smaller y; the position on the chord of the pupil at y; the position along
    the pixel's other axis.
    """

    centre: mi.Point2f
    axis: mi.Vector2f
    lean: mi.Vector2f
    width: mi.Float
    blur: mi.Float
    place: mi.Point3f
    area: mi.Float

    def at(self, s: mi.Float) -> tuple[mi.Point2f, mi.Point2f, mi.Float]:
        """Film position [pixels], pupil point [unit disc], and density over s of the measure of pixel × pupil."""
        half = 0.5 * self.width + self.blur
        low, high = (segment((half * s + side * self.width) / self.blur) for side in (-0.5, 0.5))
        y = segment_height(dr.lerp(low, high, self.place.x))
        x = dr.clip((half * s - self.blur * y) / self.width, -0.5, 0.5)
        offset = x * self.axis + (self.place.z - 0.5) * turned(self.axis)
        across = (2 * self.place.y - 1) * dr.safe_sqrt(1 - y * y)
        pupil = mi.Point2f(y * self.lean + across * turned(self.lean))
        return self.centre + self.area * offset, pupil, half * (high - low) / self.width

    def moments(self, s: mi.Float) -> mi.Vector2d:
        """Integrals from -1 to s of the density and of s times it; in double precision, as terms nearly cancel."""
        h, b, s = mi.Float64(self.width), mi.Float64(self.blur), mi.Float64(s)
        half = 0.5 * h + b
        low, high = (half * s - 0.5 * h) / b, (half * s + 0.5 * h) / b
        measure = b / h * (segment_integral(high) - segment_integral(low))
        second = b * b / (h * half) * (segment_double_integral(high) - segment_double_integral(low))
        return mi.Vector2d(measure, s * measure - second)


def transect(centre: mi.Point2f, angle: mi.Float, blur: mi.Float, place: mi.Point3f, area: mi.Float) -> Transect:
    """Transect of a pixel across an edge with its normal at `angle` [rad] and the signed blur radius `blur` [pixels].

    `area`: 1 over the pixel, 0 at its centre.
    """
    sine, cosine = dr.sincos(angle)
    along_x = dr.abs(cosine) > dr.abs(sine)
    size = dr.maximum(LEAST_BLUR, dr.minimum(dr.abs(blur), MOST_BLUR))
    width = dr.select(area > 0, dr.maximum(dr.abs(cosine), dr.abs(sine)), CENTRE_WIDTH * size)
    return Transect(
        centre=centre,
        axis=dr.select(along_x, mi.Vector2f(dr.sign(cosine), 0), mi.Vector2f(0, dr.sign(sine))),
        lean=dr.select(blur > 0, -1.0, 1.0) * mi.Vector2f(cosine, sine),
        width=width,
        blur=size,
        place=place,
        area=area,
    )
