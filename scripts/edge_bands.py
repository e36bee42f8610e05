"""Number of silhouette edges of a mesh that reach a pixel, to judge whether a list of them could replace lines of
sight.

    python scripts/edge_bands.py [--out docs]

An edge of a mesh belongs to the silhouette if, from some point of the pupil, one of its faces is visible and the other
is not. Each such edge is drawn on the film as a band of the width of its blur disc. Writes edge_bands.csv: for the
pixels in a band the median number of edges, the share with exactly one edge, and the share with hidden edges only.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path

F_NUMBERS = (8.0, 2.8)
HALF_PIXEL = 0.71  # half a pixel's diagonal
FLAT = 1e-6  # rad: two faces at a smaller angle count as one
NEAR = 1e-3  # of the distance to an edge: a line of sight that ends so close to it counts as having reached it
HEAD = ("mesh", "triangles", "f_number", "edges", "pixels", "edges_a_pixel_median", "one_edge", "hidden_alone")
RING = {"major_radius": 8.0, "minor_radius": 3.0, "major_sections": 200, "minor_sections": 100}  # mm


def main() -> None:
    """Measure, write the file, print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    backend.ensure_variant()
    rows = [measured(*case) for case in cases()]
    with atomic_path(arguments.out / "edge_bands.csv") as temporary, open(temporary, "w", newline="") as file:
        csv.writer(file).writerows([HEAD, *rows])
    for row in (HEAD, *rows):
        print("| " + " | ".join(map(str, row)) + " |")


def cases() -> Iterator[tuple[str, object, trimesh.Trimesh]]:
    """Name, scene and mesh [mm] of each case: the nylon cylinder, and a ring that hides a part of itself."""
    import mitsuba as mi

    from mitsuba_fspt.jit.mesh_buffers import new_mesh

    for f_number in F_NUMBERS:
        scene = fspt.load("scenes/nylon_cylinder.xml", f_number=f_number)
        yield "cylinder", scene, trimesh.load("scenes/nylon_cylinder.ply", process=False)
    ring = trimesh.creation.torus(**RING).apply_transform(trimesh.transformations.rotation_matrix(0.3, [0, 1, 0]))
    shape = new_mesh("ring", np.float32(ring.vertices).ravel(), np.uint32(ring.faces).ravel(), glowing())
    for f_number in F_NUMBERS:
        lens = {
            "type": "fspt_lens",
            "focal_length": 55,
            "f_number": f_number,
            "magnification": 0.5,
            "pixel_pitch": 0.108,
        }
        view = mi.ScalarTransform4f().look_at([180, 0, 0], [0, 0, 0], [0, 0, 1])
        film = {"type": "hdrfilm", "width": 256, "height": 256, "pixel_format": "luminance"}
        lens |= {"to_world": view, "film": film}
        yield "ring", mi.load_dict({"type": "scene", "sensor": lens, "ring": shape}), ring


def glowing() -> object:
    """Properties of a mesh that glows evenly."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["emitter"] = mi.load_dict({"type": "fspt_surface", "exitance": 1e-3})
    return properties


def measured(name: str, scene: object, mesh: trimesh.Trimesh) -> list[object]:
    """One row of the file."""
    camera = scene.sensors()[0].camera
    mesh.merge_vertices(merge_norm=True)
    edges = silhouette(mesh, camera)
    visible = ~hidden(mesh.vertices[edges].mean(axis=1), scene, camera)
    discs, blur = camera.film_discs(mesh.vertices[edges].reshape(-1, 3))
    ends, width = discs.reshape(-1, 2, 2), blur.reshape(-1, 2).max(axis=1) + HALF_PIXEL
    shape = camera.film.size[::-1]
    count, seen = bands(ends, width, shape), bands(ends[visible], width[visible], shape)
    met = count > 0
    numbers = (f"{np.median(count[met]):.0f}", f"{np.mean(count[met] == 1):.3f}", f"{np.mean(seen[met] == 0):.3f}")
    return [name, len(mesh.faces), camera.lens.f_number, len(edges), int(met.sum()), *numbers]


def silhouette(mesh: trimesh.Trimesh, camera: object) -> NDArray[np.int64]:
    """Vertices (n, 2) of edges with one face that some point of the pupil sees, and one that some point does not."""
    matrix = np.array(camera.placement).reshape(4, 4)
    centre, axis = matrix[:3, 3], matrix[:3, 2]
    normal = mesh.face_normals
    towards = np.einsum("fk,fk->f", normal, centre - mesh.triangles_center)
    across = np.linalg.norm(normal - np.outer(normal @ axis, axis), axis=1) * camera.lens.pupil_radius
    front, back = (towards + across > 0)[mesh.face_adjacency], (towards - across < 0)[mesh.face_adjacency]
    changes = (front[:, 0] & back[:, 1]) | (front[:, 1] & back[:, 0])
    return mesh.face_adjacency_edges[changes & (mesh.face_adjacency_angles > FLAT)]


def hidden(points: NDArray[np.float64], scene: object, camera: object) -> NDArray[np.bool_]:
    """True (n,) where something lies between these points (n, 3) [mm] and the middle of the lens."""
    import mitsuba as mi

    centre = np.array(camera.centre)
    way = points - centre
    ray = mi.Ray3f(mi.Point3f(*map(float, centre)), mi.Vector3f(*np.asarray(way, np.float32).T))
    ray.maxt = 1 - NEAR
    return scene.ray_test(ray).numpy()


def bands(ends: NDArray[np.float64], width: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Number (h, w) of lines between `ends` (n, 2, 2) [pixels] that pass within `width` (n,) of each pixel's centre."""
    low = np.clip(np.floor(ends.min(axis=1) - width[:, None]), 0, shape[::-1]).astype(int)
    size = np.clip(np.ceil(ends.max(axis=1) + width[:, None]), 0, shape[::-1]).astype(int) - low
    each = size.prod(axis=1)
    line = np.repeat(np.arange(len(ends)), each)
    number = np.arange(len(line)) - np.repeat(np.cumsum(each) - each, each)
    x, y = low[line, 0] + number % size[line, 0], low[line, 1] + number // size[line, 0]
    start, along = ends[line, 0], (ends[:, 1] - ends[:, 0])[line]
    from_start = np.stack([x, y], axis=1) + 0.5 - start
    length = np.maximum(np.square(along).sum(axis=1), 1e-30)
    part = np.clip((from_start * along).sum(axis=1) / length, 0, 1)
    near = np.linalg.norm(from_start - part[:, None] * along, axis=1) <= width[line]
    return np.bincount(y[near] * shape[1] + x[near], minlength=shape[0] * shape[1]).reshape(shape)


if __name__ == "__main__":
    main()
