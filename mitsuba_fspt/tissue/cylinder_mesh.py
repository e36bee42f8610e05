"""Tetrahedra of a solid cylinder: rings of triangles, stacked in layers, each prism cut into three."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..runtime.errors import FluxError
from .tetrahedra import Tetrahedra, require_few

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def cylinder_tetrahedra(radius: float, height: float, edge: float) -> Tetrahedra:
    """Tetrahedra of the cylinder about the z axis, centred at the origin, with edges of about `edge` [mm].

    Every vertex of the border lies on the true cylinder; `snap` of the result moves points of a chord onto it.

    Raises
    ------
    FluxError : a length is not positive and finite, or the edge is longer than the radius or the height, or so
        short that there would be more than 5 million tetrahedra.
    """
    for name, value in (("radius", radius), ("height", height), ("edge", edge)):
        if not (math.isfinite(value) and value > 0):
            raise FluxError(f"cylinder: '{name}' must be > 0 and finite, got {value:g}. Give mm.")
    if edge > min(radius, height):
        raise FluxError(
            f"cylinder: the mesh edge {edge:g} mm must not exceed radius {radius:g} mm or height {height:g} "
            f"mm. Give {min(radius, height) / 10:.3g} or less."
        )
    require_few(18 * radius * radius * height, edge)  # three in each prism, 6 rings² prisms per layer
    rings, layers = round(radius / edge), round(height / edge)
    disc, triangles = unit_disc(rings)
    z = np.linspace(-height / 2, height / 2, layers + 1)
    vertices = np.column_stack([np.tile(disc * radius, (layers + 1, 1)), np.repeat(z, len(disc))])
    prisms = (np.arange(layers)[:, None, None] * len(disc) + triangles).reshape(-1, 3)
    sagitta = radius * (1 - math.cos(math.pi / (6 * rings)))

    def snap(points: Array) -> Array:
        distance = np.hypot(points[:, 0], points[:, 1])
        side = distance > radius - 1.01 * sagitta
        snapped = points.copy()
        snapped[side, :2] *= (radius / distance[side])[:, None]
        return snapped

    return Tetrahedra(vertices, _cut(prisms, len(disc)), snap=snap)


def unit_disc(rings: int) -> tuple[Array, Index]:
    """Triangulated unit disc: vertices (V, 2), the centre first, then 6 i on each ring i, and triangles (T, 3)."""
    ring = np.repeat(np.arange(1, rings + 1), 6 * np.arange(1, rings + 1))
    position = np.arange(len(ring)) - 3 * ring * (ring - 1)
    angle = position * (math.pi / 3) / ring
    points = (ring / rings)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    # In each of six equal sectors, ring i has i edges and ring i - 1 one less.
    sector, step = np.divmod(position, ring)
    outer, inner = sector * ring + step, sector * (ring - 1) + step
    up = np.column_stack([_at(ring, outer), _at(ring, outer + 1), _at(ring - 1, inner)])
    down = np.column_stack([_at(ring - 1, inner), _at(ring, outer + 1), _at(ring - 1, inner + 1)])
    return np.vstack([np.zeros((1, 2)), points]), np.vstack([up, down[step < ring - 1]])


def _at(ring: Index, position: Index) -> Index:
    """Index of the vertex at a position, counted cyclically, on a ring; ring 0 is the centre alone."""
    return np.where(ring == 0, 0, 1 + 3 * ring * (ring - 1) + position % np.maximum(6 * ring, 1))


def _cut(prisms: Index, layer: int) -> Index:
    """Three tetrahedra, shape (3 P, 4), of each prism over a triangle (P, 3); its top vertices are `layer` higher.

    Triangles sorted by vertex index cut the rectangle between two prisms along the same diagonal from both sides.
    """
    a, b, c = np.sort(prisms, axis=1).T
    pieces = ((a, b, c, c + layer), (a, b, b + layer, c + layer), (a, a + layer, b + layer, c + layer))
    return np.concatenate([np.column_stack(piece) for piece in pieces])
