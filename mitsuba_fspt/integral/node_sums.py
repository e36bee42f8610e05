"""Sums of the integrand over the nodes of a rule, as one loop of one kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..jit.loops import repeat
from . import node_rules
from .eq9 import Sight, View
from .specular import first_met

# Triangles a pixel up to which packets of neighbouring lines of sight are traced faster than single ones: packets of
# the nodes of pixels in a square, and of the transects of one pixel.
NODES_TOGETHER, TRANSECTS_TOGETHER = 4.0, 0.5


@dataclass
class Sums:
    """Weighted sums over the nodes of a rule, for each pixel.

    value, x, y : Σ w f of the integrand f of Eq. 9 [W/mm²/sr]; Σ w f a_x and Σ w f a_y with the pupil point a
    contrast : Σ c f, a measure of the integrand's curvature, see `node_rules.Rule`
    coverage : share of the lines of sight that meet a shape with an `fspt_surface`
    nearest, farthest : depths at which lines of sight end on surfaces, dark ones too [mm]; inf and 0 where none does
    lost : Σ w cos⁴θ of what is not followed through or off specular surfaces
    front : depth of the nearest edge that there may be, of mirrors and panes too [mm]
    """

    value: mi.Float
    contrast: mi.Float
    x: mi.Float
    y: mi.Float
    coverage: mi.Float
    nearest: mi.Float
    farthest: mi.Float
    lost: mi.Float
    front: mi.Float


NOTHING_SEEN = (0, 0, 0, 0, 0, math.inf, 0, 0, math.inf)
BY_SPECULAR_SURFACES = ("lost", "front")  # sums that are known already where there is none


def apply_rule(view: View, centre: mi.Point2f, rule: node_rules.Rule) -> Sums:
    """Sums of one rule for every pixel."""
    table = [mi.Float(column) for column in (*rule.pupil.T, *rule.pixel.T, rule.weight, rule.contrast)]
    together = view.detail <= NODES_TOGETHER

    def node(k: mi.UInt32, sums: Sums, first: _FirstSurfaces | None) -> tuple:
        ax, ay, dx, dy, weight, null = (dr.gather(mi.Float, column, k) for column in table)
        sight = view.integrand(centre + mi.Point2f(dx, dy), mi.Point2f(ax, ay), together)
        f, hit = sight.integrand, dr.isfinite(sight.depth)
        seen = Sums(
            value=sums.value + weight * f,
            contrast=sums.contrast + null * f,
            x=sums.x + weight * f * ax,
            y=sums.y + weight * f * ay,
            coverage=sums.coverage + dr.select(sight.covered, weight, 0),
            nearest=dr.select(hit, dr.minimum(sums.nearest, sight.depth), sums.nearest),
            farthest=dr.select(hit, dr.maximum(sums.farthest, sight.depth), sums.farthest),
            lost=sums.lost + weight * sight.lost,
            front=sums.front,
        )
        return seen, first and first.plus(sight)

    first = _FirstSurfaces(mi.Float(-1), mi.Float(math.inf), mi.Bool(False)) if view.specular else None
    sums, first = repeat(dr.opaque(mi.UInt32, len(rule)), node, Sums(*map(mi.Float, NOTHING_SEEN)), first)
    sums.front = first.front(sums.nearest) if first else sums.nearest
    return sums


@dataclass
class _FirstSurfaces:
    """Of the first surfaces on lines of sight: number of that of the last line, least depth [mm], whether they differ.

    Only where they differ does an edge of a mirror or a pane lie.
    """

    number: mi.Float
    depth: mi.Float
    differ: mi.Bool

    def plus(self, sight: Sight) -> _FirstSurfaces:
        """With one line more."""
        number = mi.Float(first_met(sight.body))
        differ = self.differ | ((self.number >= 0) & (self.number != number))
        return _FirstSurfaces(number, dr.minimum(self.depth, sight.front), differ)

    def front(self, nearest: mi.Float) -> mi.Float:
        """Depth of the nearest edge that there may be [mm]: that of what is `nearest` without those before it."""
        return dr.select(self.differ, self.depth, nearest)
