"""Cost of the integral against the number of pixels and of triangles.

    python scripts/scaling.py [--out docs] [--rounds 5] [--rtol 1e-2] [--only all|integral|matrix]
                              [--sides 128,256,…] [--triangles 10000,…]

The object is a sphere with a smooth J_n, its front in focus, at f/2.8. First the same field is rendered on 128 x 128 to
2048 x 2048 pixels. Then the sphere has 10 thousand to 3 million triangles, on 256 x 256 pixels, where with the most
triangles every line of sight meets a different one, and on 2048 x 2048. For each the time of Embree alone for four
lines of sight per pixel is given. Then the transport matrix of one view at rtol 1e-3 is computed for several numbers of
pixels and triangles and f-numbers: time, entries, bytes. Times are medians of warm runs in one process. Writes
scaling.csv, scaling.png and scaling_matrix.csv and prints the tables.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.studies.converge_methods import raw_rate

SIDES = (128, 256, 512, 1024, 2048)
TRIANGLES = (10_000, 100_000, 1_000_000, 3_000_000)
FEW_AND_MANY = (256, 2048)  # pixels a side on which triangles are counted
# Of the matrix: pixels a side, triangles, f-number.
MATRICES = (
    *((side, 40_000, 2.8) for side in (64, 128, 256, 512, 1024)),
    *((256, triangles, 2.8) for triangles in (10_000, 160_000)),
    *((256, 40_000, f_number) for f_number in (1.4, 5.6, 11.0)),
)
LONG = 512  # pixels a side beyond which one run is timed, with the compilation
FIELD, RADIUS = 27.648, 15.0  # mm: the detector's width, the ball's radius


@dataclass
class Setting:
    """One film and one mesh, with the results of the runs."""

    side: int
    triangles: int
    seconds: list[float] = field(default_factory=list)
    bare_seconds: list[float] = field(default_factory=list)  # of tracing alone, four lines of sight a pixel
    rays: int = 0

    @property
    def nanoseconds(self) -> float:
        """Median time a pixel [ns]."""
        return 1e9 * float(np.median(self.seconds)) / self.side**2

    @property
    def bare_nanoseconds(self) -> float:
        """Median time a pixel of tracing alone [ns]."""
        return 1e9 * float(np.median(self.bare_seconds)) / self.side**2


def main() -> None:
    """Measure, write the files, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rtol", type=float, default=1e-2)
    parser.add_argument("--only", choices=("all", "integral", "matrix"), default="all")
    parser.add_argument("--sides", type=numbers, default=SIDES, help="pixels a side, with commas")
    parser.add_argument("--triangles", type=numbers, default=TRIANGLES, help="numbers of triangles, with commas")
    arguments = parser.parse_args()
    arguments.out.mkdir(exist_ok=True)
    if arguments.only != "integral":
        measure_matrices(arguments.out / "scaling_matrix.csv", arguments.rounds)
    if arguments.only != "matrix":
        measure_integral(arguments)


def numbers(text: str) -> tuple[int, ...]:
    """Whole numbers of an option."""
    return tuple(map(int, text.split(",")))


def measure_integral(arguments: argparse.Namespace) -> None:
    """Measure the integral, write its files, print its tables."""
    by_pixels = [Setting(side, TRIANGLES[1]) for side in arguments.sides]
    by_triangles = [[Setting(side, triangles) for triangles in arguments.triangles] for side in FEW_AND_MANY]
    with tempfile.TemporaryDirectory() as folder:
        for settings in (by_pixels, *by_triangles):
            measure(settings, Path(folder), arguments.rounds, arguments.rtol)
    write_csv([*by_pixels, *itertools.chain(*by_triangles)], arguments.out / "scaling.csv")
    draw(by_pixels, by_triangles, arguments.out / "scaling.png")
    report(by_pixels, by_triangles)


def ball(triangles: int, path: Path) -> None:
    """Write a PLY of a sphere of about this number of triangles about the origin, with a smooth J_n."""
    rings = round(math.sqrt(triangles / 2))
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.arange(rings) * 2 * np.pi / rings, indexing="ij")
    normal = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(rings), np.arange(rings), indexing="ij"))
    corner = [(row + i) * rings + (column + j) % rings for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([corner[k] for k in pick], -1) for pick in ((0, 1, 2), (0, 2, 3))])
    fspt.Phantom(RADIUS * normal, faces, 1e-3 * np.exp(2 * normal[:, 0]), "vertex").write(path)


def measure_matrices(path: Path, rounds: int) -> None:
    """Time the matrices of `MATRICES`, write a row each, print them as a Markdown table."""
    head = ("side", "triangles", "f_number", "seconds_median", "seconds_min", "seconds_max", "entries", "bytes")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for side, triangles, f_number in MATRICES:
            of, file = scene(Setting(side, triangles), Path(folder), f_number), Path(folder) / "T.npz"
            long = side > LONG
            seconds = []
            for k in range(1 if long else rounds + 1):
                start = time.perf_counter()
                matrix = fspt.transport(of, file=file)
                if k or long:  # the first compiles
                    seconds.append(time.perf_counter() - start)
            times = (f"{f(seconds):.4f}" for f in (np.median, min, max))
            rows.append((side, triangles, f_number, *times, matrix.entries, file.stat().st_size))
            del of, matrix
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])
    print("| pixels | triangles | f-number | time | entries | MB |")
    print("|---|---|---|---|---|---|")
    for side, triangles, f_number, median, _, _, entries, size in rows:
        print(f"| {side}² | {triangles} | {f_number:g} | {float(median):.3g} s | {entries} | {size / 1e6:.3g} |")


