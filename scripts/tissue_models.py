"""SP3 and the diffusion equation against photons one by one: exit power of spheres and cylinders, in all and by bins.

    python scripts/tissue_models.py [--photons 8e6] [--edge 1.5] [--page docs/emission.md] [-o docs/tissue_models.csv]
    python scripts/tissue_models.py --border [--photons 3e6]
    python scripts/tissue_models.py --creases [--photons 4e6]
    python scripts/tissue_models.py --errors

Lengths of the phantoms are in mean free paths of µs' = 1/mm. Each line is one phantom: body, depth of the source's
surface, µa, n. Columns: standard error of the total by photons [%], and for both models deviation of the total, of the
brightest bin, and largest deviation of a bin beyond twice its standard error, over the bins whose standard error is
below 1 % [%]; and least squares of the deviation of J_n by c0 + c1 (2µ - 1) + c2 (6µ² - 6µ + 1), Eq. M.51, weighted by
the exit power, with the rms of the rest [%]. Bins of a sphere are rings of 12° about the axis of the source; of a
cylinder, seven sectors by three heights of its side, and two halves of its caps.

`--errors` fits the numbers of the stated error of each model, Eq. M.51, to these coefficients in the CSV file: least
squares of the squares of c0 by t², and of c1 and c2 by s².

`--border` prints β, the fall of the extrapolation length with the curvature of the border that Eq. M.48 takes from
photons, of an index and an anisotropy g: from spheres with a source in the middle, as the length with which the SP3
equations give the photons' exit power.

`--creases` prints the deviation of J_n of both models from photons in strips of a quarter of a mean free path from the
rim of a cylinder of 8 by 16, on its side and on its cap, a source 4 below both; and the least squares of e in e exp(-d)
for the mean deviation of strips of two mean free paths, Eq. M.51.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import tests_folder  # noqa: F401
from closed_forms import coupled_ball_exitance
from csv_table import write_rows
from numpy.typing import NDArray
from paper_common import Table, fill
from scipy.optimize import brentq, nnls

from mitsuba_fspt.inverse.model_error import MODEL_ERRORS, ModelError, shapes
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.diffusion import solve
from mitsuba_fspt.tissue.elements import import_skfem
from mitsuba_fspt.tissue.light_models import MODELS, equations
from mitsuba_fspt.tissue.tetrahedra import Tetrahedra

backend.ensure_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from photon_walk import BATCHES, Body, Emitter, Optics, exit_power  # noqa: E402

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
RING = math.pi / 15  # of the bins of a sphere
SECTORS = np.radians([0, 12, 25, 45, 70, 100, 140, 180])
HEIGHTS = np.array([0, 0.15, 0.4, 1.0])  # bounds of |z| over half the height
RULE = 6  # Gauss' nodes a bin and direction
KNOWN = 0.01  # largest relative standard error of a bin that counts


@dataclass(frozen=True)
class Case:
    """A phantom: body, depth of the source [mm], µa, n; radius of the source, and g of the phase function."""

    body: Body
    depth: float
    mua: float
    n: float
    ball: float = 0.0
    g: float = 0.0

    @property
    def name(self) -> str:
        """Body and what is special."""
        r, h = self.body.radius, self.body.height
        name = f"cylinder {r:g} × {h:g}" if h else f"sphere {r:g}"
        name += f", source of radius {self.ball:g}" if self.ball else ""
        return name + (f", g = {self.g:g}" if self.g else "")

    @property
    def centre(self) -> tuple[float, float, float]:
        """Of the source: on the z axis of a sphere, on the x axis of a cylinder."""
        at = self.body.radius - self.depth - self.ball
        return (at, 0.0, 0.0) if self.body.height else (0.0, 0.0, at)


LARGE, SMALL, THIN = Body(15), Body(8), Body(10, 30)
CASES = (
    Case(LARGE, 3, 0.005, 1.37),
    Case(LARGE, 3, 0.03, 1.37),
    Case(LARGE, 3, 0.1, 1.37),
    Case(LARGE, 3, 0.03, 1.33),
    Case(LARGE, 3, 0.03, 1.5),
    Case(LARGE, 6, 0.005, 1.5),
    Case(LARGE, 6, 0.03, 1.37),
    Case(LARGE, 6, 0.1, 1.33),
    Case(LARGE, 3, 0.03, 1.37, ball=2),
    Case(LARGE, 3, 0.03, 1.37, g=0.9),
    Case(LARGE, 4, 0.03, 1.37, g=0.9),
    Case(LARGE, 6, 0.03, 1.37, g=0.9),
    Case(LARGE, 3, 0.1, 1.37, g=0.9),
    Case(LARGE, 6, 0.1, 1.37, g=0.9),
    Case(SMALL, 3, 0.03, 1.37),
    Case(SMALL, 5, 0.1, 1.5),
    Case(THIN, 3, 0.005, 1.37),
    Case(THIN, 3, 0.03, 1.5),
    Case(THIN, 4, 0.09, 1.37),
    Case(THIN, 6, 0.03, 1.37),
    Case(THIN, 6, 0.1, 1.5),
    Case(Body(15, 30), 7, 0.0138, 1.37),
)


def ball(radius: float, edge: float) -> Tetrahedra:
    """Tetrahedra of a sphere with edges of about `edge` [mm] or less."""
    skfem = import_skfem()
    for refinements in range(1, 7):
        grid = skfem.MeshTet1.init_ball(refinements)
        mesh = Tetrahedra(
            radius * grid.p.T,
            grid.t.T,
            snap=lambda points: points * (radius / np.linalg.norm(points, axis=1, keepdims=True)),
        )
        if mesh.edge < 1.2 * edge:
            break
    return mesh


# ---------------------------------------------------------------------- bins of the surface


def bins(body: Body) -> tuple[Callable[[mi.Point3f], mi.UInt32], list[tuple[Array, Array]]]:
    """Function from points to numbers of bins for the photons, and points (k, 3) and areas (k,) of each bin's nodes."""
    if not body.height:
        polar = np.linspace(0, math.pi, round(math.pi / RING) + 1)
        return _ring, [_on_sphere(body.radius, *ends) for ends in pairwise(polar)]
    sides = [_on_side(body, sector, height) for sector in pairwise(SECTORS) for height in pairwise(HEIGHTS)]
    return lambda p: _sector(body, p), [*sides, _on_cap(body, 0), _on_cap(body, math.pi / 2)]


