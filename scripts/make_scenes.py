"""Makes every data file of scenes/: the meshes, their exitance, the sphere's picture. Same bytes every run.

    python scripts/make_scenes.py [FOLDER]      default: scenes/ of this repository

Lengths in mm, exitance in W/mm². The world of all scenes: z up, the camera on the +x axis, so that +y is to
the right of the picture.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import trimesh
from cylinder_diffusion import Phantom, exitance
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parent.parent / "scenes"
CYLINDER_EDGE = 0.33  # mm; 44,000 vertices

Array = NDArray[np.floating[Any]]
Index = NDArray[np.int64]


def disc_surface(radius: float, rings: int) -> tuple[Array, Index]:
    """Flat disc of concentric rings, ring j with 6j vertices: edges alike everywhere, no slivers.

    Returns vertices (1 + 3·rings·(rings + 1), 2) [mm], the centre first, the rim (6·rings, from angle 0 on,
    counterclockwise) last, and faces (6·rings², 3), counterclockwise.
    """
    ring = np.repeat(np.arange(1, rings + 1), 6 * np.arange(1, rings + 1))
    place = np.arange(len(ring)) - 3 * ring * (ring - 1)
    angle, distance = np.pi / 3 * place / ring, radius * ring / rings
    points = np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])

    def at(j: Index, k: Index) -> Index:
        """Vertex k, counted cyclically, of ring j."""
        return np.where(j == 0, 0, 1 + 3 * j * (j - 1) + k % np.maximum(6 * j, 1))

    # Sextant of the strip between rings j - 1 and j: j triangles stand on the outer ring, j - 1 on the inner.
    j, sextant, i = ring, place // ring, place % ring
    outer, inner = sextant * j + i, sextant * (j - 1) + i
    up = np.column_stack([at(j, outer), at(j, outer + 1), at(j - 1, inner)])
    down = np.column_stack([at(j - 1, inner), at(j, outer + 1), at(j - 1, inner + 1)])
    return np.vstack([np.zeros((1, 2)), points]), np.vstack([up, down[i < j - 1]])


def cylinder_surface(radius: float, height: float, edge: float) -> tuple[Array, Index]:
    """Closed cylinder about the z axis, centred at the origin: staggered rows on the side, rings on the caps.

    Returns vertices (V, 3) [mm] on the true cylinder and outward faces (F, 3); side and caps share the rim
    vertices. Edges are 0.9 to 1.4 times `edge` [mm] long (> 0, smaller than radius and height).
    The side comes first: row 0 is the bottom rim, then the interior of the top cap, then of the bottom one.
    """
    rings = int(np.ceil(np.pi * radius / (3 * edge)))
    columns = 6 * rings
    # Rows of equilateral triangles; an even number of them, so that both rims start at angle 0.
    rows = 2 * int(np.ceil(height / (edge * np.sqrt(3))))
    row, column = np.divmod(np.arange((rows + 1) * columns), columns)
    angle = 2 * np.pi * (column + row % 2 / 2) / columns
    z = height * (row / rows - 0.5)
    side = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])

    row, column = row[:-columns], column[:-columns]
    right, shift = (column + 1) % columns, row % 2
    low, low_right = row * columns + column, row * columns + right
    high, high_right = low + columns, low_right + columns
    # An odd row is half a step ahead: the diagonal leans the other way.
    first = np.column_stack([low, low_right, np.where(shift, high_right, high)])
    second = np.column_stack([np.where(shift, low, low_right), high_right, high])

    points, faces = disc_surface(radius, rings)
    inner = len(points) - columns
    local = np.arange(len(points))
    caps = []
    for up in (True, False):
        start = len(side) if up else len(side) + inner
        rim = rows * columns if up else 0
        index = np.where(local < inner, start + local, rim + local - inner)
        caps.append(index[faces if up else faces[:, ::-1]])
    flat = points[:inner]
    top = np.column_stack([flat, np.full(inner, height / 2)])
    return np.vstack([side, top, top * (1, 1, -1)]), np.vstack([first, second, *caps])


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


def mesh_power(vertices: Array, faces: Index, values: Array) -> float:
    """∫ J_n dS [W] of exitance linear on every face, `values` (V,) [W/mm²]."""
    corners = np.asarray(vertices)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return float(area @ np.asarray(values)[faces].mean(1))


def write_ply(path: Path, vertices: Array, faces: Index, comments: Sequence[str], values: Array | None = None) -> None:
    """Binary PLY, float32; `values` (V,) become the property exitance_x, vertex_exitance in Mitsuba."""
    # A name without _x never arrives: Mitsuba reads only properties it can group into an attribute.
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if values is not None:
        mesh.vertex_attributes["exitance_x"] = values.astype(np.float32)
    ply = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False)
    lines = "".join(f"comment {comment}\n" for comment in comments).encode("ascii")
    path.write_bytes(ply.replace(b"element vertex", lines + b"element vertex", 1))


def write_cylinder(path: Path, phantom: Phantom, edge: float) -> None:
    """The phantom's surface with J_n per watt of source; the comments say where it comes from."""
    vertices, faces = cylinder_surface(phantom.radius, phantom.height, edge)
    values = exitance(phantom, vertices)
    comments = [
        "quantity exitance J_n, per vertex, property exitance_x",
        "unit W/mm^2 per W of source, lengths mm",
        "source exact diffusion solution of the closed cylinder, phi + 2 A D dphi/dn = 0, J_n = phi/(2A)",
        f"tissue mua {phantom.mua:g}/mm, musp {phantom.musp:g}/mm, n {phantom.index:g}, A robin",
        f"light ball, {phantom.source_diameter:g} mm wide, at ({phantom.source_x:g} 0 {phantom.source_z:g})",
        f"total power {mesh_power(vertices, faces, values):.5f} W, peak {values.max():.4g} W/mm^2",
    ]
    write_ply(path, vertices, faces, comments, values)


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
    write_cylinder(folder / "nylon_cylinder.ply", Phantom(), CYLINDER_EDGE)
    write_ply(
        folder / "l_shape.ply",
        *l_surface(width=16, height=24, bar=6, edge=2),
        ["letter L in the plane x = 0, outward +x, 16 mm x 24 mm, bars 6 mm, area 204 mm^2", "unit mm"],
    )
    write_picture(folder / "textured_sphere.exr", sphere_picture())


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENES)
