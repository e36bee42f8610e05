"""What the nodes of a rule see from a pixel: sums over lines of sight, each as one loop of one kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..jit.loops import repeat
from . import node_rules
from .eq9 import View

# Triangles a pixel up to which neighbouring lines of sight meet the same ones and are the faster traced together:
# nodes of pixels in a square, transects of one pixel.
NODES_TOGETHER, TRANSECTS_TOGETHER = 4.0, 0.5


@dataclass
class Sums:
    """What the nodes of a rule see from a pixel, or from each of many.

    value, x, y : integrand of Eq. 9 [W/mm²/sr], and times the place on the pupil, weighted and summed
    contrast : how far the integrand bends, see `rules.Rule`
    coverage : share of the lines of sight that meet something
    nearest, farthest : depths of what is met [mm]; inf and 0 where nothing is
    """

    value: mi.Float
    contrast: mi.Float
    x: mi.Float
    y: mi.Float
    coverage: mi.Float
    nearest: mi.Float
    farthest: mi.Float


NOTHING_SEEN = (0, 0, 0, 0, 0, math.inf, 0)


def apply_rule(view: View, centre: mi.Point2f, rule: node_rules.Rule) -> Sums:
    """What one rule sees from every pixel."""
    table = [mi.Float(column) for column in (*rule.pupil.T, *rule.pixel.T, rule.weight, rule.contrast)]
    together = view.detail <= NODES_TOGETHER

    def node(k: mi.UInt32, sums: Sums) -> tuple[Sums]:
        ax, ay, dx, dy, weight, null = (dr.gather(mi.Float, column, k) for column in table)
        f, _, body, depth = view.integrand(centre + mi.Point2f(dx, dy), mi.Point2f(ax, ay), together)
        hit = body > 0
        seen = Sums(
            value=sums.value + weight * f,
            contrast=sums.contrast + null * f,
            x=sums.x + weight * f * ax,
            y=sums.y + weight * f * ay,
            coverage=sums.coverage + dr.select(hit, weight, 0),
            nearest=dr.select(hit, dr.minimum(sums.nearest, depth), sums.nearest),
            farthest=dr.select(hit, dr.maximum(sums.farthest, depth), sums.farthest),
        )
        return (seen,)

    start = Sums(*map(mi.Float, NOTHING_SEEN))
    return repeat(dr.opaque(mi.UInt32, len(rule)), node, start)[0]