def _ring(p: mi.Point3f) -> mi.UInt32:
    angle = dr.acos(dr.clip(p.z / dr.norm(p), -1, 1))
    return dr.minimum(mi.UInt32(angle / RING), round(math.pi / RING) - 1)


def _sector(body: Body, p: mi.Point3f) -> mi.UInt32:
    angle, height = dr.abs(dr.atan2(p.y, p.x)), dr.abs(p.z) / (body.height / 2)
    sector = sum((dr.select(angle >= bound, mi.UInt32(1), mi.UInt32(0)) for bound in SECTORS[1:-1]), mi.UInt32(0))
    row = sum((dr.select(height >= bound, mi.UInt32(1), mi.UInt32(0)) for bound in HEIGHTS[1:-1]), mi.UInt32(0))
    side = sector * (len(HEIGHTS) - 1) + row
    first_cap = (len(SECTORS) - 1) * (len(HEIGHTS) - 1)
    cap = dr.select(p.x > 0, mi.UInt32(first_cap), mi.UInt32(first_cap + 1))
    return dr.select(height > 1 - 1e-5, cap, side)


def _nodes(low: float, high: float) -> tuple[Array, Array]:
    x, weight = np.polynomial.legendre.leggauss(RULE)
    return (low + high) / 2 + (high - low) / 2 * x, (high - low) / 2 * weight


