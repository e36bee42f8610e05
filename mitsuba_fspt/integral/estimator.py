"""Thresholds of the error estimates of the pupil form (Eq. M.5), all in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any


def _bound(value: float, off: float) -> Any:
    """A field with this value; with the value `off` its rule has no effect."""
    return field(default=value, metadata={"off": off})


@dataclass(frozen=True)
class Estimator:
    """Error estimates of nodes, transects and lattices, and stopping criteria between these rules.

    Each field names the error that it bounds; `scripts/audit.py --ablate` measures the effect of each. Below,
    *remaining error* is the estimated error of a pixel after a rule, *change* the difference between its values by this
    rule and the one before, *tolerance* `rtol` times the brightest pixel; all are mean radiances on film.

    Of one, four and twelve nodes:

    falloff : of rtol. One line of sight a pixel suffices if cos⁴θ varies by less over the pupil
    in_pixel : blur radius [pixels] up to which one line of sight suffices: the curvature of the image, from which its
        error follows, is that over a pixel
    missed_body : ratio of the light that surfaces send to a pixel to that of the lines of sight around, above which
        four nodes replace one: a body 0.9 to 1.4 pixels wide may lie between single lines
    largest_gain : largest factor by which twelve nodes reduce the estimate for four, as both may agree by chance on a
        rough texture

    Of transects:

    first_ratio : remaining error over the change from nodes to the first transects, where these cross a jump
    nodes_ratio : the same, where they cross none, as of a dim spot far below a pixel, or of the
        edges of a coarse mesh
    least_ratio, most_ratio : remaining error over the change by later transects: `most_ratio` if the change is as large
        as the error before, less if it is smaller
    order : least power by which the error of transects falls with their number
    several_order : the same where edges are sharp and several on a transect, as a corner may lie between two transects
    several_share : least share of the transects that cross several edges there. If it is smaller, as where a smooth
        outline touches a transect, their order adds less than an eighth to the error
    spread, kink : remaining error of two transects over the deviation between them and their number; of more, over the
        deviation without its trend, as J_n may have a kink between two
    slant : the same of transects across a sharp edge, over their number to the power 3/2: the edge is slanted
    second_edge : error of a second edge between two transects across a sharp edge, over √2 times the jump between their
        means and their number: at most 0.35. Where such an edge is nearly along many transects of a net, at most the
        largest second difference of their means over their number counts
    step_ratio : remaining error over the change from one node rule to the next where no transect crosses a jump
    new_jump : remaining error over the tolerance where a jump is crossed for the first time, so that a level follows
    neighbour_share : share of a neighbour's remaining error that counts, as its edge may reach into the pixel; all of
        it where an edge is sharp
    unexpected : change over the remaining error before above which that error was too small, also on neighbours
    missed_edge : share of the light in a blurred edge between the first transects and the rim of the pupil
    sharp : blur radius [pixels] below which transects are placed in the pixel instead of the pupil
    least_jump : of the tolerance. Smaller steps of the radiance along a transect are no jumps
    steep : a step of the radiance along a transect is a jump if it is so many times the mean of the other steps
    faint : of the brightest pixel. With less light a jump shows nothing of a brighter body around, as beside the rim of
        blurred occluders at f/0.95

    Of lattices:

    student_t : error over the standard error of the mean of 16 shifts: exceeded with probability 1/1000 (Student's t)
    missed_share : share of pixel × pupil, times the number of points, that all points miss with probability 1/1000
    """

    falloff: float = _bound(0.1, 1.0)
    in_pixel: float = _bound(0.5, 1.0)
    missed_body: float = _bound(2.0, 1e30)
    largest_gain: float = _bound(8.0, 1e30)
    first_ratio: float = _bound(0.2, 0.0)
    nodes_ratio: float = _bound(0.9, 0.0)
    least_ratio: float = _bound(1.0, 0.0)
    most_ratio: float = _bound(3.0, 1.0)
    order: float = _bound(1.5, 100.0)
    several_order: float = _bound(1.0, 1.5)
    several_share: float = _bound(1 / 16, 0.0)
    spread: float = _bound(2.0, 0.0)
    kink: float = _bound(6.0, 0.0)
    slant: float = _bound(2.0, 0.0)
    second_edge: float = _bound(0.5, 0.0)
    step_ratio: float = _bound(2.0, 0.0)
    new_jump: float = _bound(1.5, 0.0)
    neighbour_share: float = _bound(0.5, 0.0)
    unexpected: float = _bound(3.0, 1e30)
    missed_edge: float = _bound(0.0125, 0.0)
    sharp: float = _bound(0.2, 0.0)
    least_jump: float = _bound(0.1, 0.0)
    steep: float = _bound(4.0, 1e30)
    faint: float = _bound(1e-5, 0.0)
    student_t: float = _bound(4.1, 1.0)
    missed_share: float = _bound(6.9, 0.0)

    def without(self, name: str) -> Estimator:
        """A copy in which the rule of one field has no effect."""
        off = {entry.name: entry.metadata["off"] for entry in fields(self)}
        return replace(self, **{name: off[name]})
