"""Errors of the integral on random scenes, against an independent float64 reference.

    python scripts/audit.py [--scenes 10] [--seed 0] [--family spheres,plates] [--rtol 1e-3] [--finer 1] [--out docs]
                            [--keep]
    python scripts/audit.py --ablate all|order,slant [--matrix] [--scenes 3] [--seed 0] [--family …] [--rtol 1e-3]
    python scripts/audit.py --matrix [--scenes 10] [--seed 0] [--family boxes,meshes] [--rtol 1e-3] [--out docs]

Scenes of every family of tests/references/random_scenes.py are rendered by `fspt_integral`. tests/references/fans.py
computes the power, with an error of its own, on 24 pixels of each: 16 where errors are likely (large stated errors,
edges, strong curvature of the image) and 8 random ones. A pixel counts as beyond a limit only if it exceeds the limit
by more than the reference's error. Writes audit.csv, one row per scene, and prints the table by family. With `--keep`
rows of families that are not rendered now stay in file and table: all families together take an hour.

With `--ablate` scenes are computed without each threshold of `integral/estimator.py` in turn, with `--matrix` without
each of `ColumnRule`: how many of all pixels are beyond `rtol` and beyond the stated error, and what it costs. The image
for a tenth of `rtol` takes the place of the reference here. Writes ablation.csv or ablation_matrix.csv.

With `--matrix` the product of the transport matrix and J_n takes the place of the image, and `T.error(J)` that of its
error, in scenes of `MESH_FAMILIES`. J_n is random on every vertex or face, or has one bright spot (`_exitance`). Writes
audit_matrix.csv.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from unittest import mock

import markdown_tables
import numpy as np
import tests_folder  # noqa: F401
from references.bodies import Triangles
from references.random_scenes import ALL_FAMILIES, MESH_FAMILIES, RandomScene, linear_on, random_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.integral.estimator import Estimator
from mitsuba_fspt.integral.quadrature import Quadrature
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path

LIKELY, RANDOM = 16, 8  # pixels of each scene
SLOW = 2.0  # s: rendered once more, as kernels may have been compiled
FINER_NODES = 1 << 14  # lines of sight a pixel of images that take the place of the reference
GOAL, LEAST_GOAL = 0.15, 1e-5  # error of the reference: over the stated error, and over the brightest pixel
MATRIX_GOAL = 0.05  # likewise over rtol, for products of the matrix: in its scenes lines of sight cross many faces
LEAST_TRUE = 1e-7  # of the brightest pixel: smaller errors are rounding
WIDE = 0.1  # of rtol: least stated error of pixels for which stated over true error is evaluated
SAME = ("rtol", "finer", "likely", "random")  # settings that the file does not tell
FILLED = 0.9  # of the largest sum of a row of the matrix: with less, an edge may cross the pixel
HEAD = (
    "scenes",
    "beyond rtol, likely",
    "beyond rtol, random",
    "beyond 5 rtol",
    "beyond error",
    "silent",
    "error / true",
    "scenes with error > rtol",
    "slowest [s]",
)


@dataclass(frozen=True)
class Audit:
    """Result for one scene: numbers of pixels, and errors relative to the brightest pixel.

    likely, random : checked pixels where errors are likely, and random ones
    beyond_likely, beyond_random, beyond_5 : checked pixels of either kind beyond rtol; of both beyond 5 rtol
    beyond_error, silent : checked pixels beyond the stated error; of these those beyond rtol with less than rtol stated
    largest : largest difference to the reference
    width : median of stated over true error where more than rtol/10 is stated; NaN if there is no such pixel
    stated : pixels of the whole image with a stated error above rtol
    reference : largest error of the reference
    seconds : run time of the rendering
    """

    family: str
    seed: int
    f_number: float
    width_pixels: int
    height_pixels: int
    likely: int
    random: int
    beyond_likely: int
    beyond_random: int
    beyond_5: int
    beyond_error: int
    silent: int
    largest: float
    width: float
    stated: int
    reference: float
    seconds: float


def main() -> None:
    """Measure, write the file, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=10, help="of each family")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene of a family")
    parser.add_argument("--family", help="names of families, with commas; all by default")
    parser.add_argument("--likely", type=int, default=LIKELY, help="pixels of each scene where errors are likely")
    parser.add_argument("--random", type=int, default=RANDOM, help="random pixels of each scene")
    parser.add_argument("--rtol", type=float, default=1e-3)
    parser.add_argument("--finer", type=int, default=1, help="times as many pixels along each side of the film")
    parser.add_argument("--ablate", help="thresholds to do without, one by one, or all")
    parser.add_argument("--matrix", action="store_true", help="products of the transport matrix in place of images")
    parser.add_argument("--keep", action="store_true", help="keep the rows of other families that the file has")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--readme", type=Path, help="file whose table 'audit', or 'audit_matrix', is replaced")
    arguments = parser.parse_args()
    if arguments.keep and (arguments.ablate or any(getattr(arguments, k) != parser.get_default(k) for k in SAME)):
        parser.error(f"--keep goes with the default --{', --'.join(SAME)}, as of the rows that stay, and no --ablate")
    seeds = range(arguments.seed, arguments.seed + arguments.scenes)
    names = (
        arguments.family.split(",") if arguments.family else list(MESH_FAMILIES if arguments.matrix else ALL_FAMILIES)
    )
    arguments.out.mkdir(exist_ok=True)
    if arguments.ablate:
        from mitsuba_fspt.integral.surface.face_light import ColumnRule

        every = [field.name for field in fields(ColumnRule if arguments.matrix else Estimator)]
        wanted = every if arguments.ablate == "all" else arguments.ablate.split(",")
        path = arguments.out / f"ablation{'_matrix' * arguments.matrix}.csv"
        ablate([(one, seed) for one in names for seed in seeds], wanted, arguments.rtol, arguments.matrix, path)
        return
    name = "audit_matrix" if arguments.matrix else "audit"
    audits = _kept(arguments.out / f"{name}.csv", names) if arguments.keep else []
    for family in names:
        for seed in seeds:
            pixels = arguments.likely, arguments.random
            audits.append(audited(family, seed, arguments.rtol, *pixels, arguments.finer, arguments.matrix))
            _write(arguments.out / f"{name}.csv", audits)
        print(_row(family, [audit for audit in audits if audit.family == family], arguments.rtol), flush=True)
    text = table(audits, arguments.rtol)
    print(f"\n{text}")
    if arguments.readme:
        markdown_tables.write(arguments.readme, name, text)


