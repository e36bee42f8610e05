"""Étendue of single pixels through a lens, in double precision: power on a pixel over it is the mean radiance (M.6)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .distortion import preimage, shrink_in_double
from .thin_lens import Lens

# Distances from the axis between which the étendue is interpolated: at least so many, and so many per pixel. The error
# is 1e-6 on films of ±45°, and 1e-4 of the largest étendue where a border of the lens darkens the film within a pixel.
RADII, RADII_PER_PIXEL = 4097, 16
# Gauss nodes along each side of a pixel; more where the étendue changes by more than `STEEP` of itself over the pixel.
NODES, MORE_NODES, STEEP = 2, 16, 0.02
MORE_DISTORTED = 3  # Gauss nodes along each side of a pixel whose preimage is curved
CHORDS, ALONG = 16, 6  # Gauss nodes across each part of the open pupil and along its chords
Plane = NDArray[np.float64]


def full_etendue(side: float, pupil_radius: float, focus_distance: float) -> float:
    """Étendue A_vd A_pupil/u² [mm² sr] of a virtual pixel of a `side` and a pupil at `focus_distance` u [mm] (Eq. M.6).

    In double precision: far away and stopped down its factors leave the range of float32.
    """
    return side**2 * math.pi * (pupil_radius / focus_distance) ** 2


def pixel_etendues(
    lens: Lens, side: float, x: Plane, y: Plane, transmittance: float = 1.0, pixel: str = "area"
) -> Plane:
    """τ A_vd A_pupil/u² ⟨cos⁴θ⟩ [mm² sr] of virtual pixels, shape (h, w); 0 where no light passes.

    The mean is over the pixel and over the part of the pupil that the borders of the lens leave open (Eqs. 5, M.13);
    light outside the image-plane stop counts as 0.

    lens : focused on the virtual detector plane
    side : of a virtual pixel [mm]
    x, y : centres of the columns (w,), to the right, and of the rows (h,), downwards, on the virtual detector plane,
        from the optical axis [mm]; with a distortion, of their undistorted images
    transmittance : τ of lens and filters
    pixel : 'area': the mean over the pixel; 'centre': its centre times its area, as the integral's parameter `pixel`
    """
    half = side / 2 if pixel == "area" else 0.0
    if lens.distortion:
        mean = _distorted_mean(lens, side, x, y, half) * (
            1.0 if half == 0 else _inside_stop(lens.seen_field, side, x, y)
        )
        return transmittance * full_etendue(side, lens.discs[0].radius, lens.focus_distance) * mean
    nearest, middle, farthest = (
        np.hypot(_towards_axis(x, reach)[None, :], _towards_axis(y, reach)[:, None]) for reach in (half, 0.0, -half)
    )
    last = float(farthest.max())
    table = np.linspace(0, last, max(RADII, RADII_PER_PIXEL * math.ceil(last / side)))
    values = mean_cos4(lens, table)
    if half == 0:
        mean = np.where(middle <= lens.seen_field, np.interp(middle, table, values), 0)
    else:
        mean = _mean_over_pixels(table, values, half, x[None, :], y[:, None], NODES)
        most = np.interp(nearest, table, values)
        steep = most - np.interp(farthest, table, values) > STEEP * most
        columns, rows = (np.broadcast_to(place, steep.shape)[steep] for place in (x[None, :], y[:, None]))
        mean[steep] = _mean_over_pixels(table, values, half, columns, rows, MORE_NODES)
        mean *= _inside_stop(lens.seen_field, side, x, y)
    return transmittance * full_etendue(side, lens.discs[0].radius, lens.focus_distance) * mean


def _distorted_mean(lens: Lens, side: float, x: Plane, y: Plane, half: float) -> Plane:
    """Means over pixels (h, w) of cos⁴θ times the share of area that the distortion leaves them (Eq. M.44)."""
    distortion, length = lens.distortion, lens.pupil_distance
    if distortion is None:
        raise ValueError("the lens has no distortion")
    nodes, weights = np.polynomial.legendre.leggauss(MORE_DISTORTED if half else 1)
    corner = float(np.hypot(np.abs(x).max() + side / 2, np.abs(y).max() + side / 2)) / length
    limit = distortion.limit(corner, lens.magnification * length)
    found = [
        preimage(
            (x[None, :] + step) / length + np.zeros((len(y), 1)),
            (y[:, None] + other) / length + np.zeros((1, len(x))),
            distortion.coefficients,
            lambda u, v: shrink_in_double(u, v, limit),
        )
        for step in half * nodes
        for other in half * nodes
    ]
    radii = [length * np.hypot(u, v) for u, v, _ in found]
    table = np.linspace(0, max(float(r.max()) for r in radii), RADII)
    values = mean_cos4(lens, table)
    shares = [a * b / 4 for a in weights for b in weights]
    return sum(
        (w * share * np.interp(r, table, values) for w, r, (_, _, share) in zip(shares, radii, found, strict=True)),
        np.zeros((len(y), len(x))),
    )


def _towards_axis(place: Plane, reach: float) -> Plane:
    """Distance from the axis of the point of [place - reach, place + reach] nearest to it; farthest for reach < 0."""
    return np.maximum(np.abs(place) - reach, 0)


def _mean_over_pixels(table: Plane, values: Plane, half: float, x: Plane, y: Plane, nodes: int) -> Plane:
    """Means over pixels with these centres, and sides of 2 `half`, of a function given by its `values` at radii."""
    steps, weights = np.polynomial.legendre.leggauss(nodes)
    mean = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for step, weight in zip(half * steps, weights / 2, strict=True):
        for other, share in zip(half * steps, weights / 2, strict=True):
            mean += weight * share * np.interp(np.hypot(x + step, y + other), table, values)
    return mean


def mean_cos4(lens: Lens, radius: Plane) -> Plane:
    """Mean of cos⁴θ over the pupil, shape (n,), for virtual points at the distances `radius` (n,) from the axis [mm].

    cos⁴θ counts as 0 on the part of the pupil that a second border covers. The open part is symmetric about the line
    from the axis to the virtual point. It is integrated over chords perpendicular to that line; `height` of a chord and
    positions along it are in units of the pupil's radius.
    """
    first, *borders = lens.discs
    u, pupil = lens.focus_distance, lens.pupil_radius
    offset = (1 - first.shift) * radius
    if pupil == 0:
        return (1 + (offset / u) ** 2) ** -2.0
    centre, reach = np.zeros_like(radius), np.full_like(radius, 2.0)  # of a disc that covers the pupil
    for border in borders:
        centre, reach = (border.shift - first.shift) * radius / pupil, np.full_like(radius, border.radius / pupil)
    low, high = np.maximum(-1, centre - reach), np.minimum(1, centre + reach)
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = (centre**2 + 1 - reach**2) / (2 * centre)  # where the circles meet, if they do
    meet = np.clip(np.where(np.isfinite(meet), meet, high), low, np.maximum(low, high))
    total = np.zeros_like(radius)
    for start, stop in ((low, meet), (meet, high)):
        total += _over_chords(start, stop, centre, reach, lambda h, s: (1 + _off(offset, pupil, h, s) / u**2) ** -2.0)
    return np.where(high > low, total / math.pi, 0.0)


def _off(offset: Plane, pupil: float, height: Plane, along: Plane) -> Plane:
    """Squared distance across the axis from the virtual point to the lens point (height, along) [mm²]."""
    return (offset - pupil * height) ** 2 + (pupil * along) ** 2


def _over_chords(
    start: Plane, stop: Plane, centre: Plane, reach: Plane, function: Callable[[Plane, Plane], Plane]
) -> Plane:
    """∫∫ function(h, s) dh ds over heights from `start` to `stop` within the unit disc and that of radius `reach`."""
    nodes, weights = np.polynomial.legendre.leggauss(CHORDS)
    rows, shares = np.polynomial.legendre.leggauss(ALONG)
    total = np.zeros_like(start)
    for node, weight in zip(nodes, weights, strict=True):
        # The length of chords vanishes like a square root at both ends; with nodes dense there the integrand is smooth.
        turn = math.pi * (node + 1) / 2
        height = start + (stop - start) * (1 - math.cos(turn)) / 2
        step = (stop - start) * math.sin(turn) * math.pi / 4 * weight
        half = np.sqrt(np.maximum(np.minimum(1 - height**2, reach**2 - (height - centre) ** 2), 0))
        for row, share in zip(rows, shares, strict=True):
            total += step * share * half * function(height, half * row)
    return total


def _inside_stop(field: float, side: float, x: Plane, y: Plane) -> Plane | float:
    """Share of each virtual pixel (h, w) inside the image-plane stop of radius `field` on the virtual plane [mm]."""
    if math.isinf(field):
        return 1.0
    x, y, half = np.abs(x)[None, :] / field, np.abs(y)[:, None] / field, side / 2 / field  # by symmetry
    inside = np.hypot(x + half, y + half) <= 1
    cut = ~inside & (np.hypot(np.maximum(x - half, 0), np.maximum(y - half, 0)) < 1)
    share = inside.astype(np.float64)
    x, y = (np.broadcast_to(place, cut.shape)[cut] for place in (x, y))
    right, left, top, bottom = x + half, x - half, y + half, y - half
    area = _disc_area(right, top) - _disc_area(left, top) - _disc_area(right, bottom) + _disc_area(left, bottom)
    share[cut] = np.clip(area / (2 * half) ** 2, 0, 1)
    return share


def _disc_area(x: Plane, y: Plane) -> Plane:
    """Area of the unit disc within the rectangle from its middle to (x, y); < 0 where one of x and y is negative."""
    sign = np.sign(x) * np.sign(y)
    x, y = np.minimum(np.abs(x), 1), np.minimum(np.abs(y), 1)
    start = np.minimum(x, np.sqrt(1 - y**2))  # from there to x the disc's border lies below y
    return sign * (start * y + _below_border(x) - _below_border(start))


def _below_border(x: Plane) -> Plane:
    """∫ √(1 − t²) dt from 0 to x."""
    return (x * np.sqrt(1 - x**2) + np.arcsin(x)) / 2
