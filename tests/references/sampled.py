"""Eq. 9 in float64 NumPy by brute force, sampled over pixel × pupil or over pixel × surface.

Frame and lengths are those of `camera`; exitance J_n in W/mm², results in W on each pixel, shape (height, width),
row 0 at the top. `meshes` has the same integral over triangle meshes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .camera import ReferenceCamera
from .shapes import Array, Shape, dot, unit_disc

Pixel = Literal["area", "centre"]
Exitance = Callable[[Array, int], Array]  # (points (n, 3) of shape number i, i) -> (n,) [W/mm²]
BLOCK = 2_000_000  # lines of sight at a time: limits the memory to about half a gigabyte
# Two independent shifts of a lattice, away from its points of symmetry, where the fold would map nodes onto each other.
SHIFT, OTHER_SHIFT = (0.137, 0.419, 0.683, 0.911), (0.271, 0.833, 0.059, 0.547)


@dataclass(frozen=True)
class Rule:
    """Nodes of an average over pixel × pupil.

    Parameters
    ----------
    offset : (n, 2) from the pixel's centre, in sides of a pixel
    pupil : (n, 2) in the unit disc
    weight : (n,) with sum 1
    """

    offset: Array
    pupil: Array
    weight: Array


def gauss_rule(n: int, pixel: Pixel = "area") -> Rule:
    """Product rule, which converges exponentially if the integrand is smooth over pixel and pupil.

    It has n Gauss nodes along each side of the pixel and in the squared radius of the pupil, and 2n + 1 equal steps in
    the pupil's angle.
    """
    node, weight = np.polynomial.legendre.leggauss(n)
    node, weight = node / 2, weight / 2
    side, share = (node, weight) if pixel == "area" else (np.zeros(1), np.ones(1))
    angle = 2 * np.pi * np.arange(2 * n + 1) / (2 * n + 1)
    x, y, square, turn = (g.ravel() for g in np.meshgrid(side, side, node + 0.5, angle, indexing="ij"))
    product = np.einsum("i,j,k,l->ijkl", share, share, weight, np.full(2 * n + 1, 1 / (2 * n + 1)))
    pupil = np.sqrt(square)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Rule(np.stack([x, y], axis=1), pupil, product.ravel())


def lattice_rule(n: int, pixel: Pixel = "area", shift: Sequence[float] = SHIFT) -> Rule:
    """Shifted lattice of n nodes (a power of two), for integrands that jump at silhouettes."""
    nodes = lattice(n, shift)
    offset = nodes[:, 2:] - 0.5 if pixel == "area" else np.zeros((n, 2))
    return Rule(offset, unit_disc(nodes[:, :2]), np.full(n, 1 / n))


def lattice(n: int, shift: Sequence[float] | Array) -> Array:
    """Rank-1 lattice in the unit cube, moved by `shift` and folded, shape (n, len(shift)); n a power of two.

    Korobov form with generator 17797 [Hickernell, Hong, L'Ecuyer, Lemieux, "Extensible lattice sequences for
    quasi-Monte Carlo quadrature", SIAM J. Sci. Comput. 22, 2000]. The fold makes a smooth integrand periodic:
    it converges like 1/n² [Hickernell, "Obtaining O(N^(-2+ε)) convergence for lattice quadrature rules",
    2002].
    """
    generator = np.array([pow(17797, k, n) for k in range(len(shift))])
    point = (np.arange(n)[:, None] * generator % n / n + np.asarray(shift)) % 1.0
    return 1 - np.abs(2 * point - 1)


def pupil_form(
    camera: ReferenceCamera,
    shapes: Sequence[Shape],
    exitance: Exitance,
    n: int,
    kind: Literal["gauss", "lattice"] = "gauss",
    pixel: Pixel = "area",
) -> tuple[Array, Array]:
    """Power on each pixel and its error [W], (height, width) each: Eq. 9 as an integral over pixel and pupil.

        P = 1/π ∫_pixel dA ∫_pupil dA_a  J_n(r) cos⁴θ / u²

    with r the first surface point on the line from a through r_vd. `n` is that of `gauss_rule` (nodes per dimension) or
    of `lattice_rule` (total number of nodes). The error is the difference to the same rule with n/2; it exceeds the
    true error as long as doubling n reduces the error. With pixel = 'centre' the value at the centre replaces the mean
    over the pixel.
    """
    if kind == "gauss":
        fine, coarse = gauss_rule(n, pixel), gauss_rule(n // 2, pixel)
    else:
        fine, coarse = lattice_rule(n, pixel), lattice_rule(n // 2, pixel, OTHER_SHIFT)
    power, half = (_average(camera, shapes, exitance, rule) for rule in (fine, coarse))
    return power, np.abs(power - half)


def surface_form(
    camera: ReferenceCamera, shape: Shape, exitance: Exitance, n: int, pixel: Pixel = "centre"
) -> tuple[Array, Array]:
    """Power on each pixel and its error [W], (height, width) each: Eq. 9 as printed, for one convex body.

        P = 1/π ∫_S J_n(r) α β |cos θ_s| |cos θ_d| / |r_vd − r|² dA_vd dS

    It is a plain sum over `n` lattice points of the surface, none of which may lie in the plane z = u (near it the sum
    is stiff: the region with β = 1 shrinks to a point). With pixel = 'area' every surface point is combined with
    another point of the pixel. The error is that of `pupil_form`.
    """
    power, half = (
        _surface_sum(camera, shape, exitance, lattice(m, shift), pixel)
        for m, shift in ((n, SHIFT), (n // 2, OTHER_SHIFT))
    )
    return power, np.abs(power - half)


def collected_power(camera: ReferenceCamera, shape: Shape, exitance: Exitance, n: int) -> float:
    """∫_S J_n f dS [W], the power of one convex body that passes the diaphragm, whatever the focus (Eq. M.9).

    f is the configuration factor from a surface element to the pupil. `n` lattice points cover surface × pupil.
    """
    nodes = lattice(n, SHIFT)
    points, area = shape.surface(nodes[:, :2])
    pupil = _on_plane(camera.pupil_radius * unit_disc(nodes[:, 2:]), 0.0)
    r = camera.from_world(points)
    line = pupil - r
    normal = shape.outward(points) @ camera.to_world[:3, :3]
    distance2 = dot(line, line)
    cosines = np.maximum(dot(normal, line), 0) * r[:, 2] / distance2
    total = np.sum(exitance(points, 0) * cosines / (np.pi * distance2)) / n
    return float(total * area * np.pi * camera.pupil_radius**2)


def _average(camera: ReferenceCamera, shapes: Sequence[Shape], exitance: Exitance, rule: Rule) -> Array:
    """Σ weight · J_n cos⁴θ, in watts, over the lines of sight of every pixel."""
    centres = camera.centres()
    power = np.zeros(len(centres))
    for pixels, nodes in _blocks(len(centres), len(rule.weight)):
        offset, pupil = rule.offset[nodes], rule.pupil[nodes]
        virtual = centres[pixels, None] + camera.pixel_side * offset
        virtual = _on_plane(virtual.reshape(-1, 2), camera.focus_distance)
        start = _on_plane(np.tile(camera.pupil_radius * pupil, (len(centres[pixels]), 1)), 0.0)
        line = virtual - start
        cos = camera.focus_distance / np.sqrt(dot(line, line))
        seen = _seen(shapes, exitance, camera.in_world(start), line @ camera.to_world[:3, :3].T)
        power[pixels] += (seen * cos**4).reshape(-1, len(pupil)) @ rule.weight[nodes]
    return camera.scale * power.reshape(camera.height, camera.width)


def _seen(shapes: Sequence[Shape], exitance: Exitance, origin: Array, direction: Array) -> Array:
    """J_n at the first surface point on each line [W/mm²]; 0 if there is none or it is the inward side."""
    nearest = np.stack([shape.meet(origin, direction) for shape in shapes])
    first = np.argmin(nearest, axis=0)
    first[~np.isfinite(np.min(nearest, axis=0))] = -1
    seen = np.zeros(len(origin))
    for i, shape in enumerate(shapes):
        (mine,) = np.nonzero(first == i)
        points = origin[mine] + nearest[i, mine, None] * direction[mine]
        lit = dot(shape.outward(points), direction[mine]) < 0
        seen[mine[lit]] = exitance(points[lit], i)
    return seen


def _surface_sum(camera: ReferenceCamera, shape: Shape, exitance: Exitance, nodes: Array, pixel: Pixel) -> Array:
    """The surface form over one set of nodes: two coordinates on the surface, two in the pixel."""
    u = camera.focus_distance
    world, area = shape.surface(nodes[:, :2])
    r = camera.from_world(world)
    normal = shape.outward(world) @ camera.to_world[:3, :3]
    shine = exitance(world, 0) * area / len(nodes)
    offset = camera.pixel_side * (nodes[:, 2:] - 0.5) * (pixel == "area")
    centres = camera.centres()
    power = np.zeros(len(centres))
    for pixels, part in _blocks(len(centres), len(nodes)):
        virtual = _on_plane(centres[pixels, None] + offset[part], u)
        line = r[part] - virtual
        distance2 = dot(line, line)
        # The point in which the line through r and r_vd meets the lens plane.
        pierced = virtual - line * (u / line[..., 2])[..., None]
        beta = dot(pierced[..., :2], pierced[..., :2]) <= camera.pupil_radius**2
        # A convex body hides no part of itself that faces the pupil.
        alpha = dot(normal[part], pierced - r[part]) > 0
        cos_s = np.abs(dot(normal[part], line))
        cos_d = np.abs(line[..., 2])
        power[pixels] += np.where(alpha & beta, cos_s * cos_d / distance2**2, 0.0) @ shine[part]
    return (camera.pixel_side**2 / np.pi * power).reshape(camera.height, camera.width)


def _blocks(rows: int, columns: int) -> Iterator[tuple[slice, slice]]:
    """Slices that cover rows × columns in blocks of at most `BLOCK`."""
    wide = min(columns, BLOCK)
    tall = max(BLOCK // wide, 1)
    for i in range(0, rows, tall):
        for j in range(0, columns, wide):
            yield slice(i, i + tall), slice(j, j + wide)


def _on_plane(xy: Array, z: float) -> Array:
    """Points (…, 3) of the plane at z."""
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1)
