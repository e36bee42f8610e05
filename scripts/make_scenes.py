"""Make the data files of scenes/ that need no solver: the letter's mesh and the sphere's bitmap; same bytes every run.

    python scripts/make_scenes.py [FOLDER]      default: scenes/ of this repository

The cylinder's J_n needs the solver: fspt flux solve scenes/nylon_cylinder.toml -o scenes/nylon_cylinder.ply

Lengths in mm, exitance in W/mm². The world of all scenes: z up, the camera on the +x axis, so that +y is to
the right of the image.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import trimesh
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parent.parent / "scenes"

Array = NDArray[np.floating[Any]]
Index = NDArray[np.int64]


def l_surface(width: float, height: float, bar: float, edge: float) -> tuple[Array, Index]:
    """Flat letter L in the plane x = 0, read from +x with z up and y to the right; bounding box centred.

    Bars of thickness `bar`; `edge` has to divide all three lengths [mm]. Returns vertices (V, 3) [mm] and
    faces (F, 3), whose normal is +x.
    """
    columns, rows, thick = (round(length / edge) for length in (width, height, bar))
    row, column = np.divmod(np.arange(rows * columns), columns)
    inside = (column < thick) | (row < thick)
    corner = (row * (columns + 1) + column)[inside]
    above = corner + columns + 1
    faces = np.vstack([np.column_stack([corner, corner + 1, above + 1]), np.column_stack([corner, above + 1, above])])
    used, faces = np.unique(faces, return_inverse=True)
    y, z = used % (columns + 1) * edge - width / 2, used // (columns + 1) * edge - height / 2
    return np.column_stack([np.zeros(len(used)), y, z]), faces.reshape(-1, 3)


def sphere_picture(rows: int = 256) -> NDArray[np.float32]:
    """Exitance map of the sphere (rows, 2·rows) [W/mm²]: row 0 at the north pole, column 0 at longitude 0.

    Bands 15° of latitude wide, 2 and 5, the northern cap 10; on longitude 0 a letter F of 40, read from
    outside; a square of 20 on longitude -90°, the side that view = 90 shows. Sharp to the texel.
    """
    latitude = 90 - (np.arange(rows)[:, None] + 0.5) * 180 / rows
    longitude = ((np.arange(2 * rows) + 0.5) * 180 / rows + 180) % 360 - 180
    picture = np.where(np.floor(latitude / 15) % 2, 5.0, 2.0) * np.ones_like(longitude)

    def patch(value: float, west: float, east: float, south: float, north: float) -> None:
        box = (longitude > west) & (longitude < east) & (latitude > south) & (latitude < north)
        picture[box] = value

    patch(10, -180, 180, 75, 90)
    patch(40, -24, -12, -30, 30)  # stem
    patch(40, -24, 24, 18, 30)  # upper arm
    patch(40, -24, 12, -6, 6)  # lower arm
    patch(20, -102, -78, -12, 12)
    return picture.astype(np.float32)


def write_ply(path: Path, vertices: Array, faces: Index, comments: Sequence[str]) -> None:
    """Binary PLY, float32, with comment lines."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    ply = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False)
    lines = "".join(f"comment {comment}\n" for comment in comments).encode("ascii")
    path.write_bytes(ply.replace(b"element vertex", lines + b"element vertex", 1))


def write_picture(path: Path, picture: NDArray[np.float32]) -> None:
    """One-channel float32 EXR [W/mm²]."""
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "comments": "exitance J_n [W/mm^2]; row 0 north pole, column 0 longitude 0",
    }
    OpenEXR.File(header, {"Y": picture}).write(str(path))


def make(folder: Path) -> None:
    """Writes all data files into `folder`."""
    write_ply(
        folder / "l_shape.ply",
        *l_surface(width=16, height=24, bar=6, edge=2),
        ["letter L in the plane x = 0, outward +x, 16 mm x 24 mm, bars 6 mm, area 204 mm^2", "unit mm"],
    )
    write_picture(folder / "textured_sphere.exr", sphere_picture())


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENES)
