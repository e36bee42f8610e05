"""NumPy's archive: an array for each plane, the axes x and y [mm] where they are known, metadata as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..pixel_axes import PixelAxes
from . import Format, Metadata, Planes


class Npz(Format):
    """Arrays `power` (or `electrons`), `error`, `coverage` (h, w), `x` (w,), `y` (h,), and `metadata`, a JSON text."""

    kind = "NumPy archive"

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """As `Format.write`."""
        axes = PixelAxes.of(next(iter(planes.values())).shape, metadata)
        along = {"x": axes.x, "y": axes.y} if axes.unit == "mm" else {}
        with path.open("wb") as file:
            np.savez_compressed(file, **planes, **along, metadata=np.array(json.dumps(metadata)))  # type: ignore[arg-type]

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """As `Format.read`."""
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            metadata = json.loads(str(stored["metadata"]))
            return {name: stored[name] for name in stored.files if stored[name].ndim == 2}, metadata
