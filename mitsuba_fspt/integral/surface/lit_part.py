"""The part of a triangle that is lit where the edge of a shadow crosses it, for images of faces (Eq. M.20).

Rays from the corners of a triangle through one node of the pupil show whether all of it is lit. If they differ, an edge
cuts off the corner that differs from the others; bisection finds it. A further ray from a random point shows where a
triangle is hidden in another way, as by a hole or a strip of shadow.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...camera.camera import Camera
from ...jit.loops import repeat
from ..lines.occlusion import hidden

INWARD = 0.05  # of a face: distance from its sides at which rays start that search for the edge of a shadow
HALVINGS = 4  # of a side of a piece, for the edge of a shadow
PARABOLA = 4 / 3  # area between a parabola and its chord, over that of the triangle of the same height


@dataclass(frozen=True)
class LitPart:
    """The part of triangles that is lit, where the edge of a shadow cuts off one of their corners.

    some : True where it does. open : True where it does not and the corners are lit. first, second, third : the
        corners, the one that is cut off first. lit : True where that is the lit one.
    along : shares of the sides from it to the two others where the edge crosses them
    beyond : share of the way from the corner to the chord between these by which the edge lies beyond its middle
    """

    some: mi.Bool
    open: mi.Bool
    first: mi.Point3f
    second: mi.Point3f
    third: mi.Point3f
    lit: mi.Bool
    along: mi.Point2f
    beyond: mi.Float

    @classmethod
    def of(
        cls,
        scene: mi.Scene,
        camera: Camera,
        node: mi.Point2f,
        ends: list[mi.Point3f],
        middle: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> LitPart:
        """Of triangles with the corners `ends` as seen through a node of the pupil; found by bisection.

        `middle`: of each triangle. Triangles that are not `active` count as open.
        """

        def open_from(point: mi.Point3f, asked: mi.Bool) -> mi.Bool:
            start = point + INWARD * (middle.p - point)
            return asked & ~hidden(scene, start, middle.n, camera.open_arrival(start, node)[1], asked)

        seen = [open_from(end, active) for end in ends]
        some = active & ((seen[0] != seen[1]) | (seen[0] != seen[2]))
        odd = [seen[1] == seen[2], seen[0] == seen[2]]  # else the third

        def turned(k: int) -> mi.Point3f:
            return dr.select(odd[0], ends[k], dr.select(odd[1], ends[(k + 1) % 3], ends[(k + 2) % 3]))

        first, second, third = (turned(k) for k in range(3))
        lit = dr.select(odd[0], seen[0], dr.select(odd[1], seen[1], seen[2]))

        def halve(k: mi.UInt32, place: mi.Point3f, width: mi.Float) -> tuple[mi.Point3f, mi.Float]:
            on_side, across = k < sides, k % 2 == 1
            share = dr.select(on_side, dr.select(across, place.y, place.x), place.z)
            way = dr.select(across, third, second) - first
            middle_way = 0.5 * (place.x * (second - first) + place.y * (third - first))
            point = first + share * dr.select(on_side, way, middle_way)
            share += dr.select(open_from(point, some) == lit, 1.0, -1.0) * width
            place = mi.Point3f(
                dr.select(on_side & ~across, share, place.x),
                dr.select(on_side & across, share, place.y),
                dr.select(on_side, _farthest(place) / 2, share),
            )
            last = k + 1 == sides
            halved = dr.select(on_side & ~across, width, 0.5 * width)
            return place, dr.select(last, _farthest(place) / 4, halved)

        sides = dr.opaque(mi.UInt32, 2 * HALVINGS)
        place, _ = repeat(dr.select(some, sides + HALVINGS, 0), halve, mi.Point3f(0.5), mi.Float(0.25))
        along, beyond = _shadow_edge(place)
        return cls(some, ~some & (seen[0] | ~active), first, second, third, lit, along, beyond)

    def contains(self, point: mi.Point3f) -> mi.Bool:
        """Whether points of triangles are lit, where an edge crosses one."""
        u, v = _coordinates([self.first, self.second, self.third], point)
        u, v = u / dr.maximum(self.along.x, 1e-6), v / dr.maximum(self.along.y, 1e-6)
        corner = u + v < 1 + self.beyond * dr.maximum(1 - dr.square(u - v), 0)
        return corner == self.lit

    def of_image(
        self,
        camera: Camera,
        origin: mi.Vector2f,
        node: mi.Point2f,
        ring: list[mi.Point2d],
        count: mi.UInt32,
    ) -> tuple[list[mi.Point2d], mi.UInt32, mi.Float64]:
        """Polygon, number of edges and factor of the light of images through a node of the pupil, without dark parts.

        The edge counts as a parabola: the polygon ends at its chord, with the light of the area beyond in the factor.
        Of an image that is no triangle, not the polygon but the light becomes smaller.
        """
        whole = count == 4
        chord = mi.Float64(self.along.x * self.along.y)
        corner = dr.clip(chord * (1 + PARABOLA * mi.Float64(self.beyond)), 0, 1)
        share = dr.select(self.lit, corner, 1 - corner)
        share /= dr.select(whole, 1, dr.maximum(dr.select(self.lit, chord, 1 - chord), 1e-6))
        sides = (self.along.x, self.second), (self.along.y, self.third)
        a, b = (self.first + share * (end - self.first) for share, end in sides)
        corners = [
            dr.select(self.lit, self.first, a),
            dr.select(self.lit, a, self.second),
            dr.select(self.lit, b, self.third),
            dr.select(self.lit, self.first, b),
        ]
        cut = self.some & ~whole
        images = [mi.Point2d(camera.open_arrival(corner, node)[0] - origin) for corner in corners]
        ring = [dr.select(cut, new, old) for new, old in zip(images, ring, strict=True)]
        return ring, dr.select(cut, dr.select(self.lit, mi.UInt32(3), 4), count), dr.select(self.some, share, 1)


def _farthest(place: mi.Point3f) -> mi.Float:
    """Where the median of the chord between two sides ends in the triangle, in chords; no farther than twice as far."""
    return dr.minimum(2, 2 / dr.maximum(place.x + place.y, 0.5))


def _shadow_edge(place: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
    """Where the edge of a shadow crosses two sides of a triangle, and how far it lies beyond the chord between.

    place : where it crosses these sides and the median between, of a triangle smaller by `INWARD`: shares of the sides
        from their common corner, and of the way to the chord there

    With barycentric coordinates λ of the other two corners the chord is λ₂/a + λ₃/b = 1; on each of the smaller sides
    one of them is `INWARD`/3. A share of the way beyond the chord is λ₂/a + λ₃/b - 1.
    """
    least = INWARD / 3
    x, y = ((1 - INWARD) * share + least for share in (place.x, place.y))
    lines = x * y - least * least
    a, b = dr.minimum(lines / (y - least), 1), dr.minimum(lines / (x - least), 1)
    there = [0.5 * (1 - INWARD) * place.z * share + least for share in (place.x, place.y)]
    return mi.Point2f(a, b), there[0] / a + there[1] / b - 1


def _coordinates(ends: list[mi.Point3f], point: mi.Point3f) -> tuple[mi.Float, mi.Float]:
    """Barycentric coordinates of points of triangles, of the second and the third corner."""
    a, b, way = ends[1] - ends[0], ends[2] - ends[0], point - ends[0]
    aa, ab, bb, p, q = dr.squared_norm(a), dr.dot(a, b), dr.squared_norm(b), dr.dot(way, a), dr.dot(way, b)
    size = aa * bb - dr.square(ab)
    return (bb * p - ab * q) / size, (aa * q - ab * p) / size
