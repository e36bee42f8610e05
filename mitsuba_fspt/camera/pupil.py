"""The pupil in the lens plane: the disc on which lines of sight start, clipped by a second border."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi

from ..jit.disc_segments import segment, segment_height
from ..optics.discs import defocus
from ..optics.thin_lens import Lens

LEAST_SCALE = 1e-6  # m' of Eq. M.7; a point with a smaller one lies before the border, where none has an image


class Pupil:
    """The discs of the lens plane as kernel parameters. Points of the pupil are given on the unit disc.

    shift, radius : of the first disc: its centre is at `shift`·x for virtual point x, its radius is in mm, 0 for a
        pinhole
    """

    def __init__(self, optics: Lens) -> None:
        self.shift, self.radius = (dr.opaque(mi.Float, n) for n in (optics.discs[0].shift, optics.pupil_radius))
        self._borders = [tuple(dr.opaque(mi.Float, n) for n in (d.shift, d.radius)) for d in optics.discs[1:]]
        self._u = dr.opaque(mi.Float, optics.focus_distance)

    def without_borders(self) -> Pupil:
        """The first disc alone."""
        whole = copy(self)
        whole._borders = []
        return whole

    @property
    def bordered(self) -> bool:
        """True if a second border may cover a part of the pupil."""
        return bool(self._borders)

    def on_lens(self, x: mi.Point2f, pupil: mi.Point2f) -> mi.Point2f:
        """Point a = shift·x + radius·pupil [mm] of the lens plane, for virtual point x [mm]."""
        return self.shift * x + self.radius * pupil

    def passes(self, x: mi.Point2f, a: mi.Point2f) -> mi.Bool:
        """True where the line through virtual point x and lens point a passes a second border (Eq. 5)."""
        passes = mi.Bool(True)
        for shift, radius in self._borders:
            passes &= dr.squared_norm(a - shift * x) <= dr.square(radius)
        return passes

    def opened(self, x: mi.Point2f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Image of a pupil point in the part of the pupil that a second border leaves open, and the share of that part.

        The map preserves area up to that share, so that any rule over the unit disc integrates over the open part.
        """
        share = mi.Float(1)
        for shift, radius in self._borders:
            centre = (shift - self.shift) / self.radius * mi.Vector2f(x)
            pupil, share = onto_overlap(pupil, centre, radius / self.radius)
        return pupil, share

    def opened_to(self, point: mi.Vector3f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """As `opened`, in the part of the pupil that is open to an object `point` [mm], in the camera frame."""
        share = mi.Float(1)
        for across, radius in self._seen_from(point):
            pupil, share = onto_overlap(pupil, across, radius)
        return pupil, share

    def closed_to(self, corners: list[mi.Vector3f], middle: mi.Vector3f) -> mi.Bool:
        """True for triangles with these `corners` and `middle` [mm], in the camera frame, to which nothing is open.

        False for some of them, too: a line between a triangle and all points with an open part is searched for in one
        direction alone.
        """
        closed = mi.Bool(False)
        for k, (across, _) in enumerate(self._seen_from(middle)):
            beyond, away = mi.Bool(True), across / dr.norm(across)
            for corner in corners:
                there, radius = self._seen_from(corner)[k]
                beyond &= dr.dot(away, there) > 1 + radius
            closed |= beyond
        return closed

    def _seen_from(self, point: mi.Vector3f) -> list[tuple[mi.Vector2f, mi.Float]]:
        """Centre and radius of each second border on the unit disc, as seen from a point in the camera frame.

        The lens point a = κx + ρ of light towards ρ passes a border of κ' and R' where |a - κ'x| <= R'. With
        x = r/m - ρ b/m (Eq. M.7) that is |ρ m'/m - (κ' - κ) r/m| <= R', with m' the scale m for κ'.
        """
        _, scale = defocus(point.z, self._u, self.shift)
        found = []
        for shift, radius in self._borders:
            _, other = defocus(point.z, self._u, shift)
            side = self.radius * dr.maximum(other, LEAST_SCALE)
            found.append(((shift - self.shift) / side * mi.Vector2f(point.x, point.y), radius * scale / side))
        return found


def onto_overlap(point: mi.Point2f, centre: mi.Vector2f, radius: mi.Float) -> tuple[mi.Point2f, mi.Float]:
    """Point of the overlap of the unit disc with the disc of `radius` about `centre`, for a `point` of the unit disc.

    The map is continuous and preserves area up to the factor that comes back second, overlap over unit disc (Eq. M.13).
    A chord at right angles to the line of centres goes to the chord with the same share of area below it, a point of it
    to the point at the same share of its length. Below the height at which the circles meet the second disc bounds the
    overlap, above it the unit disc does.
    """
    distance = dr.norm(centre)
    up = dr.select(distance > 0, centre / distance, mi.Vector2f(1, 0))
    meet = (dr.square(distance) + (1 - radius) * (1 + radius)) / (2 * distance)
    meet = dr.select(distance <= radius - 1, -1, dr.select(distance <= 1 - radius, 1, dr.clip(meet, -1, 1)))
    # Of a large disc the segment is a small share, which single precision would lose.
    lower = mi.Float(dr.square(mi.Float64(radius)) * segment(mi.Float64((meet - distance) / radius)))
    lower = dr.select(meet > -1, lower, 0)
    area = lower + 1 - segment(meet)
    height, across = dr.dot(point, up), dr.dot(point, turned(up))
    below = segment(height) * area
    low, high = segment_height(below / dr.square(radius)), -segment_height(area - below)
    # Beyond a disc that lies inside the unit disc there is nothing, also for points that rounding puts on its rim.
    bounded = (below < lower) | (distance <= 1 - radius)
    half_chord = dr.select(bounded, radius * _half_chord(low), _half_chord(high))
    across = dr.select(dr.abs(height) < 1, across / _half_chord(height), 0) * half_chord
    return mi.Point2f(dr.select(bounded, distance + radius * low, high) * up + across * turned(up)), area


def turned(v: mi.Vector2f) -> mi.Vector2f:
    """`v` turned left by a right angle."""
    return mi.Vector2f(-v.y, v.x)


def _half_chord(height: mi.Float) -> mi.Float:
    return dr.safe_sqrt(1 - dr.square(height))