def _on_sphere(radius: float, low: float, high: float) -> tuple[Array, Array]:
    cosine, weight = _nodes(math.cos(high), math.cos(low))
    turn = 2 * math.pi * np.arange(12) / 12
    u, t = (grid.ravel() for grid in np.meshgrid(cosine, turn, indexing="ij"))
    sine = np.sqrt(1 - u**2)
    points = radius * np.column_stack([sine * np.cos(t), sine * np.sin(t), u])
    return points, np.repeat(weight, 12) * (2 * math.pi / 12 * radius**2)


def _on_side(body: Body, sector: tuple[float, float], height: tuple[float, float]) -> tuple[Array, Array]:
    (t, wt), (z, wz) = _nodes(*sector), _nodes(*(body.height / 2 * np.array(height)))
    turn, up = (grid.ravel() for grid in np.meshgrid(t, z, indexing="ij"))
    points = np.column_stack([body.radius * np.cos(turn), body.radius * np.sin(turn), up])
    return points, 4 * body.radius * np.outer(wt, wz).ravel()  # mirror images in y and z


def _on_cap(body: Body, first: float) -> tuple[Array, Array]:
    (r2, wr), (t, wt) = _nodes(0, 1), _nodes(first, first + math.pi / 2)
    square, turn = (grid.ravel() for grid in np.meshgrid(r2, t, indexing="ij"))
    r = body.radius * np.sqrt(square)
    points = np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(len(r), body.height / 2)])
    return points, 4 * body.radius**2 / 2 * np.outer(wr, wt).ravel()


# ---------------------------------------------------------------------- comparison


def solved(case: Case, model: str, edge: float, places: Sequence[tuple[Array, Array]]) -> tuple[float, Array, float]:
    """Exit power in all and by bins of 1 W under a model, and CPU seconds."""
    body, start = case.body, time.process_time()
    mesh = cylinder_tetrahedra(body.radius, body.height, edge) if body.height else ball(body.radius, edge)
    medium = Medium(case.mua, 1.0, case.n, case.g)
    solution = solve(mesh, [medium], [Source(Sphere(case.centre, case.ball))], model=model)
    values = np.array([areas @ solution.exitance_at(points) for points, areas in places])
    return solution.solved.exited, values, time.process_time() - start


def row(case: Case, photons: int, edge: float) -> dict[str, object]:
    """A line of the table."""
    bin_of, places = bins(case.body)
    photons = photons // 64 * 32 if case.g else photons  # ten times as many flights
    optics = Optics(case.mua, 1.0, case.n, case.g)
    batches = exit_power(case.body, optics, Emitter(case.centre, case.ball), bin_of, len(places), photons)
    power, error = batches.mean(axis=0), batches.std(axis=0, ddof=1) / math.sqrt(BATCHES)
    total, total_error = batches.sum(axis=1).mean(), batches.sum(axis=1).std(ddof=1) / math.sqrt(BATCHES)
    area = np.array([areas.sum() for _, areas in places])
    known = np.flatnonzero(error < KNOWN * power)
    brightest = known[np.argmax(power[known] / area[known])]
    line: dict[str, object] = {"phantom": case.name, "depth": case.depth, "mua": case.mua, "n": case.n}
    line |= {"photons": photons, "bins": len(known)}
    line["error"] = 100 * total_error / total
    for model in MODELS:
        exited, values, seconds = solved(case, model, edge, places)
        deviation = values / power - 1
        beyond = np.maximum(np.abs(deviation) - 2 * error / power, 0) * np.sign(deviation)
        line[f"{model}_total"] = 100 * (exited / total - 1)
        line[f"{model}_peak"] = 100 * deviation[brightest]
        line[f"{model}_bin"] = 100 * beyond[known[np.argmax(np.abs(beyond[known]))]]
        line[f"{model}_rms"] = 100 * math.sqrt(np.average(deviation[known] ** 2, weights=power[known]))
        for k, value in enumerate(_polynomial(case, places, deviation, power, known)):
            line[f"{model}_{('c0', 'c1', 'c2', 'rest')[k]}"] = 100 * value
        line[f"{model}_seconds"] = seconds
    return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in line.items()}