def scene(setting: Setting, folder: Path, f_number: float = 2.8) -> object:
    """Scene of a setting: its sphere and film, with the camera of the nylon cylinder."""
    backend.ensure_variant()
    import mitsuba as mi

    path = folder / f"ball_{setting.triangles}.ply"
    if not path.exists():
        ball(setting.triangles, path)
    exitance = {"type": "mesh_attribute", "name": "vertex_exitance"}
    return mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "camera": {
                "type": "fspt_lens",
                "focal_length": 55.0,
                "f_number": f_number,
                "magnification": 0.5,
                "pixel_pitch": FIELD / setting.side,
                "to_world": mi.ScalarTransform4f().look_at([180, 0, 0], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": setting.side, "height": setting.side, "pixel_format": "luminance"},
            },
            "ball": {
                "type": "ply",
                "filename": str(path),
                "face_normals": True,
                "emitter": {"type": "fspt_surface", "exitance": exitance},
            },
        }
    )


def measure(settings: list[Setting], folder: Path, rounds: int, rtol: float) -> None:
    """Time all settings in turn, `rounds` times after a first run that compiles and is not counted."""
    backend.ensure_variant()
    import mitsuba as mi

    integrator = mi.load_dict({"type": "fspt_integral", "rtol": rtol})
    for setting in settings:  # one scene at a time: every existing scene makes all kernels slower
        of = scene(setting, folder)
        lens = of.sensors()[0]
        bare = [raw_rate(of, lens, together, least=1) for together in (False, True)]
        for k in range(rounds + 1):
            start = time.perf_counter()
            setting.rays = integrator.solve(of, lens).rays
            seconds = time.perf_counter() - start
            bare_seconds = min(seconds_of(run) for run in bare)  # packets where they are the faster
            if k:
                setting.seconds.append(seconds)
                setting.bare_seconds.append(bare_seconds)
        print(f"{setting.side}², {setting.triangles} triangles: {np.median(setting.seconds):.4f} s", flush=True)
        del of, lens, bare


def seconds_of(run: Callable[[], object]) -> float:
    """Time of one run [s]."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def write_csv(settings: list[Setting], path: Path) -> None:
    """One row a setting: its film and mesh, median, least and largest time [s], lines of sight, tracing alone [s]."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        rows = csv.writer(file)
        times = ("seconds_median", "seconds_min", "seconds_max")
        rows.writerow(["side", "triangles", *times, "lines_of_sight", "bare_seconds"])
        for s in settings:
            times = [f"{f(s.seconds):.5f}" for f in (np.median, min, max)]
            rows.writerow([s.side, s.triangles, *times, s.rays, f"{np.median(s.bare_seconds):.5f}"])


def draw(by_pixels: list[Setting], by_triangles: list[list[Setting]], path: Path) -> None:
    """Time a pixel against both."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogx([s.side for s in by_pixels], [s.nanoseconds for s in by_pixels], "o-", base=2)
    left.set(xlabel="pixels a side", ylabel="time a pixel [ns]", ylim=(0, None))
    for settings in by_triangles:
        label, triangles = f"{settings[0].side}² pixels", [s.triangles for s in settings]
        (line,) = right.loglog(triangles, [s.nanoseconds for s in settings], "o-", label=label)
        bare = [s.bare_nanoseconds for s in settings]
        right.loglog(triangles, bare, "o--", color=line.get_color(), label=f"{label}, tracing alone")
    right.set(xlabel="triangles", ylim=(0.2, None))
    right.legend()
    for axes in (left, right):
        axes.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


def report(by_pixels: list[Setting], by_triangles: list[list[Setting]]) -> None:
    """All settings as a Markdown table, then growth over the triangles beside that of their logarithm."""
    print("| pixels | triangles | time | a pixel | lines of sight a pixel | 4 a pixel, tracing alone |")
    print("|---|---|---|---|---|---|")
    for s in [*by_pixels, *itertools.chain(*by_triangles)]:
        seconds = float(np.median(s.seconds))
        row = (f"{s.side}²", s.triangles, f"{seconds:.3g} s", f"{s.nanoseconds:.0f} ns", f"{s.rays / s.side**2:.2f}")
        print(f"| {' | '.join(map(str, row))} | {s.bare_nanoseconds:.0f} ns |")
    for settings in by_triangles:
        few, many = settings[0], settings[-1]
        logarithm = math.log(many.triangles) / math.log(few.triangles)
        growth, bare = many.nanoseconds / few.nanoseconds, many.bare_nanoseconds / few.bare_nanoseconds
        print(f"{few.side}² pixels, {few.triangles} to {many.triangles} triangles: x{growth:.2f}", end="")
        print(f" (tracing alone: x{bare:.2f}, the logarithm: x{logarithm:.2f})")


if __name__ == "__main__":
    main()
