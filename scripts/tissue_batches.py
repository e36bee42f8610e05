"""Monte Carlo from the source in the tissue to the CCD, in batches that stay on disk, and its mean with mirror images.

A batch is an image, VIEW-SEED.exr, whose seed is its number. A run that was stopped, or a later one for less noise,
continues from the existing files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "nylon_cylinder_tissue.xml"
LEFT_RIGHT, TOP_BOTTOM = 1, 0  # axes of a picture

Array = NDArray[np.float64]


class Batches:
    """The batches of one view that exist so far; `parameters` are those of the scene."""

    def __init__(self, folder: Path, view: str, spp: int, parameters: dict[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._view, self._spp, self._parameters = folder, view, spp, parameters
        self._scene: Any = None
        self._images: list[fspt.Image] = []
        while (path := self._path(len(self._images))).exists():
            image = fspt.read(path)
            wrong = [name for name in image.metadata.keys() & parameters if image.metadata[name] != parameters[name]]
            if wrong or image.shape != (parameters["height"], parameters["width"]):
                raise SystemExit(f"'{path}' is of another camera ({', '.join(wrong) or 'film'}). Give another folder.")
            self._images.append(image)

    def add(self) -> None:
        """One more batch."""
        if self._scene is None:
            self._scene = fspt.load(SCENE, **self._parameters)
        seed = len(self._images)
        image = fspt.render(self._scene, spp=self._spp, seed=seed)
        image.write(self._path(seed))
        self._images.append(image)

    def mean(self) -> fspt.Image:
        """Mean of all batches, weighted with their numbers of paths; error: the standard error."""
        shares = np.array([float(image.metadata["spp"]) for image in self._images])
        metadata = self._images[0].metadata | {
            "spp": shares.sum(),
            "wall_time": sum(float(image.metadata["wall_time"]) for image in self._images),
        }
        shares /= shares.sum()
        power = np.tensordot(shares, [np.float64(image.power) for image in self._images], 1)
        squares = np.tensordot(shares**2, [np.float64(image.error) ** 2 for image in self._images], 1)
        return fspt.Image(power, np.sqrt(squares), self._images[0].coverage, metadata)

    def error(self) -> float:
        """Standard error of Σ P over Σ P; infinite before the first batch."""
        if not self._images:
            return math.inf
        image = self.mean()
        return math.sqrt((image.error**2).sum()) / image.power.sum()

    def _path(self, seed: int) -> Path:
        return self._folder / f"{self._view}-{seed:04d}.exr"


def summed(image: fspt.Image, rows: Sequence[slice], columns: Sequence[slice]) -> fspt.Image:
    """Image of the sums over rectangles of pixels that do not overlap; errors as of independent pixels."""

    def sums(values: Array) -> Array:
        return np.array([[values[row, column].sum() for column in columns] for row in rows])

    coverage = sums(image.coverage) / sums(np.ones(image.shape))
    return fspt.Image(sums(image.power), np.sqrt(sums(np.float64(image.error) ** 2)), coverage, image.metadata)


def mirrored(image: fspt.Image, axes: Sequence[int]) -> fspt.Image:
    """Mean of a Monte Carlo image and its mirror images, along `axes` along which the exact image is symmetric.

    A pixel and its mirror image are independent, so that the error falls by √2 per axis; a pixel on the axis of
    symmetry keeps its error. Σ P and its error do not change. Afterwards two mirrored pixels hold the same number.
    """
    power, error = np.float64(image.power), np.float64(image.error)
    for axis in axes:
        own = np.arange(image.shape[axis]) * 2 == image.shape[axis] - 1
        own = np.expand_dims(own, 1 - axis)
        power = (power + np.flip(power, axis)) / 2
        error = np.where(own, error, np.hypot(error, np.flip(error, axis)) / 2)
    return fspt.Image(power, error, image.coverage, image.metadata)
