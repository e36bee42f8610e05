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
        image = image.swapaxes(0, axis)
        reach = min(radius, len(image))
        # Sums from the border on, each of them over a window that slides in from outside.
        sums = np.zeros((len(image) + 2 * reach + 1, *image.shape[1:]), image.dtype)
        np.cumsum(image, 0, out=sums[reach + 1 : len(image) + reach + 1])
        sums[len(image) + reach + 1 :] = sums[len(image) + reach]
        image = (sums[2 * reach + 1 :] - sums[: len(image)]).swapaxes(0, axis)
    return image


def mean_where(image: Image, mask: Mask, radius: int) -> Image:
    """Mean of the marked pixels among the (2 radius + 1)² around each; 0 where there is none."""
    total, count = box_sum(np.where(mask, image, 0), radius), box_sum(mask.astype(np.float64), radius)
    return np.divide(total, count, out=np.zeros_like(total), where=count > 0.5)


def dilate(mask: Mask, radius: int) -> Mask:
    """True within `radius` pixels (square) of a marked pixel."""
    return spread_max(mask, radius)


def grow(mask: Mask, reach: NDArray[np.int64]) -> Mask:
    """True within `reach` (h, w) pixels (square) of a marked pixel, each with its own; up to 1.5 times as far."""
    grown = np.zeros_like(mask)
    left, radius = mask, 1
    while left.any():
        near = left & (reach <= radius)
        grown |= dilate(near, radius)
        left = left & ~near
        radius += max(1, radius // 2)
    return grown


def spread_max(image: NDArray[Any], radius: int = 1) -> NDArray[Any]:
    """Largest value within `radius` pixels (square) of each."""
    for axis in (0, 1):
        spread, reach = image.swapaxes(0, axis).copy(), 0
        while reach < min(radius, len(spread) - 1):
            # As far as it goes already once more, and no gap opens.
            step = min(reach + 1, radius - reach, len(spread) - 1)
            before = spread.copy()
            np.maximum(spread[step:], before[:-step], out=spread[step:])
            np.maximum(spread[:-step], before[step:], out=spread[:-step])
            reach += step
        image = spread.swapaxes(0, axis)
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


def parted(hits: Image) -> Mask:
    """True where some lines of sight of a pixel hit and some miss."""
    return (hits > ROUNDING) & (hits < 1 - ROUNDING)


def outline(hits: Image, reach: int) -> Mask:
    """True within `reach` pixels of both a hit and a miss, where lines of sight may pass a silhouette."""
    return dilate(hits > ROUNDING, reach) & dilate(hits < 1 - ROUNDING, reach)


def principal_angle(x: Image, y: Image, radius: int) -> Image:
    """Angle of the axis along which the vectors (x, y) of a neighbourhood mostly point (structure tensor)."""
    xx, yy, xy = (box_sum(product, radius) for product in (x * x, y * y, x * y))
    return 0.5 * np.arctan2(2 * xy, xx - yy)
