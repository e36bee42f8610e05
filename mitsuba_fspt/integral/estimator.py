"""Thresholds of the error estimates of the pupil form (Eq. M.5), all in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

Rules = TypeVar("Rules", bound="Thresholds")


def bound(value: float, off: float) -> Any:
    """A field with this value; with the value `off` its rule has no effect."""
    return field(default=value, metadata={"off": off})


class Thresholds:
    """A frozen dataclass whose fields are `bound`."""

    def without(self: Rules, *names: str) -> Rules:
        """A copy in which the rules of some fields have no effect."""
        off = {entry.name: entry.metadata["off"] for entry in fields(self)}  # type: ignore[arg-type]
        return replace(self, **{name: off[name] for name in names})  # type: ignore[type-var]


@dataclass(frozen=True)
class Estimator(Thresholds):
    """Error estimates of transects and criteria that end them.

    Each field names the error that it bounds; `scripts/audit.py --ablate` measures the effect of each. Below,
    *remaining error* is the estimated error of a pixel after a rule, *change* the difference between its values by this
    rule and the one before, *tolerance* `rtol` times the brightest pixel; all are mean radiances on film.

    first_ratio : remaining error over the change from nodes to the first transects, where these cross a jump
    nodes_ratio : the same, where they cross none, as of a dim spot far below a pixel, or of the edges of a coarse mesh;
        below 1, as they contradict the nodes
    order : least power by which the error of transects falls with their number; two thirds of it at corners
    scatter : remaining error of transects across a blurred edge over the deviation between them, without its trend, and
        their number: J_n may have a kink between two. A third of it for two transects, which have no trend, three
        times as much for the net of the last level
    slant : the same of transects across a sharp edge, over their number to the power 3/2: the edge is slanted
    neighbour_share : share of a neighbour's remaining error that counts, as its edge may reach into the pixel; all of
        it where an edge is sharp
    unexpected : change over the remaining error before above which that error was too small, also on neighbours
    sharp : blur radius [pixels] below which transects are placed in the pixel instead of the pupil
    steep : a step of the radiance along a transect is a jump if it is so many times the mean of the other steps
    """

    first_ratio: float = bound(0.2, 0.0)
    nodes_ratio: float = bound(0.9, 0.0)
    order: float = bound(1.5, 100.0)
    scatter: float = bound(6.0, 0.0)
    slant: float = bound(2.0, 0.0)
    neighbour_share: float = bound(0.5, 0.0)
    unexpected: float = bound(3.0, 1e30)
    sharp: float = bound(0.2, 0.0)
    steep: float = bound(4.0, 1e30)
