"""Thresholds of the pupil form's error estimates, all in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any


def _bound(value: float, off: float) -> Any:
    """A field with this value; with `off` the rule that it belongs to has no effect."""
    return field(default=value, metadata={"off": off})


@dataclass(frozen=True)
class Estimator:
    """What is taken for the error of a pixel that nodes, transects or lattices leave, and when the next rule follows.

    Each field says which error it bounds; `scripts/audit.py --ablate` shows what happens without it. `left` is the
    error that a rule leaves on a pixel, `moved` by how much it changed the value of the rule before, the tolerance
    `rtol` times the brightest pixel; all are mean radiances on film.

    Of one, four and twelve nodes:

    point : of the tolerance. One line of sight does if the curvature of cos⁴θ over the pupil makes less of an error
    in_pixel : blur radius [pixels] up to which one line of sight does: the blur disc lies in the pixel, over which the
        picture's own curvature tells the error
    settled : of the tolerance. Where the picture bends less, twelve nodes would change it by less than a tenth of that
    passed : light of surfaces that is so many times brighter than every line of sight around was passed by
    agreed : two rules may agree by chance. `left` of twelve nodes is at least the estimate for four nodes over this
    converged, rough : `left` of twelve nodes is `moved` times 8 `moved` over the estimate for four, where each rule
        gains as much as the last one; at least `converged`, for smooth J_n, at most `rough`, for jumps

    Of transects:

    first_gain : of `moved` from nodes to the first transects, is left of a jump that they meet
    nodes_gain : of the same, is left where they meet none
    least_gain, most_gain : of `moved`, is left by later transects: `most_gain` where a level moves as much as the last
        one left, less where it moves less
    order : the error of transects falls with their number at least to this power, whatever two levels agree on
    spread, kink : of the deviation of transects across a blurred edge over their number, is left of two; of more of
        them, the trend taken off, as a kink of J_n may lie between two
    slant : of the deviation of transects across a sharp edge over their number to the power of 3/2: the edge is slanted
    corner : of the light over the number of transects squared, is in a corner of a sharp edge that none of them crosses
    step_gain : of `moved` by a step of the node rules where nothing jumps
    bumpy : of the value. Nodes that move it by more have not met a smooth J_n, and transects go on
    unsettled : times the tolerance, is stated of a jump that is met for the first time, so that another level follows
    doubt : of `left` of a neighbour counts, as its edge may reach into the pixel; all of it where an edge is sharp
    misled : times `left`. Whoever moves farther, and beyond the tolerance, had settled by chance, and so may neighbours
    unseen : of the light, may be in a blurred edge that passes between the first transects and the rim of the pupil
    sharp : blur radius [pixels] below which an edge leaves the pixel rather than the pupil
    least_jump : of the tolerance. Smaller jumps of the radiance along a transect are not looked for
    steep : a step of the radiance along a transect is a jump if it is so many times the mean of the other steps
    dim : of the brightest pixel. Less light says nothing of the edges of brighter bodies around

    Of lattices:

    certain : standard errors of the mean of 16 shifts that 999 of 1000 pixels stay within (Student's t)
    unmet : over the number of all points, share of pixel × pupil that they all pass by in one case of 1000
    """

    point: float = _bound(0.1, 1.0)
    in_pixel: float = _bound(0.5, 1.0)
    settled: float = _bound(0.25, 1.0)
    passed: float = _bound(2.0, 1e30)
    agreed: float = _bound(8.0, 1e30)
    converged: float = _bound(0.5, 0.0)
    rough: float = _bound(2.0, 1.0)
    first_gain: float = _bound(0.2, 0.0)
    nodes_gain: float = _bound(0.9, 0.0)
    least_gain: float = _bound(1.0, 0.0)
    most_gain: float = _bound(3.0, 1.0)
    order: float = _bound(1.5, 100.0)
    spread: float = _bound(2.0, 0.0)
    kink: float = _bound(6.0, 0.0)
    slant: float = _bound(2.0, 0.0)
    corner: float = _bound(1 / 8, 0.0)
    step_gain: float = _bound(2.0, 0.0)
    bumpy: float = _bound(1e-2, 1e30)
    unsettled: float = _bound(1.5, 0.0)
    doubt: float = _bound(0.5, 0.0)
    misled: float = _bound(3.0, 1e30)
    unseen: float = _bound(0.0125, 0.0)
    sharp: float = _bound(0.2, 0.0)
    least_jump: float = _bound(0.1, 0.0)
    steep: float = _bound(4.0, 1e30)
    dim: float = _bound(1e-5, 0.0)
    certain: float = _bound(4.1, 1.0)
    unmet: float = _bound(6.9, 0.0)

    def without(self, name: str) -> Estimator:
        """The same without the rule that a field belongs to."""
        off = {entry.name: entry.metadata["off"] for entry in fields(self)}
        return replace(self, **{name: off[name]})
