"""Random points of triangles that the edge of a shadow crosses."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")

POINTS = 1 << 16


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize(
    ("along", "beyond"),
    [((0.8, 0.5), 0.0), ((0.8, 0.5), 0.3), ((0.8, 0.5), -0.3), ((0.06, 0.06), -0.4), ((0.5, 0.05), -0.5)],
)
def test_random_points_lie_in_the_part_as_often_as_its_area_says(along, beyond, lit):
    """The corner's area over that of the triangle: a₂a₃ below the chord, and 4/3 of it times the height beyond."""
    import mitsuba as mi

    from mitsuba_fspt.integral.surface.lit_part import LitPart

    number = np.arange(POINTS)
    golden = (np.sqrt(5) - 1) / 2
    at = mi.warp.square_to_uniform_triangle(mi.Point2f((number + 0.5) / POINTS, number * golden % 1))
    ends = [mi.Point3f(*end) for end in ((1, 2, 3), (4, 2, 1), (0, 5, 2))]
    point = ends[0] + at.x * (ends[1] - ends[0]) + at.y * (ends[2] - ends[0])
    edge = LitPart(mi.Bool(True), mi.Bool(False), *ends, mi.Bool(lit), mi.Point2f(*along), mi.Float(beyond))
    inside = edge.contains(point)
    corner = along[0] * along[1] * (1 + 4 / 3 * beyond)
    assert np.mean(inside.numpy()) == pytest.approx(corner if lit else 1 - corner, abs=2e-3)
