"""Neighbourhoods on the pixel grid: which pixels lie near marked ones, and which way an image changes. Pure NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDING = 1e-4  # of a share of hits: a sum of float32 weights


def box_sum(image: NDArray[Any], radius: int) -> NDArray[Any]:
    """Sum over the (2 radius + 1)² pixels around each, fewer at the border; cost independent of the radius."""
    for axis in (0, 1):
        n = image.shape[axis]
        sums = np.cumsum(image, axis, dtype=image.dtype)
        total = np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis)
        index = np.arange(n)
        upper, lower = np.minimum(index + radius + 1, n), np.maximum(index - radius, 0)
        image = total.take(upper, axis) - total.take(lower, axis)
    return image


def mean_where(image: Image, mask: Mask, radius: int) -> Image:
    """Mean of the marked pixels among the (2 radius + 1)² around each; 0 where there is none."""
    total, count = box_sum(np.where(mask, image, 0), radius), box_sum(mask.astype(np.float64), radius)
    return np.divide(total, count, out=np.zeros_like(total), where=count > 0.5)


def dilate(mask: Mask, radius: int) -> Mask:
    """True within `radius` pixels (square) of a marked pixel."""
    return box_sum(mask.astype(np.int32), radius) > 0 if mask.any() else mask


def spread_max(image: Image) -> Image:
    """Largest value among the 3 × 3 pixels around each."""
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        spread = image.copy()
        np.maximum(spread[1:], image[:-1], out=spread[1:])
        np.maximum(spread[:-1], image[1:], out=spread[:-1])
        image = np.moveaxis(spread, 0, axis)
    return image


def lattice(shape: tuple[int, int]) -> Mask:
    """True on one pixel of sixteen, in every row and column at other places than in the next (a rank-1 lattice)."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return (x - 5 * y) % 16 == 0


def spread_over_lattice(image: Image) -> Image:
    """Largest value among the 3 × 3 blocks of 4 × 4 pixels around each pixel's block: some lie on the lattice."""
    h, w = image.shape
    padded = np.pad(image, ((0, -h % 4), (0, -w % 4)))
    blocks = padded.reshape(padded.shape[0] // 4, 4, padded.shape[1] // 4, 4).max(axis=(1, 3))
    return spread_max(blocks).repeat(4, axis=0).repeat(4, axis=1)[:h, :w]


def second_differences(image: Image) -> tuple[Image, Image]:
    """P(k - 1) - 2 P(k) + P(k + 1) along x and y; an outermost pixel takes its neighbour's, 0 on less than three."""
    along = []
    for axis in (1, 0):
        inner = np.diff(image, 2, axis) if image.shape[axis] > 2 else np.zeros_like(image)
        rim = (image.shape[axis] - inner.shape[axis]) // 2
        along.append(np.pad(inner, [(rim, rim) if a == axis else (0, 0) for a in (0, 1)], mode="edge"))
    return along[0], along[1]


def gradient(image: Image) -> tuple[Image, Image]:
    """Central differences along x and y, one-sided at the border; 0 along an axis of a single pixel."""
    along = [np.gradient(image, axis=axis) if image.shape[axis] > 1 else np.zeros_like(image) for axis in (1, 0)]
    return along[0], along[1]


def outline(hits: Image, reach: int) -> Mask:
    """True within `reach` pixels of both a hit and a miss, where lines of sight may pass a silhouette."""
    return dilate(hits > ROUNDING, reach) & dilate(hits < 1 - ROUNDING, reach)


def principal_angle(x: Image, y: Image, radius: int) -> Image:
    """Angle of the axis along which the vectors (x, y) of a neighbourhood mostly point (structure tensor)."""
    xx, yy, xy = (box_sum(product, radius) for product in (x * x, y * y, x * y))
    return 0.5 * np.arctan2(2 * xy, xx - yy)
