"""Sums of the integrand over the nodes of a rule, as one loop of one kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..jit.loops import repeat
from . import node_rules
from .eq9 import View

# Triangles a pixel up to which packets of neighbouring lines of sight are traced faster than single ones: packets of
# the nodes of pixels in a square, and of the transects of one pixel.
NODES_TOGETHER, TRANSECTS_TOGETHER = 4.0, 0.5


@dataclass
class Sums:
    """Weighted sums over the nodes of a rule, for each pixel.

    value, x, y : Σ w f of the integrand f of Eq. 9 [W/mm²/sr]; Σ w f a_x and Σ w f a_y with the pupil point a
    contrast : Σ c f, a measure of the integrand's curvature, see `node_rules.Rule`
    coverage : share of the lines of sight that meet a shape with an `fspt_surface`
    nearest, farthest : depths of the surface points met, dark ones too [mm]; inf and 0 where there is none
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
    """Sums of one rule for every pixel."""
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
            coverage=sums.coverage + dr.select(view.covers(body), weight, 0),
            nearest=dr.select(hit, dr.minimum(sums.nearest, depth), sums.nearest),
            farthest=dr.select(hit, dr.maximum(sums.farthest, depth), sums.farthest),
        )
        return (seen,)

    start = Sums(*map(mi.Float, NOTHING_SEEN))
    return repeat(dr.opaque(mi.UInt32, len(rule)), node, start)[0]
