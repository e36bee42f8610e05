"""Order of convergence of transects on silhouettes: error against lines of sight.

    python scripts/silhouettes.py [SCENE.xml …] [--f-number 2.8] [--out docs]

On the pixels whose four nodes a silhouette parts: four and twelve nodes, then ever more transects, as many on every
pixel and each looked into as for rtol 1e-5, against 1024 transects. Errors relative to the brightest pixel; the order p
of error ∝ lines of sight^-p is fitted from twelve nodes to 24 transects, beyond which a cylinder's is rounding.
Writes silhouettes.csv and prints the table.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.integral import node_rules
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.studies.convergence import fitted_order

SCENES = ("scenes/nylon_cylinder.xml", "scenes/two_spheres.xml")
RTOL = 1e-5
SHARES = {"RMS": None, "median": 0.5, "90 %": 0.9, "99 %": 0.99}  # of the pixels that are no worse
FITTED = ("12 nodes", "2 transects", "8 transects", "24 transects")


def main() -> None:
    """Measure, write the file, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--f-number", type=float, default=2.8)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    arguments.out.mkdir(exist_ok=True)
    with atomic_path(arguments.out / "silhouettes.csv") as temporary, open(temporary, "w", newline="") as file:
        sheet = csv.writer(file)
        sheet.writerow(["scene", "rule", "lines_of_sight_a_pixel", *SHARES])
        for name in arguments.scenes:
            measured = measure(name, arguments.f_number)
            sheet.writerows(
                [Path(name).stem, rule, f"{rays:.5g}", *map("{:.3g}".format, e)] for rule, rays, e in measured
            )
            report(f"{Path(name).stem}, f/{arguments.f_number:g}", measured)


def measure(name: str, f_number: float) -> list[tuple[str, float, list[float]]]:
    """Of each rule its name, lines of sight a pixel, and errors as in `SHARES`."""
    backend.ensure_variant()
    import drjit as dr

    from mitsuba_fspt.integral.draft import Draft
    from mitsuba_fspt.integral.eq9 import View
    from mitsuba_fspt.integral.nodes import apply_nodes, first_nodes
    from mitsuba_fspt.integral.quadrature import Quadrature
    from mitsuba_fspt.integral.transects import apply_transects, edges_of
    from mitsuba_fspt.integral.window import visible_window
    from mitsuba_fspt.jit.pixel_grid import parted

    scene = fspt.load(name, f_number=f_number)
    lens = scene.sensors()[0]
    window = visible_window(scene, lens)
    draft = Draft(View.of(scene, lens, window), window, Quadrature(rtol=RTOL), None)
    first_nodes(draft, np.zeros(window.shape))
    cut = parted(draft.coverage)
    pixels = np.array(dr.compress(cut))
    peak = float(draft.peak[0])
    values, rays = {}, {}

    def note(rule: str, value: object, since: int) -> None:
        values[rule] = np.array(value)[pixels] / peak
        rays[rule] = (draft.rays - since) / len(pixels)

    for rule in (node_rules.four(True), node_rules.twelve(True)):
        since = draft.rays
        note(f"{len(rule)} nodes", apply_nodes(draft, rule, cut).value, since)
    edges = edges_of(draft)
    for level, count in enumerate(node_rules.TRANSECT_LEVELS):
        since = draft.rays
        means = apply_transects(draft, cut, edges, node_rules.transects(count), node_rules.along_transect(level, RTOL))
        note(f"{count} transects", means.value, since)
        if level == 0:  # the edges that were met say how blurred they are
            edges.learn(draft, means, cut)
    finest = values.pop(f"{node_rules.TRANSECT_LEVELS[-1]} transects")
    return [(rule, rays[rule], shares(np.abs(value - finest))) for rule, value in values.items()]


def shares(error: np.ndarray) -> list[float]:
    """Errors as in `SHARES`."""
    return [np.sqrt(np.mean(error**2)) if s is None else np.quantile(error, s) for s in SHARES.values()]


def report(title: str, measured: list[tuple[str, float, list[float]]]) -> None:
    """The table of a scene, as Markdown."""
    print(f"\n| {title} | lines of sight a pixel | {' | '.join(SHARES)} |\n|---|---|{'---|' * len(SHARES)}")
    for rule, rays, errors in measured:
        print(f"| {rule} | {rays:.0f} | {' | '.join(f'{e:.1e}' for e in errors)} |")
    fitted = [(rays, errors) for rule, rays, errors in measured if rule in FITTED]
    orders = [fitted_order([rays for rays, _ in fitted], [e[k] for _, e in fitted]) for k in range(len(SHARES))]
    print(f"| order | | {' | '.join(f'{p:.2f}' if p else '–' for p in orders)} |")


if __name__ == "__main__":
    main()