def _polynomial(
    case: Case, places: Sequence[tuple[Array, Array]], deviation: Array, power: Array, known: NDArray[np.int64]
) -> list[float]:
    """c0, c1, c2 of M.51 for the relative deviations of the bins, and the rms of what they leave."""
    rows = []
    for points, areas in places:
        cosine = (case.depth + case.ball) / np.linalg.norm(points - np.array(case.centre), axis=1)
        rows.append([areas @ one / areas.sum() for one in (np.ones_like(cosine), *shapes(cosine))])
    design, weight = np.array(rows)[known], np.sqrt(power[known] / power[known].sum())
    found = np.linalg.lstsq(design * weight[:, None], deviation[known] * weight)[0]
    return [*found.tolist(), float(np.linalg.norm((deviation[known] - design @ found) * weight))]


def print_errors(path: Path) -> None:
    """Print the four numbers of each model's stated error, and rms over stated sd of c0, and of c1 and c2."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    absorption = np.array([float(row["mua"]) for row in rows])
    depth = np.array([float(row["depth"]) for row in rows]) * (1 + absorption)
    for model in MODELS:
        c0, c1, c2 = (np.array([float(row[f"{model}_c{k}"]) for row in rows]) / 100 for k in range(3))
        t2, s2 = c0**2, (c1**2 + c2**2) / 2
        basis = np.column_stack([np.ones_like(depth), (absorption * depth) ** 2])
        total = np.sqrt(nnls(basis / t2.mean(), t2 / t2.mean())[0])
        shape = np.sqrt(nnls(np.column_stack([depth**-2.0, absorption**2]) / s2.mean(), s2 / s2.mean())[0])
        stated = ModelError(*total, *shape, MODEL_ERRORS[model].crease)
        t, s = np.transpose([stated.deviations(d, a) for d, a in zip(depth, absorption, strict=True)])
        used = np.transpose([MODEL_ERRORS[model].deviations(d, a) for d, a in zip(depth, absorption, strict=True)])
        print(model, stated, f"rms over stated {np.sqrt(np.mean(t2 / t**2)):.2f} {np.sqrt(np.mean(s2 / s**2)):.2f};")
        print(
            "  as in the package", *(f"{np.sqrt(np.mean(a / b**2)):.2f}" for a, b in zip((t2, s2), used, strict=True))
        )


def page_table(rows: Sequence[dict[str, object]]) -> Table:
    """The table of the page."""
    columns = {"phantom": "", "depth": "g", "µa": "g", "n": "g", "± total": ".2f"}
    columns |= {f"{model}, {what}": "+.1f" for model in MODELS for what in ("total", "peak", "bins")}
    keys = ["phantom", "depth", "mua", "n", "error"]
    keys += [f"{model}_{what}" for model in MODELS for what in ("total", "peak", "bin")]
    return Table("tissue-models", columns, [[line[key] for key in keys] for line in rows])


def print_border(photons: int) -> None:
    """Print β by n, g, radius and µa with its standard error."""
    for n in (1.0, 1.1, 1.2, 1.33, 1.4, 1.5, 1.7):
        for g in (0.0, 0.9):
            for radius, mua in ((6.0, 0.02), (12.0, 0.02), (24.0, 0.006), (6.0, 0.1)):
                value, error = curvature_of(n, g, radius, mua, photons if g == 0 else photons // 160 * 32)
                print(f"n {n:g}  g {g:g}  R {radius:g}  mua {mua:g}  beta {value:.3f} ± {error:.3f}", flush=True)


def print_creases(photons: int) -> None:
    """Print the deviation of J_n near the rim of a cylinder [%], and e of Eq. M.51."""
    body, at, strips = Body(8, 16), (4.0, 0.0, 4.0), 8
    distance = (np.arange(strips) + 0.5) / 4

    def bin_of(p: mi.Point3f) -> mi.UInt32:
        below, inner = body.height / 2 - p.z, body.radius - dr.sqrt(p.x * p.x + p.y * p.y)
        on_cap = below < 1e-4
        depth = mi.UInt32(dr.select(on_cap, inner, below) * 4)
        return dr.select(depth < strips, depth + dr.select(on_cap, mi.UInt32(strips), mi.UInt32(0)), 2 * strips)

    turn, wt = (np.arange(96) + 0.5) * math.pi / 48, math.pi / 48
    for n in (1.0, 1.37, 1.5):
        batches = exit_power(body, Optics(0.05, 1.0, n), Emitter(at), bin_of, 2 * strips + 1, photons)
        power = batches.mean(axis=0)[:-1].reshape(2, strips)
        error = batches.std(axis=0, ddof=1)[:-1].reshape(2, strips) / math.sqrt(BATCHES)
        print(f"n {n:g}: standard error of the photons", np.round(100 * error / power, 1).tolist())
        for model in MODELS:
            for edge in (1.5, 0.75):
                mesh = cylinder_tetrahedra(body.radius, body.height, edge)
                solution = solve(mesh, [Medium(0.05, 1.0, n)], [Source(Sphere(at))], model=model)
                found = np.zeros((2, strips))
                for strip in range(strips):
                    for d, wd in zip(*_nodes(strip / 4, (strip + 1) / 4), strict=True):
                        for cap in (0, 1):
                            radius, up = body.radius - cap * d, body.height / 2 - (1 - cap) * d
                            ring = [radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), up)]
                            found[cap, strip] += wd * wt * radius * solution.exitance_at(np.column_stack(ring)).sum()
                deviation, profile = found / power - 1, np.exp(-distance)
                least = math.sqrt((deviation**2).mean(axis=0) @ profile**2 / (profile**2 @ profile**2))
                print(f"  {model}, edge {edge:g}: e {least:.3f};", np.round(100 * deviation, 1).tolist(), flush=True)


def curvature_of(n: float, g: float, radius: float, mua: float, photons: int) -> tuple[float, float]:
    """β by a sphere with a source in its middle, and its standard error."""
    optics = Optics(mua, 1.0, n, g)
    batches = exit_power(Body(radius), optics, Emitter((0, 0, 0)), lambda p: mi.UInt32(0), 1, photons)
    power, error = batches.mean(), batches.std(ddof=1) / math.sqrt(BATCHES)
    found = equations("sp3", [Medium(mua, 1.0, n, g)])
    flat, scale = float(found.length[0]), radius * (1 + mua)

    def exited(length: float) -> float:
        matrix = found.border[0].copy()
        matrix[0, 0] += (1 / length - 1 / flat) / 3
        media = found.diffusion[0], found.reaction[0], found.source
        central = coupled_ball_exitance(radius, 0.0, *media, matrix, 0.0, np.zeros(1), orders=1)[0]
        return float(4 * math.pi * radius**2 * central)

    length = brentq(lambda z: exited(z) / power - 1, 0.2 * flat, 2 * flat)
    slope = (exited(1.01 * flat) / exited(flat) - 1) / (0.01 * flat)
    return (flat - length) * scale, error / power / abs(slope) * scale


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--photons", type=float, default=8e6, help="of each phantom")
    options.add_argument("--edge", type=float, default=1.5, help="of the tetrahedra [mm]")
    options.add_argument("--page", type=Path, default=ROOT / "docs" / "emission.md", help="page with the table")
    options.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "tissue_models.csv")
    options.add_argument("--border", action="store_true", help="print β, and end")
    options.add_argument("--creases", action="store_true", help="print J_n near the rim of a cylinder, and end")
    options.add_argument("--errors", action="store_true", help="print the numbers of the stated errors, and end")
    given = options.parse_args()
    photons = int(given.photons) // BATCHES * BATCHES
    if given.errors:
        print_errors(given.output)
        return
    if given.creases:
        print_creases(photons)
        return
    if given.border:
        print_border(photons)
        return
    rows = []
    for case in CASES:
        rows.append(row(case, photons, given.edge))
        print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    write_rows(given.output, rows)
    if given.page.exists():
        fill(given.page, [page_table(rows)])


if __name__ == "__main__":
    main()
