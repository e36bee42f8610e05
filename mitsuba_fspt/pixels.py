"""Neighbourhoods on the pixel grid: which pixels lie near marked ones, and which way an image changes. Pure NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


def box_sum(image: Image, radius: int) -> Image:
    """Sum over the (2 radius + 1)² pixels around each, fewer at the border; cost independent of the radius."""
    for axis in (0, 1):
        n = image.shape[axis]
        total = np.concatenate([np.zeros_like(image.take([0], axis)), np.cumsum(image, axis)], axis)
        index = np.arange(n)
        upper, lower = np.minimum(index + radius + 1, n), np.maximum(index - radius, 0)
        image = total.take(upper, axis) - total.take(lower, axis)
    return image


def dilate(mask: Mask, radius: int) -> Mask:
    """True within `radius` pixels (square) of a marked pixel."""
    return box_sum(mask.astype(np.int64), radius) > 0 if mask.any() else mask


def spread_max(image: Image) -> Image:
    """Largest value among the 3 × 3 pixels around each."""
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        spread = image.copy()
        np.maximum(spread[1:], image[:-1], out=spread[1:])
        np.maximum(spread[:-1], image[1:], out=spread[:-1])
        image = np.moveaxis(spread, 0, axis)
    return image


def laplacian(image: Image) -> Image:
    """Sum of the four neighbours minus four times the pixel; 0 on the border."""
    result = np.zeros_like(image)
    middle = image[1:-1, 1:-1]
    result[1:-1, 1:-1] = image[:-2, 1:-1] + image[2:, 1:-1] + image[1:-1, :-2] + image[1:-1, 2:] - 4 * middle
    return result


def bend(image: Image) -> Image:
    """Size of the second differences along rows and columns; an outermost pixel takes its neighbour's."""
    total = np.zeros_like(image)
    for axis in (0, 1):
        if image.shape[axis] > 2:
            inner = np.abs(np.diff(image, 2, axis))
            total += np.pad(inner, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
    return total


def gradient(image: Image) -> tuple[Image, Image]:
    """Central differences along x and y, one-sided at the border; 0 along an axis of a single pixel."""
    along = [np.gradient(image, axis=axis) if image.shape[axis] > 1 else np.zeros_like(image) for axis in (1, 0)]
    return along[0], along[1]


def outline(hits: Image, reach: int) -> Mask:
    """True within `reach` pixels of both a hit and a miss, where lines of sight may pass a silhouette."""
    return dilate(hits > 0, reach) & dilate(hits < 1, reach)


def border(shape: tuple[int, int]) -> Mask:
    """True on the outermost pixels."""
    mask = np.ones(shape, bool)
    mask[1:-1, 1:-1] = False
    return mask


def principal_angle(x: Image, y: Image, radius: int) -> Image:
    """Angle of the axis along which the vectors (x, y) of a neighbourhood mostly point (structure tensor)."""
    xx, yy, xy = (box_sum(product, radius) for product in (x * x, y * y, x * y))
    return 0.5 * np.arctan2(2 * xy, xx - yy)