def _kept(path: Path, names: Sequence[str]) -> list[Audit]:
    """Rows of a file, if there is one, but for those of families with these names."""
    if not path.exists():
        return []
    kinds = {"str": str, "int": int, "float": float}
    types = {field.name: kinds[str(field.type)] for field in fields(Audit)}
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["family"] not in names]
    return [Audit(**{name: types[name](value) for name, value in row.items()}) for row in rows]


def _write(path: Path, audits: Sequence[Audit]) -> None:
    """All rows so far: a run that is ended early leaves them."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        sheet = csv.DictWriter(file, list(asdict(audits[0])))
        sheet.writeheader()
        sheet.writerows({name: _text(value) for name, value in asdict(audit).items()} for audit in audits)


def audited(
    family: str,
    seed: int,
    rtol: float,
    likely: int = LIKELY,
    random: int = RANDOM,
    finer: int = 1,
    matrix: bool = False,
) -> Audit:
    """One scene of a family, rendered on a film of `finer` times as many pixels a side, and compared.

    matrix : the image is the product of the transport matrix and J_n of `_exitance`
    """
    backend.ensure_variant()
    import mitsuba as mi

    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        made = random_scene(family, seed, finer)
        made, image, seconds = _multiplied(made, seed, rtol) if matrix else (made, *_rendered(made, rtol))
    finally:
        mi.set_log_level(level)
    least = MATRIX_GOAL * rtol if matrix else LEAST_GOAL
    stated, difference, reference = _compared(made, image, likely, random, least)
    beyond = difference - reference > rtol
    missed = difference - reference > stated
    wide = stated > WIDE * rtol
    true = np.maximum(np.maximum(difference, reference), LEAST_TRUE)[wide]
    _, _, width, height = made.crop
    power = image.power.max()
    return Audit(
        family,
        seed,
        made.reference.camera.f_number,
        width,
        height,
        likely,
        random,
        int(beyond[:likely].sum()),
        int(beyond[likely:].sum()),
        int((difference - reference > 5 * rtol).sum()),
        int(missed.sum()),
        int((missed & beyond & (stated <= rtol)).sum()),
        float(difference.max()),
        float(np.median(stated[wide] / true)) if wide.any() else float("nan"),
        int((image.error > rtol * power).sum()),
        float(reference.max()),
        seconds,
    )


def _rendered(made: RandomScene, rtol: float) -> tuple[fspt.Image, float]:
    """Image of a scene, and its run time [s] with compiled kernels."""
    scene, seconds = made.scene(), np.inf
    for _ in range(2):
        began = time.perf_counter()
        image = fspt.render(scene, method="integral", rtol=rtol, pixel=made.reference.pixel)
        seconds = min(seconds, time.perf_counter() - began)
        if seconds < SLOW:
            break
    return image, seconds


def _multiplied(made: RandomScene, seed: int, rtol: float) -> tuple[RandomScene, fspt.Image, float]:
    """The scene with J_n of `_exitance`, its image by the transport matrix, and the run time of the matrix [s].

    J_n is on vertices for even seeds, else on faces; it is random in two scenes, and has a spot in the next two.
    """
    on, scene, began = ("vertex", "face")[seed % 2], made.scene(), time.perf_counter()
    transport = fspt.transport(scene, on=on, rtol=rtol)
    seconds = time.perf_counter() - began
    generator, bodies, exitance = np.random.default_rng([2, seed]), [], []
    for body in made.reference.bodies:
        if isinstance(body.shape, Triangles) and body.exitance is not None:
            values = _exitance(body.shape, on, bool(seed // 2 % 2), generator)
            corners = values[body.shape.faces] if on == "vertex" else np.repeat(values[:, None], 3, axis=1)
            exitance.append(values)
            body = replace(body, exitance=linear_on(body.shape.vertices, body.shape.faces, corners), most=values.max())
        bodies.append(body)
    given = np.concatenate(exitance)
    filled = transport.forward(np.ones(len(given)))[0]
    image = fspt.Image(
        transport.forward(given)[0], transport.error(given)[0], np.minimum(filled / (FILLED * filled.max()), 1), {}
    )
    return replace(made, reference=replace(made.reference, bodies=bodies)), image, seconds


def _exitance(mesh: Triangles, on: str, spot: bool, generator: np.random.Generator) -> np.ndarray:
    """J_n on the vertices or faces of a mesh [W/mm²]: a spot of half its size, or random over two decades."""
    places = mesh.vertices if on == "vertex" else mesh.vertices[mesh.faces].mean(axis=1)
    if not spot:
        return 10 ** generator.uniform(-2, 0, len(places))
    squared = ((places - places[generator.integers(len(places))]) ** 2).sum(axis=1)
    return 1e-3 + np.exp(-4 * squared / squared.max())


def _compared(
    made: RandomScene, image: fspt.Image, likely: int, random: int, least: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stated error, difference and error of the reference on checked pixels, over the brightest pixel, each (n,).

    least : smallest error at which the reference is aimed, over the brightest pixel
    """
    peak = image.power.max() or 1.0
    picked = _picked(image, likely, random)
    stated = image.error.ravel()[picked] / peak
    power, error = _reference(made, picked, peak * np.maximum(GOAL * stated, least))
    return stated, np.abs(image.power.ravel()[picked] - power) / peak, error / peak


