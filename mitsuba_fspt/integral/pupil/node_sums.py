"""Sums of the integrand of Eq. M.5 over the nodes of a rule, as one loop of one kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...jit.loops import repeat
from ...jit.tables import Table
from ..lines.courses import first_met
from ..lines.eq9 import Sight, View
from . import node_rules

# Triangles a pixel up to which packets of neighbouring lines of sight are traced faster than single ones: of a node on
# neighbouring pixels, and of the transects of one pixel.
NODES_TOGETHER, TRANSECTS_TOGETHER = 4.0, 2.0


@dataclass
class Sums:
    """Weighted sums over the nodes of a rule, for each pixel.

    value, x, y : Σ w f of the integrand f of Eq. 9 [W/mm²/sr]; Σ w f a_x and Σ w f a_y with the pupil point a
    contrast : Σ c f, a measure of the integrand's curvature, see `node_rules.Rule` [W/mm²/sr]
    coverage : share of the lines of sight that meet a shape with an `fspt_surface`
    nearest, farthest : depths of the surfaces at which lines of sight end, dark ones too [mm]; inf and 0 without one
    lost : Σ w cos⁴θ times the share of the light that is not followed through or off specular surfaces
    front : least depth of an edge, those of mirrors and panes included [mm]
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


# `Sums` of lines of sight that meet nothing; also the values of columns that are not computed.
NOTHING_SEEN = dict(zip(Sums.__annotations__, (0, 0, 0, 0, 0, math.inf, 0, 0, math.inf), strict=True))
ALL = tuple(NOTHING_SEEN)


def apply_rule(view: View, centre: mi.Point2f, rule: node_rules.Rule, names: Sequence[str] = ALL) -> Sums:
    """Sums of one rule for every pixel, in the columns `names`; the others are `NOTHING_SEEN`."""
    table = Table(rule.columns)
    together = view.detail <= NODES_TOGETHER

    # Only sums that change are states of the loop; with others Dr.Jit would record its body twice.
    def node(k: mi.UInt32, sums: dict[str, mi.Float], first: _FirstSurfaces | None) -> tuple:
        pixel, pupil = (mi.Point2f(*(table.gather(f"{of}_{axis}", k) for axis in "xy")) for of in ("pixel", "pupil"))
        weight, contrast = table.gather("weight", k), table.gather("contrast", k)
        sight = view.integrand(centre + pixel, pupil, together)
        f, hit = sight.integrand, dr.isfinite(sight.depth)
        more = {
            "value": lambda total: total + weight * f,
            "contrast": lambda total: total + contrast * f,
            "x": lambda total: total + weight * f * pupil.x,
            "y": lambda total: total + weight * f * pupil.y,
            "coverage": lambda total: total + dr.select(sight.covered, weight, 0),
            "nearest": lambda least: dr.select(hit, dr.minimum(least, sight.depth), least),
            "farthest": lambda most: dr.select(hit, dr.maximum(most, sight.depth), most),
            "lost": lambda total: total + weight * sight.lost,
        }
        seen = {name: more[name](before) for name, before in sums.items()}
        return seen, first and first.plus(sight)

    follow_first = view.specular and "front" in names
    first = _FirstSurfaces(mi.Float(-1), mi.Float(math.inf), mi.Bool(False)) if follow_first else None
    summed = [name for name in names if name != "front" and (view.specular or name != "lost")]
    sums, first = repeat(table.rows, node, {name: mi.Float(NOTHING_SEEN[name]) for name in summed}, first)
    found = Sums(**{name: sums.get(name, mi.Float(nothing)) for name, nothing in NOTHING_SEEN.items()})
    found.front = first.front(found.nearest) if first else found.nearest
    return found


@dataclass
class _FirstSurfaces:
    """First surfaces on the lines of sight: number of that on the last line, least depth [mm], whether they differ.

    Where they do not differ there is no edge of a mirror or a pane.
    """

    number: mi.Float
    depth: mi.Float
    differ: mi.Bool

    def plus(self, sight: Sight) -> _FirstSurfaces:
        """With one more line of sight."""
        number = mi.Float(first_met(sight.body))
        differ = self.differ | ((self.number >= 0) & (self.number != number))
        return _FirstSurfaces(number, dr.minimum(self.depth, sight.front), differ)

    def front(self, nearest: mi.Float) -> mi.Float:
        """Least depth of an edge [mm]: of the first surfaces if they differ, else the `nearest` at the end."""
        return dr.select(self.differ, self.depth, nearest)
