"""Node rules of the pupil form (Eq. M.5): where lines of sight cross pupil and pixel, and their weights.

A rule integrates over the unit disc (pupil) times the square [-½, ½]² (pixel), both with measure 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.polynomial import Legendre
from numpy.typing import NDArray

from ...camera.window import SEARCHED_RIM

GOLDEN = 0.6180339887498949
PLASTIC = (0.7548776662466927, 0.5698402909980532)  # steps of the R₂ sequence, even in the unit square

# Width [blur radii] of the gap between the outermost nodes of a rule, or the first transects, and the rim of the pupil,
# in which a silhouette changes none of the lines of sight.
GAP = {1: 1.0, 4: SEARCHED_RIM, 12: 0.25, "transects": 0.1}

PixelArray = Any  # an array of numbers on the pixel grid, NumPy's or Dr.Jit's


@dataclass(frozen=True)
class Rule:
    """Nodes of disc × square: `pupil` (n, 2) in the unit disc, `pixel` (n, 2) in [-½, ½]², `weight` (n,) of sum 1.

    `contrast` (n,) has sum 0 and vanishes on linear functions: |Σ contrast f| measures the curvature of f.
    """

    pupil: NDArray[np.float64]
    pixel: NDArray[np.float64]
    weight: NDArray[np.float64]
    contrast: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Coordinates, weight and contrast of all nodes by name, (n,) each."""
        places = dict(zip(("pupil_x", "pupil_y", "pixel_x", "pixel_y"), (*self.pupil.T, *self.pixel.T), strict=True))
        return places | {"weight": self.weight, "contrast": self.contrast}


@cache
def one() -> Rule:
    """The one line of sight through the middle of pupil and pixel, exact to degree 1."""
    return Rule(np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1), np.zeros(1))


@cache
def four(area: bool) -> Rule:
    """Four nodes, exact to degree 3 on the pupil; with `area` also over the pixel, for functions of p - r a.

    Over the pixel each node takes a step of length 1/√6 at right angles to its place on the pupil: so the second
    moments of any sum of pupil and pixel offset, whatever the blur, are those of disc and square.
    """
    angle = np.pi / 4 + np.arange(4) * np.pi / 2
    step = np.sqrt(1 / 6) if area else 0.0
    contrast = np.array([0.5, -0.5, 0.5, -0.5])
    return Rule(_polar(np.sqrt(0.5), angle), _polar(step, angle + np.pi / 2), np.full(4, 0.25), contrast)


def one_spread(laplacian: PixelArray, blur: PixelArray, area: bool) -> PixelArray:
    """Correction of `one`: half the second moments of pixel and blur disc along each axis, 1/12 and r²/4.

    `laplacian` of the image [1/pixels²], `blur` r [pixels].
    """
    return (float(area) / 24 + blur**2 / 8) * laplacian


def four_turn(curl: PixelArray, laplacian: PixelArray) -> PixelArray:
    """Error of `four` where the blur varies over the image; `curl` is ∂M_x/∂y - ∂M_y/∂x of its moments.

    Steps at right angles leave c (∂²f/∂a_x∂y - ∂²f/∂a_y∂x), c = Σ w a_x y = √3/12, of pupil a and pixel (x, y). The
    moments over the pupil are M = ¼ ∂f/∂a + c (∂f/∂y, -∂f/∂x), so that their curl over the image contains it.
    """
    c = math.sqrt(3) / 12
    return 4 * c * (curl - c * laplacian)


@cache
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


@cache
def product(level: int, area: bool) -> Rule:
    """Rings × spokes over the pupil, with `area` times Gauss nodes over the pixel: for smooth integrands."""
    rings, spokes, side = (level + 1, 4 * level + 3, level + 1) if area else (2 * level + 1, 8 * level + 1, 1)
    square, ring_weight = gauss(rings)
    turn = 2 * np.pi * (np.arange(spokes) + GOLDEN * np.arange(rings)[:, None]) / spokes
    pupil = _polar(np.sqrt(square)[:, None], turn).reshape(-1, 2)
    x, w = gauss(side)
    pixel = np.stack(np.meshgrid(x - 0.5, x - 0.5), axis=-1).reshape(-1, 2)
    weight = np.outer(np.repeat(ring_weight / spokes, spokes), np.outer(w, w)).ravel()
    pupil, pixel = np.repeat(pupil, len(pixel), axis=0), np.tile(pixel, (len(pupil), 1))
    return Rule(pupil, pixel, weight, np.zeros(len(weight)))


