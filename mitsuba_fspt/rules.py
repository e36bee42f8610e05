"""Node rules of the pupil form: where lines of sight cross pupil and pixel, and their weights.

A rule integrates over the unit disc (pupil) times the square [-½, ½]² (pixel), both with measure 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = Any  # an array of numbers on the pixel grid, NumPy's or Dr.Jit's


@dataclass(frozen=True)
class Rule:
    """Nodes of disc × square: `pupil` (n, 2) in the unit disc, `pixel` (n, 2) in [-½, ½]², `weight` (n,) of sum 1.

    `contrast` (n,) has sum 0 and vanishes on linear functions: |Σ contrast f| measures how far f bends.
    """

    pupil: NDArray[np.float64]
    pixel: NDArray[np.float64]
    weight: NDArray[np.float64]
    contrast: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.weight)


def one() -> Rule:
    """The one line of sight through the middle of pupil and pixel, exact to degree 1."""
    return Rule(np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1), np.zeros(1))


def four(area: bool) -> Rule:
    """Four nodes, exact to degree 3 on the pupil; with `area` also over the pixel, for what blurs like a picture.

    Over the pixel each node takes a step of length 1/√6 at right angles to its place on the pupil: so the second
    moments of any sum of pupil and pixel offset, whatever the blur, are those of disc and square.
    """
    angle = np.pi / 4 + np.arange(4) * np.pi / 2
    step = np.sqrt(1 / 6) if area else 0.0
    contrast = np.array([0.5, -0.5, 0.5, -0.5])
    return Rule(_polar(np.sqrt(0.5), angle), _polar(step, angle + np.pi / 2), np.full(4, 0.25), contrast)


def one_spread(laplacian: Image, blur: Image, area: bool) -> Image:
    """What `one` has too little: half the second moments of pixel and blur disc along each axis, 1/12 and r²/4.

    `laplacian` of the picture [1/pixels²], `blur` r [pixels].
    """
    return (float(area) / 24 + blur**2 / 8) * laplacian


def four_turn(curl: Image, laplacian: Image) -> Image:
    """What `four` has too much where the blur changes over the picture; `curl` is ∂M_x/∂y - ∂M_y/∂x of its moments.

    Steps at right angles leave c (∂²f/∂a_x∂y - ∂²f/∂a_y∂x), c = Σ w a_x y = √3/12, of pupil a and pixel (x, y). The
    moments over the pupil are M = ¼ ∂f/∂a + c (∂f/∂y, -∂f/∂x), so that their curl over the picture holds it.
    """
    c = math.sqrt(3) / 12
    return 4 * c * (curl - c * laplacian)


def twelve(area: bool) -> Rule:
    """Twelve nodes, exact to degree 7 on the pupil (Hammer and Stroud 1958); with `area` to degree 3 jointly.

    Over the pixel each node takes a step of length 1/√6 that turns along with the node, so that the second moments
    of the square come out right; three ring angles that close a triangle leave no pupil-pixel correlation.
    """
    root = np.sqrt(29.0)
    radius = np.array([np.sqrt(3 / 4), np.sqrt((27 - 3 * root) / 52), np.sqrt((27 + 3 * root) / 52)])
    weight = np.array([2 / 27, (551 + 41 * root) / 6264, (551 - 41 * root) / 6264])
    start = np.array([0.0, np.pi / 4, np.pi / 4])
    angle = start[:, None] + np.arange(4) * np.pi / 2
    step = np.sqrt(1 / 6) if area else 0.0
    turn = _closed_triangle(weight * radius)
    pupil = _polar(radius[:, None], angle).reshape(-1, 2)
    pixel = _polar(step, angle + turn[:, None]).reshape(-1, 2)
    weights = np.repeat(weight, 4)
    # Inner ring against the outer two: Σ c = 0 and, by symmetry, no linear part.
    contrast = weights * np.repeat([1.0, -1.0, 1.0], 4)
    contrast[4:8] *= (weight[0] + weight[2]) / weight[1]
    return Rule(pupil, pixel, weights, contrast)


# Chords a level: m across the pupil times q × q points of the pixel. Found on straight edges of every blur and angle:
# these balance the error of the two, which falls like (chords)^-1.2.
CHORD_LEVELS = ((4, 1), (4, 2), (8, 2), (8, 3), (16, 3), (16, 4), (24, 5), (32, 6), (48, 8), (64, 11))
CHORD_ORDER = 1.2


@dataclass(frozen=True)
class AlongChord:
    """How far a chord is looked into: `scan` intervals, `bisections` of a jump, `gauss` nodes a smooth piece."""

    scan: int
    bisections: int
    gauss: int

    @property
    def rays(self) -> int:
        """Lines of sight at most: both jumps bisected, three pieces lit."""
        return self.scan + 1 + 2 * self.bisections + 3 * self.gauss


def along_chord(level: int) -> AlongChord:
    """Every level looks further along its chords too, or what all levels miss there would pass for converged."""
    return AlongChord(scan=4 + level, bisections=4 + level, gauss=3 + level)


GOLDEN = 0.6180339887498949
PLASTIC = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class Chords:
    """Chords of disc × square, n of each kind, every array with the weights or measure 1 in all.

    Across the pupil: `across` (n,) in (0, 1) numbers the chord, `pixel` (n, 2) in [-½, ½]² is its pixel point, with
    `weight` (n,). Across the pixel: `side` (n,) in [-½, ½] numbers the chord, `pupil` (n, 2) in the unit disc is its
    pupil point, all with weight 1/n.
    """

    across: NDArray[np.float64]
    pixel: NDArray[np.float64]
    weight: NDArray[np.float64]
    side: NDArray[np.float64]
    pupil: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.weight)


@cache
def chords(m: int, q: int, area: bool = True) -> Chords:
    """m · q² chords: across the pupil m equidistant ones for each of q × q Gauss points, shifted from point to point.

    Without `area` all belong to the pixel's centre; four chords share 2 × 2 points, such that one as far on the other
    side of the middle has the opposite point. Across the pixel they are equidistant, and their pupil points fill the
    disc evenly, whatever run of them is taken (R₂ sequence, folded in the radius: so it has no seam there).
    """
    if not area:
        m, q = m * q * q, 1
    x, w = gauss(q)
    px, py = (grid.ravel() for grid in np.meshgrid(x - 0.5, x - 0.5))
    shift = np.mod(0.5 + GOLDEN * np.arange(q * q), 1.0)
    across = (np.arange(m)[:, None] + shift) / m
    pixel = np.broadcast_to(np.stack([px, py], axis=-1), (m, q * q, 2))
    if area and (m, q) == (4, 1):
        pixel = np.sqrt(1 / 12) * np.array([[[1, 1]], [[1, -1]], [[-1, 1]], [[-1, -1]]])
    weight = np.broadcast_to(np.outer(w, w).ravel() / m, (m, q * q))
    number = np.arange(m * q * q) + 0.5
    square, turn = np.mod(np.outer(PLASTIC, number), 1.0)
    return Chords(
        across=across.ravel(),
        pixel=pixel.reshape(-1, 2),
        weight=weight.ravel(),
        side=number / len(number) - 0.5,
        pupil=_polar(np.sqrt(1 - np.abs(2 * square - 1)), 2 * np.pi * turn),
    )


@cache
def gauss(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gauss–Legendre nodes in [0, 1] and weights of sum 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def _polar(radius: NDArray[np.float64] | float, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _closed_triangle(sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions of three sides of given lengths that add up to zero."""
    a, b, c = sides
    beta = np.pi - np.arccos((a * a + b * b - c * c) / (2 * a * b))
    rest = a + b * np.exp(1j * beta)
    return np.array([0.0, beta, np.angle(-rest)])
