"""Fluence in tissue on a regular grid, and its file for Mitsuba's `gridvolume`."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..runtime.atomic_files import atomic_path
from ..runtime.errors import FluxError

Array = NDArray[np.float64]
MOST_VOXELS = 512**3


@dataclass(frozen=True, eq=False)
class Volume:
    """Values at the centres of voxels, shape (Z, Y, X); `low` and `high`: corners (x, y, z) of their box [mm].

    In a scene: a `gridvolume` of the file with `use_grid_bbox`, or with a `to_world` that maps the unit cube to the
    box, translate(low) · scale(high - low).
    """

    values: NDArray[np.float32]
    low: Array
    high: Array

    def report(self) -> dict[str, object]:
        """Size and position, ready for JSON: `volume_voxels` (x, y, z), `volume_low` and `volume_high` [mm]."""
        return {
            "volume_voxels": list(self.values.shape[::-1]),
            "volume_low": self.low.tolist(),
            "volume_high": self.high.tolist(),
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write Mitsuba's binary volume format, version 3: one channel of 32-bit floats, x running fastest.

        Raises
        ------
        FluxError : the file cannot be written; no partial file remains.
        """
        layers, rows, columns = self.values.shape
        header = struct.pack("<3sB5i6f", b"VOL", 3, 1, columns, rows, layers, 1, *self.low, *self.high)
        with atomic_path(path, FluxError) as temporary:
            temporary.write_bytes(header + np.ascontiguousarray(self.values, dtype="<f4").tobytes())


def voxel_box(low: Array, high: Array, voxel: float) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Box of whole voxels around the box from `low` to `high` (x, y, z) [mm], wider by a voxel or more on every side.

    Returns its two corners and the coordinates of the voxel centres along x, y and z [mm].

    Raises
    ------
    FluxError : the voxel's edge [mm] is not positive, or there would be more than 512³ voxels.
    """
    if not (np.isfinite(voxel) and voxel > 0):
        raise FluxError(f"volume: 'voxel' must be > 0 and finite, got {voxel:g}. Give mm.")
    counts = np.ceil((high - low) / voxel - 1e-9) + 2
    if counts.prod() > MOST_VOXELS:
        raise FluxError(
            f"volume: voxels of {voxel:g} mm make a grid of {counts.prod():.3g}, more than "
            f"{MOST_VOXELS:.3g}. Give larger ones."
        )
    middle, half = (low + high) / 2, counts * voxel / 2
    x, y, z = (m + voxel * (np.arange(int(n)) + 0.5 - n / 2) for m, n in zip(middle, counts, strict=True))
    return middle - half, middle + half, (x, y, z)