SMOOTH_LEVELS = 3  # levels of transects at which pixels without a jump take a `product` rule
TRANSECT_LEVELS = (2, 8, 24, 72, 256, 1024)
# Positions across the pupil at each level but the last. With a second edge the mean along a transect has kinks in this
# coordinate, and is nearly linear in the other two.
ACROSS = (2, 4, 6, 8, 16)
# Directions of the other two coordinates from the middle, at each position across the pupil [degrees]. Levels with
# equal coordinates would miss the same bodies, such as a plate edge-on through the virtual detector plane.
TURNS = {2: [[45], [225]], 8: [[30, 210], [120, 300]] * 2, 24: [[0, 90, 180, 270]] * 6}
# Of 122 pixels of meshes with 1,024 transects 13 % are wrong by more than 6 deviations over 1,024, 1 % by more than 18
# (the largest 27).
NET_SCATTER = 3.0
LEAST_NET = 256  # transects from which those across a sharp edge are a net
# Generating vectors of the lattices of transects across a sharp edge: those of least centred discrepancy.
STEPS = {2: (1, 1), 8: (3, 5), 24: (5, 11), 72: (19, 61)}
TREND = 3  # degree across the pupil of the trend that is subtracted from the scatter
TRENDS = TREND + 2  # polynomials of the trend
SCANS = (4, 6, 10, 16, 24, 32)  # intervals of the scan at each level; of two edges of one body in one none is found
LEAST_PARTS = 32  # of an interval of the first scan, to which bisection resolves a jump at any rtol
MOST_JUMPS = 3  # jumps at which a transect is split: one body before another has three outlines


@dataclass(frozen=True)
class AlongTransect:
    """Accuracy along a transect: `scan` intervals, `bisections` of a jump, `nodes` on a smooth piece."""

    scan: int
    bisections: int
    nodes: int

    @property
    def rays(self) -> int:
        """Largest number of lines of sight: all jumps bisected, no piece dark."""
        return self.scan + 1 + MOST_JUMPS * self.bisections + (MOST_JUMPS + 1) * self.nodes


def along_transect(level: int, rtol: float) -> AlongTransect:
    """Accuracy along the transects of a level: a jump's position to `rtol`, and to 1/64 of an interval in any case.

    On a sphere's limb that halves the RMS error of two transects at rtol 0.03, for 3 % more lines of sight. The
    accuracy grows with the level, as levels with the same error along their transects would agree on it.
    """
    bisections = math.ceil(math.log2(max(0.25 / rtol, LEAST_PARTS)))
    nodes = 3 + math.ceil(math.log10(max(1e-3 / rtol, 1)))
    return AlongTransect(scan=SCANS[level], bisections=bisections + level, nodes=nodes + level)


def transect_levels(rtol: float, area: bool, most: int) -> list[tuple[int, AlongTransect]]:
    """Number of transects and accuracy along each, level by level, while all levels together take no more than `most`
    lines of sight a pixel.
    """
    levels = []
    for level, count in enumerate(TRANSECT_LEVELS):
        along = along_transect(level, rtol)
        most -= count * along.rays + (len(product(level, area)) if 0 < level <= SMOOTH_LEVELS else 0)
        if most < 0:
            break
        levels.append((count, along))
    return levels


