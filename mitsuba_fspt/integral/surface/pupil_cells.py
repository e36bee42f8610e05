"""Cells of the pupil of Eq. M.9: M × M parts of equal area of the unit disc, with middles, corners and sample points.

The cells are turned against rows and columns of pixels. Middles in rows parallel to these would misplace up to three
times as much at an edge of J_n along them.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

TURN = math.pi / 8  # of the cells against rows and columns of pixels [rad]
# Steps of a Kronecker sequence in four dimensions, 1/g … 1/g⁴ with g⁵ = g + 1, and from element to element (golden
# ratio), in units of 2⁻³²: whole numbers, so that the sequence stays exact however long it gets.
STEPS, STRIDE = (3679390609, 3152041523, 2700274807, 2313257605), 2654435769


def strata(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32, number: mi.UInt32) -> tuple[mi.Point2f, mi.Point2f]:
    """Points of a piece, in [0, 1]², and of the unit disc, for the line of sight through the pupil's cell (i, j).

    The lines of a piece take each of its M × M parts and each cell of the pupil once: part = (turn + √-1) × cell
    modulo M, as complex numbers, a lattice without short vectors in four dimensions. They lie off the middles,
    differently in every piece `number`, and in turns opposite ways, so that what is linear is integrated exactly.
    """
    turn = 2 * mi.UInt32(dr.round(0.5 * dr.sqrt(mi.Float(m))))  # even: 1 + turn² has neither 2 nor 3 in common with M
    strata = ((turn * i + (m - 1) * j) % m, (i + turn * j) % m, i, j)
    way = dr.select((i + j) % 2 == 0, 1.0, -1.0)
    off = [way * (mi.Float(number * step) * 2.0**-32 - 0.5) for step in STEPS]
    x = [(mi.Float(stratum) + 0.5 + o) / mi.Float(m) for stratum, o in zip(strata, off, strict=True)]
    return mi.Point2f(x[0], x[1]), _on_disc(mi.Point2f(x[2], x[3]))


def middle(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32) -> mi.Point2f:
    """Middle of the pupil's cell (i, j) in the unit disc, moved outwards for M middles to have the disc's blur.

    Their mean r² would be ½ - 1/M², without the extent of each cell around its middle.
    """
    return _on_pupil(i, j, m, 0.5, 0.5) * dr.rsqrt(1 - 2 / dr.square(mi.Float(m)))


def corner(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32) -> mi.Point2f:
    """Corner (i, j) of the pupil's cells in the unit disc, moved outwards for polygons to have the areas of rings.

    The corners of ring k are those of a regular polygon of 8 k sides, but for its arcs as large as the disc inside.
    """
    half = mi.Int(m // 2)
    ring = dr.maximum(dr.abs(mi.Int(i) - half), dr.abs(mi.Int(j) - half))
    turn = dr.pi / (4 * mi.Float(dr.maximum(ring, 1)))
    return _on_pupil(i, j, m, 0, 0) * dr.sqrt(turn / dr.sin(turn))


def _on_pupil(i: mi.UInt32, j: mi.UInt32, m: mi.UInt32, x: float, y: float) -> mi.Point2f:
    """Point (x, y) of [0, 1]² in the cell (i, j) of the pupil, in the unit disc."""
    return _on_disc(mi.Point2f(mi.Float(i) + x, mi.Float(j) + y) / mi.Float(m))


def _on_disc(square: mi.Point2f) -> mi.Point2f:
    """Point of the unit disc for one of [0, 1]²; equal areas, concentric squares become circles."""
    straight = mi.warp.square_to_uniform_disk_concentric(square)
    cosine, sine = math.cos(TURN), math.sin(TURN)
    return mi.Point2f(cosine * straight.x - sine * straight.y, sine * straight.x + cosine * straight.y)


def area(polygon: list[mi.Point2f]) -> mi.Float:
    """Area of a quadrangle from its corners once around."""
    a, b, c, d = polygon
    across, along = mi.Vector2f(c - a), mi.Vector2f(d - b)
    return 0.5 * dr.abs(across.x * along.y - across.y * along.x)
