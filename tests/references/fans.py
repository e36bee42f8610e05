"""Eq. 9 in float64 NumPy on single pixels: edges are found exactly along one of four coordinates.

Lines of sight through one point of the pupil and a segment of the pixel form a fan. The positions at which a fan meets
edges of bodies, stops and texels follow from linear and quadratic equations; between them Gauss's rule integrates. The
result is smooth in the other three coordinates, over which randomly shifted lattices of growing size integrate. The
scatter over the shifts gives the error. Frame and units are those of `sampled`. No integration is shared with that
module, and no code with the plugins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .bodies import Body, Fan, first_met, reflected, roots, seen_along, seen_on
from .camera import ReferenceCamera, Stops
from .sampled import lattice
from .shapes import Array, dot, unit_disc

Indices = NDArray[np.int64]
SHIFTS = 16
CERTAIN = 4.1  # standard errors of the mean of 16 shifts that 999 of 1000 stay within (Student's t)
FEW, UNMET = 16, 6.9  # fans with light from which a scatter can be estimated; −ln of one case of 1000
# Numbers of fans in a shift of a lattice. At the first size all ways to lay fans are tried; the second size is always
# computed, because all fans of the first may miss a corner in the pixel.
LINES = (64, 512, 2048, 8192, 32768)
MOST_LINES = 8192  # largest number of fans in a shift, unless another is requested
MOST_FANS = 1 << 12  # that are computed at a time
GAUSS = 8  # nodes on a piece between two edges
SHORTEST = 1e-13  # of a fan's length: shorter pieces are left out


@dataclass(frozen=True)
class FanReference:
    """Scene, and its reference on single pixels.

    Parameters
    ----------
    camera : with the whole film, on which pixels are numbered
    stops : `Stops.of(camera)` if there are no further ones
    bodies : surfaces that lines of sight meet; opaque ones must not intersect
    pixel : 'area' or 'centre'
    """

    camera: ReferenceCamera
    stops: Stops
    bodies: Sequence[Body]
    pixel: Literal["area", "centre"] = "area"

    def power(self, pixels: ArrayLike, goal: ArrayLike, seed: int = 0, most: int = MOST_LINES) -> tuple[Array, Array]:
        """Power on pixels (n, 2), given as (row, column), and its error, each (n,) [W].

        Lattices grow until the error, 4.1 standard errors of 16 shifts, is below `goal` [W], one number or (n,), or
        they have `most` fans.
        """
        pixels = np.asarray(pixels, int)
        goals = np.broadcast_to(np.asarray(goal, np.float64), len(pixels))
        # A pixel takes some 10⁵ lines of sight, so that the overhead of this loop is negligible.
        found = [self._on_pixel(int(r), int(c), own, seed, most) for (r, c), own in zip(pixels, goals, strict=True)]
        return np.array([value for value, _ in found]), np.array([error for _, error in found])

    def _on_pixel(self, row: int, column: int, goal: float, seed: int, most: int) -> tuple[float, float]:
        camera, side = self.camera, self.camera.pixel_side
        centre = np.array([(camera.width / 2 - column - 0.5) * side, (camera.height / 2 - row - 0.5) * side])
        bodies = [part for body in self.bodies if (part := body.near(camera, self.stops, centre)) is not None]
        if any(body.role != "opaque" for body in self.bodies):
            bodies = list(self.bodies)
        if not bodies:
            return 0.0, 0.0
        random = np.random.default_rng([seed, row, column])
        best: tuple[float, float, tuple[bool, int]] | None = None
        ways = [(over_pupil, axis) for over_pupil in (False, True) for axis in (0, 1)]
        if self.pixel == "centre":
            ways = ways[2:]
        for lines in LINES:
            if lines > most:
                break
            for way in ways:
                means, lit = self._means(bodies, centre, way, lines, random.random((SHIFTS, 3)))
                error = CERTAIN * float(np.std(means, ddof=1)) / math.sqrt(SHIFTS)
                if lit < FEW:  # all fans may have missed a part of pixel × pupil with light
                    error = max(error, UNMET / (SHIFTS * lines) * self._most(bodies))
                if best is None or error < best[1] or way == best[2]:
                    best = (float(np.mean(means)), error, way)
            if best is not None and best[1] < goal and lines > LINES[0]:
                break
            ways = [best[2]] if best and best[1] > 0 else ways
        return best[:2] if best else (0.0, 0.0)

    def _most(self, bodies: Sequence[Body]) -> float:
        """Upper bound of the power on a pixel [W], as if all of its lines of sight met the brightest surface."""
        stops = self.stops
        size = self.camera.pixel_side * stops.pupil_radius / (self.camera.focus_distance - stops.pupil_depth)
        return size**2 * max((body.most for body in bodies), default=0.0)

    def _means(
        self, bodies: Sequence[Body], centre: Array, way: tuple[bool, int], lines: int, shifts: Array
    ) -> tuple[Array, int]:
        """Power [W] by each shift's lattice of fans, and the number of fans that meet light.

        way : whether fans cover a chord of the pupil or of the pixel, and along which axis. The caller takes the best
            of the four: edges parallel to the fans make a way inaccurate.
        """
        camera, stops = self.camera, self.stops
        u, depth, side = camera.focus_distance, stops.pupil_depth, camera.pixel_side
        (over_pupil, axis), number = way, lines * len(shifts)
        dimensions = 1 if self.pixel == "centre" else 3
        nodes = np.concatenate([lattice(lines, shift[:dimensions]) for shift in shifts])
        step = np.zeros((number, 3))
        if not over_pupil:
            apex = _at(stops.pupil_radius * unit_disc(nodes[:, :2]), depth)
            corner = np.stack([np.full(number, -0.5), nodes[:, 2] - 0.5], axis=1)[:, [axis, 1 - axis]]
            start, share, behind = _at(centre + side * corner, u) - apex, np.ones(number), 0.0
            step[:, axis] = side
        else:
            # Uniform in the angle at which chords end: the density of chords, 2 sin², vanishes at both ends.
            height, share = -np.cos(np.pi * nodes[:, 0]), 2 * np.sin(np.pi * nodes[:, 0]) ** 2
            half = np.sqrt(1 - height**2)
            first = stops.pupil_radius * np.stack([-half, height], axis=1)[:, [axis, 1 - axis]]
            offset = side * (nodes[:, 1:] - 0.5) if dimensions == 3 else np.zeros((number, 2))
            apex = _at(centre + offset, u)
            start, behind = apex - _at(first, depth), 1.0
            step[:, axis] = -2 * stops.pupil_radius * half
        along = self._along(bodies, Fan(apex, start, step, behind))
        means = (along * share).reshape(len(shifts), lines).mean(axis=1)
        etendue = side**2 * math.pi * (stops.pupil_radius / (u - depth)) ** 2
        return etendue * means, int(np.count_nonzero(along))

    def _along(self, bodies: Sequence[Body], fan: Fan) -> Array:
        """Mean of cos⁴θ times radiance over each fan, (n,)."""
        parts = range(0, len(fan.apex), MOST_FANS)
        return np.concatenate([self._along_some(bodies, fan.some(slice(at, at + MOST_FANS))) for at in parts])

    def _along_some(self, bodies: Sequence[Body], fan: Fan) -> Array:
        """Mean of cos⁴θ times radiance over each of at most `MOST_FANS` fans, (n,)."""
        edges = [self._stop_edges(fan), *(body.edges(fan) for body in bodies)]
        for mirror in bodies:
            if mirror.role != "opaque":
                image = reflected(fan, mirror.shape)
                edges += [body.edges(image) for body in bodies if body is not mirror]
        at = np.concatenate(edges, axis=1)
        at = np.sort(np.where((at > 0) & (at < 1), at, 1.0), axis=1)  # nan becomes 1, too
        count = len(at)
        ends = np.concatenate([np.zeros((count, 1)), at, np.ones((count, 1))], axis=1)
        fan_of, piece = np.nonzero(np.diff(ends, axis=1) > SHORTEST)
        low, high, met = ends[fan_of, piece], ends[fan_of, piece + 1], None
        if all(body.role == "opaque" for body in bodies):
            # Between two edges all lines meet the same face: the line in the middle finds it.
            _, first, face = first_met(bodies, *fan.lines(fan_of, (low + high) / 2))
            glows = np.isin(first, [number for number, body in enumerate(bodies) if body.exitance is not None])
            fan_of, low, high = fan_of[glows], low[glows], high[glows]
            met = np.repeat([first[glows], face[glows]], GAUSS, axis=1)
        node, weight = np.polynomial.legendre.leggauss(GAUSS)
        node, weight = (node + 1) / 2, weight / 2
        # Nodes are dense towards both ends, by a map that makes the square root at a limb linear.
        place, slope = node**2 * (3 - 2 * node), 6 * node * (1 - node)
        s = low[:, None] + (high - low)[:, None] * place
        share = (high - low)[:, None] * (weight * slope)
        row = np.repeat(fan_of, GAUSS)
        value = self._integrand(bodies, *fan.lines(row, s.ravel()), met) * share.ravel()
        return np.bincount(row, value, minlength=count).astype(np.float64)

    def _integrand(self, bodies: Sequence[Body], origin: Array, direction: Array, met: Indices | None) -> Array:
        """cos⁴θ times radiance [W/mm²/sr] on lines of sight, (n,); 0 where a stop blocks the line.

        met : the bodies and faces that lines meet first, (2, n); None: not known
        """
        stops, u = self.stops, self.camera.focus_distance
        through = stops.lens_radius, stops.field_radius
        inside = np.ones(len(origin), bool)
        for radius, depth in zip(through, (0.0, u), strict=True):
            if math.isfinite(radius):
                at = origin + ((depth - origin[:, 2]) / direction[:, 2])[:, None] * direction
                inside &= np.hypot(at[:, 0], at[:, 1]) <= radius
        cos2 = direction[:, 2] ** 2 / dot(direction, direction)
        value, lines = np.zeros(len(origin)), (origin[inside], direction[inside])
        value[inside] = seen_along(bodies, *lines) if met is None else seen_on(bodies, met[:, inside], *lines)
        return cos2**2 * value

    def _stop_edges(self, fan: Fan) -> Array:
        """Parameters s at which fans meet the borders of the lens and of the image-plane stop, (n, 4)."""
        stops, u = self.stops, self.camera.focus_distance
        found = []
        for radius, depth in ((stops.lens_radius, 0.0), (stops.field_radius, u)):
            if not math.isfinite(radius):
                continue
            # `step` is perpendicular to the axis, so that all lines reach this plane at the same parameter τ.
            far = ((depth - fan.apex[:, 2]) / fan.start[:, 2])[:, None]
            at, along = (fan.apex + far * fan.start)[:, :2], (far * fan.step)[:, :2]
            found.append(roots(dot(along, along), 2 * dot(at, along), dot(at, at) - radius**2))
        return np.concatenate(found, axis=1) if found else np.empty((len(fan.apex), 0))


def _at(xy: Array, depth: float) -> Array:
    """Points (n, 3) of the plane at this depth."""
    return np.concatenate([xy, np.full((len(xy), 1), depth)], axis=1)