@dataclass(frozen=True)
class Transects:
    """Positions in [0, 1]³ of n transects through pixel × pupil, (n, 3), for sharp edges and for blurred ones.

    `sharp` fill the pixel evenly, no two on one line, as the mean has kinks where an edge leaves the pixel; weight 1/n.
    `blurred` have the `weight` (n,) of sum 1, and `trend` (k, n) are orthonormal polynomials on them (on a net nearly)
    of mean 0. `phase` (n,) in [0, 1) shifts the even nodes along each transect: with equal phases all transects would
    have the same error.
    """

    sharp: NDArray[np.float64]
    blurred: NDArray[np.float64]
    weight: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def is_net(self) -> bool:
        """Whether `sharp` is a net: every box of its size holds one transect."""
        return len(self) >= LEAST_NET

    @property
    def relative_scatter(self) -> float:
        """Error across a blurred edge for a given deviation over n, over that of Gauss's nodes: two have no trend, on a
        net the error of a kink falls more slowly."""
        if len(self) == 2:
            return 1 / 3
        return 1.0 if len(self) <= TRANSECT_LEVELS[len(ACROSS) - 1] else NET_SCATTER

    @property
    def phase(self) -> NDArray[np.float64]:
        """Evenly distributed over any successive transects (golden ratio).

        Opposite for two transects, so that the odd part of the integrand about the middle of a piece cancels.
        """
        phase = np.mod(GOLDEN * (np.arange(len(self)) + 0.5), 1.0)
        return phase if len(self) > 2 else np.array([phase[0], 1 - phase[0]])

    @cached_property
    def trend(self) -> NDArray[np.float64]:
        """Legendre's, up to degree `TREND` across the pupil, linear along the other two coordinates; none on two."""
        if len(self) == 2:
            return np.empty((0, 2))
        along, across, pixel = 2 * self.blurred.T - 1
        legendre = [math.sqrt(2 * k + 1) * Legendre.basis(k)(across) for k in range(1, TREND + 1)]
        return np.stack([*legendre, math.sqrt(3) * along, math.sqrt(3) * pixel])

    @property
    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Coordinates `sharp0` … 2, `blurred0` … 2, `weight`, `phase` and trends `trend0` …, 0 on two; (n,) each."""
        trend = self.trend if len(self.trend) else np.zeros((TRENDS, len(self)))
        several = {"sharp": self.sharp.T, "blurred": self.blurred.T, "trend": trend}
        named = {f"{name}{k}": column for name, columns in several.items() for k, column in enumerate(columns)}
        return named | {"weight": self.weight, "phase": self.phase}


@cache
def transects(count: int) -> Transects:
    """The transects of a level of `TRANSECT_LEVELS`, by their number: at Gauss's nodes, at the last level a net."""
    level = TRANSECT_LEVELS.index(count)
    if level == len(ACROSS):
        return Transects(_net(count), _net(count), np.full(count, 1 / count))
    blurred, weight = _across_the_pupil(count, ACROSS[level])
    if count >= LEAST_NET:
        return Transects(_net(count), blurred, weight)
    return Transects(_lattice(count, *STEPS[count]), blurred, weight)


def _across_the_pupil(count: int, across: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes (n, 3) and weights (n,): Gauss's `across` the pupil, with n/across on the other two axes at each of them.

    These are Gauss's, too, or on a circle: corners of a square, exact to degree 3 for any direction; two opposite ones,
    exact to degree 2 over all nodes; one, exact to degree 1.
    """
    y, w = gauss(across)
    each = count // across
    if count in TURNS:
        others, share = 0.5 + _polar(math.sqrt(1 / 6), np.radians(TURNS[count])), np.full(each, 1 / each)
    else:
        x, v = gauss(math.isqrt(each))
        square = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
        others, share = np.broadcast_to(square, (across, each, 2)), np.outer(v, v).ravel()
    return np.insert(others.reshape(-1, 2), 1, np.repeat(y, each), axis=1), np.outer(w, share).ravel()


def _lattice(count: int, *steps: int) -> NDArray[np.float64]:
    """Rank-1 lattice in [0, 1]³, the last coordinate in order; symmetric about the middle, so that odd parts cancel."""
    return np.mod(np.outer(np.arange(count) + 0.5, (*steps, 1)) / count, 1.0)


def _net(count: int) -> NDArray[np.float64]:
    """(0, m, 3)-net of count = 2^m points: one in every box of 2^-m whose sides are powers of ½ (Niederreiter 1987)."""
    number = np.arange(count)
    bits = [(number >> j) & 1 for j in range(count.bit_length() - 1)]
    mirrored, sobol, column = np.zeros_like(number), np.zeros_like(number), count >> 1
    for j, bit in enumerate(bits):
        mirrored ^= bit * (count >> (j + 1))
        sobol ^= bit * column
        column ^= column >> 1
    return (np.stack([mirrored, sobol, number], axis=-1) + 0.5) / count


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
