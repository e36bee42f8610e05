"""Times and errors of ordinary images: six bodies from three sides at f/1.8 and f/8, 192 × 192 pixels, default `rtol`.

    python scripts/ordinary_scenes.py [--body torus,box] [--view 0,90,200] [--f-number 1.8,8] [--limit 60]
                                      [--max-nodes N] [--pixels 48] [-o docs/ordinary_scenes.csv]

An ellipsoid with a spot, a torus over decades, a capsule with noise per vertex, a ball with a smooth J_n, a ball with
checks and a box with a ramp. Each image is rendered once with warm kernels, for at most `--limit` seconds. On some
pixels, half of them those of the largest stated errors, the rest at random among the lit ones, the power is compared
with the mean over shifted lattices of rays of the sensor itself, as Mitsuba's Monte Carlo samples them; its standard
error is subtracted from the difference. Lines of sight are in millions; errors are over the brightest pixel.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path

Array = NDArray[np.float64]
Body = tuple[trimesh.Trimesh, Callable[[Array], Array]]
SIDE, RTOL = 192, 1e-3
SHIFTS, POINTS = 16, 1 << 15  # of the reference
VECTOR = (1, 949661, 683229, 634757)  # rank-1 lattice whose first 2^m points are one in four dimensions
HEAD = (
    *("body", "view", "f_number", "seconds", "cpu_seconds", "lines", "stated", "largest_stated"),
    *("compared", "beyond_rtol", "beyond_2_rtol", "beyond_error", "largest_error", "reference_error"),
    *("path_cpu_seconds", "path_rms", "path"),
)
SPP, GOAL = 256, 1e-4  # samples a pixel of `path`; its RMS error


def bodies() -> Iterator[tuple[str, Body]]:
    """Name, mesh [mm] and J_n [W/mm²] at points (n, 3) of each body."""
    ellipsoid = trimesh.creation.icosphere(subdivisions=4)
    ellipsoid.apply_scale([10, 15, 8])
    yield "ellipsoid", (ellipsoid, lambda r: 1e-3 * np.exp(-(((r - [9, 3, 0]) ** 2).sum(axis=1)) / 20) + 1e-6)
    torus = trimesh.creation.torus(major_radius=12, minor_radius=4, major_sections=96, minor_sections=48)
    yield "torus", (torus, lambda r: 1e-4 * np.exp(-np.linalg.norm(r - [12, 0, 3], axis=1) / 3))
    capsule = trimesh.creation.capsule(height=25, radius=7, count=[48, 48])
    capsule.apply_translation(-capsule.centroid)
    yield "capsule", (capsule, lambda r: 1e-4 * np.random.default_rng(1).gamma(2.0, 0.5, len(r)))
    ball = trimesh.creation.icosphere(subdivisions=5, radius=11)
    yield "ball", (ball, lambda r: 1e-2 * _point_source(np.linalg.norm(r - [6, 2, 1], axis=1)))
    checks = trimesh.creation.icosphere(subdivisions=4, radius=11)
    yield "checks", (checks, lambda r: 1e-4 * (0.02 + (np.sin(1.3 * r).prod(axis=1) > 0)))
    box = trimesh.creation.box((14, 20, 9)).subdivide().subdivide().subdivide()
    yield "box", (box, lambda r: 1e-4 * (1.05 + r[:, 1] / 10))


def _point_source(distance: Array) -> Array:
    return np.exp(-0.2 * distance) / distance**2


def reference(scene: object, pixels: NDArray[np.int64]) -> tuple[Array, Array]:
    """Power [W] on pixels (n,) of the film, row by row, and its standard error, from rays of the scene's sensor."""
    import drjit as dr
    import mitsuba as mi

    sensor = scene.sensors()[0]  # type: ignore[attr-defined]
    random, value = np.random.default_rng(1), np.zeros((SHIFTS, len(pixels)))
    point = dr.tile(dr.brev(dr.arange(mi.UInt32, POINTS)), len(pixels))
    pixel = dr.repeat(mi.UInt32(pixels.astype(np.uint32)), POINTS)
    for k in range(SHIFTS):
        start = mi.UInt32(random.integers(1 << 32, size=len(VECTOR), dtype=np.uint32))
        whole = (point * step + dr.gather(mi.UInt32, start, n) for n, step in enumerate(VECTOR))
        x, y, u, v = (dr.minimum(dr.abs(1 - mi.Float(one) * 2.0**-31), 1) for one in whole)
        film = mi.Point2f((mi.Float(pixel % SIDE) + x) / SIDE, (mi.Float(pixel // SIDE) + y) / SIDE)
        ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0.5), film, mi.Point2f(u, v))
        si = scene.ray_intersect(ray)  # type: ignore[attr-defined]
        found = mi.Float64(dr.ravel(weight * si.emitter(scene).eval(si)))
        value[k] = dr.block_sum(found, POINTS).numpy() / POINTS
    return value.mean(axis=0), value.std(axis=0, ddof=1) / np.sqrt(SHIFTS)


def row_of(scene: object, image: fspt.Image, seconds: float, cpu: float, count: int) -> list[object]:
    """Times and errors of an image, without its name."""
    peak = image.power.max()
    stated = image.error.ravel()
    lit = np.flatnonzero(stated > 0)
    likely = lit[np.argsort(stated[lit])[::-1][: count // 2]]
    others = np.setdiff1d(lit, likely)
    random = np.random.default_rng(2).choice(others, min(count - len(likely), len(others)), replace=False)
    pixels = np.concatenate([likely, random])
    beyond: list[object] = [0, "", "", "", "", ""]
    if pixels.size:
        power, error = reference(scene, pixels)
        off = np.maximum(np.abs(image.power.ravel()[pixels] - power) - 3 * error, 0) / peak
        limits = (RTOL, 2 * RTOL, stated[pixels] / peak)
        beyond = [len(pixels), *(int((off > limit).sum()) for limit in limits)]
        beyond += [f"{off.max():.2e}", f"{error.max() / peak:.1e}"]
    lines = int(image.metadata["nodes"]) / 1e6
    far = int((stated > RTOL * peak).sum())
    return [f"{seconds:.2f}", f"{cpu:.2f}", f"{lines:.2f}", far, f"{stated.max() / peak:.2e}", *beyond]


def path_of(scene: object, image: fspt.Image, cpu: float) -> list[str]:
    """CPU seconds of `path`, its RMS error over the brightest pixel, and the ratio of times to `GOAL`."""
    import mitsuba as mi

    path = mi.load_dict({"type": "path", "max_depth": 1})
    for seed in (1, 2):  # the first one compiles
        start = time.process_time()
        power = np.array(mi.render(scene, integrator=path, spp=SPP, seed=seed)).reshape(image.power.shape)
        spent = time.process_time() - start
    rms = float(np.sqrt(np.mean((power - image.power) ** 2)) / image.power.max())
    return [f"{spent:.2f}", f"{rms:.2e}", f"{spent * (rms / GOAL) ** 2 / cpu:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--body", default="")
    parser.add_argument("--view", default="0,90,200")
    parser.add_argument("--f-number", default="1.8,8")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds an image")
    parser.add_argument("--max-nodes", type=int)
    parser.add_argument("--pixels", type=int, default=48, help="compared with the reference; 0 for none")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    backend.ensure_variant()
    settings = {"max_time": options.limit, "max_nodes": options.max_nodes}
    wanted = [name for name in options.body.split(",") if name]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (mesh, exitance) in bodies():
            if wanted and name not in wanted:
                continue
            path = Path(folder) / f"{name}.ply"
            fspt.Phantom(mesh.vertices, mesh.faces, exitance(np.asarray(mesh.vertices)), "vertex").write(path)
            for f_number, view in itertools.product(*(options.f_number.split(","), options.view.split(","))):
                text = fspt.scene_xml(path, f_number=float(f_number), width=SIDE, height=SIDE)
                scene = fspt.load(text, view=float(view))
                fspt.render(scene, rtol=0.1)  # most kernels
                start, cpu = time.perf_counter(), time.process_time()
                image = fspt.render(scene, **settings)
                spent = time.perf_counter() - start, time.process_time() - cpu
                row = row_of(scene, image, *spent, options.pixels)
                rows.append([name, view, f_number, *row, *path_of(scene, image, spent[1])])
                print(*rows[-1], sep="\t", flush=True)
    if options.output:
        with atomic_path(options.output) as part, part.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEAD, *rows])


if __name__ == "__main__":
    main()