def _picked(image: fspt.Image, likely: int, random: int) -> np.ndarray:
    """Numbers of the pixels that are compared."""
    generator = np.random.default_rng(1)
    return np.array([*_likely(image, likely, generator), *generator.integers(0, image.power.size, random)])


def _reference(made: RandomScene, picked: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reference power of the pixels with these numbers [W], and its error."""
    left, top, width, _ = made.crop
    row, column = np.divmod(picked, width)
    return made.reference.power(np.stack([row + top, column + left], axis=1), goal)


def _likely(image: fspt.Image, count: int, generator: np.random.Generator) -> np.ndarray:
    """Numbers of pixels where errors are likely: half with the largest stated errors, half random ones at edges."""
    power = image.power
    bend = sum(np.abs(np.gradient(np.gradient(power, axis=k), axis=k)) for k in (0, 1) if power.shape[k] > 2)
    edges = (bend > 0.02 * power.max()) | ((image.coverage > 0) & (image.coverage < 1))
    worst = np.argsort(-image.error.ravel(), kind="stable")[: count // 2]
    other = np.setdiff1d(np.flatnonzero(edges), worst)
    if len(other) < count - len(worst):
        other = np.setdiff1d(np.arange(power.size), worst)
    return np.concatenate([worst, generator.choice(other, count - len(worst), replace=False)])


@dataclass(frozen=True)
class Ablation:
    """Result for a number of scenes with the threshold `without` removed; 'nothing' removes none.

    scenes, pixels : number of scenes, and of all their pixels
    beyond, beyond_error, silent : of these beyond rtol; beyond the stated error; beyond both with less than rtol stated
    stated : pixels with a stated error above rtol
    work : lines of sight, or images of faces for a matrix [million]
    """

    without: str
    scenes: int
    pixels: int
    beyond: int
    beyond_error: int
    silent: int
    stated: int
    work: float


Computed = tuple[np.ndarray, np.ndarray, float]  # power and error [W], work


def ablate(scenes: Sequence[tuple[str, int]], names: Sequence[str], rtol: float, matrix: bool, path: Path) -> None:
    """Compute scenes, given by family and seed, with one of these thresholds removed at a time; writes a table."""
    backend.ensure_variant()
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)
    compute = _product_without if matrix else _image_without
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in ("nothing", *names)}
    for family, seed in scenes:
        finer, uncertain, _ = compute(family, seed, rtol / 10, "nothing", FINER_NODES)
        most = rtol * finer.max()
        for name, rows in found.items():
            power, error, work = compute(family, seed, rtol, name, None)
            off = np.abs(power - finer) - uncertain
            beyond, missed = off > most, off > error
            flags = beyond, missed, missed & beyond & (error <= most), error > most
            rows.append((power.size, *(float(flag.sum()) for flag in flags), work))
        print(family, seed, flush=True)
    table = []
    for name, rows in found.items():
        *counts, work = np.sum(rows, axis=0)
        table.append(Ablation(name, len(rows), *(int(count) for count in counts), round(float(work) / 1e6, 2)))
        print(table[-1], flush=True)
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        sheet = csv.DictWriter(file, list(asdict(table[0])))
        sheet.writeheader()
        sheet.writerows(asdict(one) for one in table)


def _image_without(family: str, seed: int, rtol: float, name: str, most_nodes: int | None) -> Computed:
    """The image without one threshold."""
    import mitsuba as mi

    made, estimator = random_scene(family, seed), Estimator() if name == "nothing" else Estimator().without(name)
    quadrature = Quadrature(rtol=rtol, pixel=made.reference.pixel, max_nodes=most_nodes, estimator=estimator)
    scene = made.scene()
    solution = mi.load_dict({"type": "fspt_integral"}).solve(scene, scene.sensors()[0], quadrature)
    return solution.power, solution.error, float(solution.rays)


def _product_without(family: str, seed: int, rtol: float, name: str, most_nodes: int | None) -> Computed:
    """The product of the matrix and J_n without one threshold of its columns."""
    from mitsuba_fspt.integral.surface.column_form import FaceLines
    from mitsuba_fspt.integral.surface.face_light import ColumnRule

    rule, numbered, work = ColumnRule.of, FaceLines.numbered, [0.0]

    def counted(items: np.ndarray) -> FaceLines:
        work[0] += float(((items[1] * items[2]) ** 2).sum())
        return numbered(items)

    wanted = (lambda rtol: rule(rtol).without(name)) if name != "nothing" else rule
    with mock.patch.object(ColumnRule, "of", wanted), mock.patch.object(FaceLines, "numbered", counted):
        _, image, _ = _multiplied(random_scene(family, seed), seed, rtol)
    return image.power, image.error, work[0]


def table(audits: Sequence[Audit], rtol: float) -> str:
    """The table by family, as Markdown."""
    families = list(dict.fromkeys(audit.family for audit in audits))
    rows = [_row(family, [audit for audit in audits if audit.family == family], rtol) for family in families]
    head = f"| rtol {rtol:g} | {' | '.join(HEAD)} |\n|---|{'---|' * len(HEAD)}"
    return "\n".join([head, *rows, _row("all", audits, rtol)])


def _row(name: str, audits: Sequence[Audit], rtol: float) -> str:
    def share(column: str, *of: str) -> str:
        pixels = sum(getattr(audit, number) for audit in audits for number in of)
        return f"{100 * sum(getattr(audit, column) for audit in audits) / pixels:.2f} %"

    checked = ("likely", "random")
    widths = [audit.width for audit in audits if np.isfinite(audit.width)]
    beyond = sum(audit.stated > 0 for audit in audits)
    cells = (
        str(len(audits)),
        share("beyond_likely", "likely"),
        share("beyond_random", "random"),
        str(sum(audit.beyond_5 for audit in audits)),
        share("beyond_error", *checked),
        share("silent", *checked),
        f"{np.median(widths):.0f}" if widths else "–",
        f"{100 * beyond / len(audits):.0f} %",
        f"{max(audit.seconds for audit in audits):.1f}",
    )
    return f"| {name} | {' | '.join(cells)} |"


def _text(value: object) -> object:
    return f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    main()
