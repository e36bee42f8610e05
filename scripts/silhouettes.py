"""Order of convergence on silhouettes: error against lines of sight, where one edge crosses a pixel and where two do.

    python scripts/silhouettes.py [--f-number 2.8] [--pixels 24] [--out docs]

Two glowing spheres, the near one before the far one, as in scenes/two_spheres.xml. On the pixels whose four nodes a
silhouette parts: four and twelve nodes, ever more transects, as many on every pixel and each looked into as for rtol
1e-5, and lattices of ever more points. The reference, tests/references/fans.py in float64, finds the edges exactly and
shares no code with the integral; it is computed on so many random pixels of each kind, and the RMS of its own standard
error stands above each table. Errors are relative to the brightest pixel. The order p of error ∝ lines of sight^-p is
fitted where one edge crosses a pixel from twelve nodes to 24 transects, beyond which rounding is visible, where two do
from two transects on. Writes silhouettes.csv and prints the tables.
"""

from __future__ import annotations

import argparse
import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tests_folder  # noqa: F401
from references.bodies import Body, Simple
from references.camera import ReferenceCamera, Stops
from references.fans import CERTAIN, FanReference
from references.shapes import Sphere

from mitsuba_fspt.integral.pupil import node_rules
from mitsuba_fspt.runtime import backend
from mitsuba_fspt.runtime.atomic_files import atomic_path
from mitsuba_fspt.studies.convergence import fitted_order

if TYPE_CHECKING:
    from mitsuba_fspt.integral.pupil.draft import Draft

RTOL = 1e-5
GOAL, FANS = 3e-7, 8192  # of the reference: error over the brightest pixel at which it ends, fans at most
LATTICES = (1 << 10, 1 << 12, 1 << 14, 1 << 16)
SHARES = {"RMS": None, "median": 0.5, "90 %": 0.9, "99 %": 0.99}  # of the pixels that are no worse
FITTED = {
    "one edge": ("12 nodes", "2 transects", "8 transects", "24 transects"),
    "two edges": tuple(f"{count} transects" for count in node_rules.TRANSECT_LEVELS),
}
# Frame of the camera, which looks along +z: centre [mm], radius [mm], J_n [W/mm²].
SPHERES = {"far": ((0.0, 0.0, 175.0), 10.0, 1e-3), "near": ((-7.0, 4.0, 130.0), 5.0, 3e-3)}
LENS = {"focal_length": 55.0, "focus_distance": 165.0, "pixel_pitch": 0.108}
SIZE = 256


@dataclass(frozen=True)
class Rule:
    """Mean radiance on film [W/mm²/sr] on chosen pixels by one rule, and its lines of sight on a pixel."""

    name: str
    value: np.ndarray
    rays: float


def main() -> None:
    """Measure, write the file, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--f-number", type=float, default=2.8)
    parser.add_argument("--pixels", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    arguments.out.mkdir(exist_ok=True)
    backend.ensure_variant()
    cut = {name: parted_pixels(draft_of([name], arguments.f_number)) for name in SPHERES}
    draft = draft_of(list(SPHERES), arguments.f_number)
    mine = parted_pixels(draft)
    kinds = {"one edge": mine & (cut["far"] ^ cut["near"]), "two edges": mine & cut["far"] & cut["near"]}
    with atomic_path(arguments.out / "silhouettes.csv") as temporary, open(temporary, "w", newline="") as file:
        sheet = csv.writer(file)
        sheet.writerow(["pixels", "rule", "lines_of_sight_a_pixel", *SHARES])
        for kind, among in kinds.items():
            chosen = np.random.default_rng(1).permutation(np.flatnonzero(among))[: arguments.pixels]
            exact, standard_error = reference(arguments.f_number, chosen)
            peak = float(draft.peak[0])
            errors = [(rule, shares(np.abs(rule.value - exact) / peak)) for rule in rules(draft, chosen)]
            sheet.writerows([kind, r.name, f"{r.rays:.5g}", *map("{:.3g}".format, e)] for r, e in errors)
            uncertain = np.sqrt(np.mean(standard_error**2)) / peak
            title = f"{kind}, {len(chosen)} of {among.sum()} pixels, reference ± {uncertain:.0e}"
            report(title, errors, FITTED[kind])


def draft_of(names: list[str], f_number: float) -> Draft:
    """Draft of the image of these spheres, with its first four nodes."""
    import mitsuba as mi

    from mitsuba_fspt.integral.lines.eq9 import View
    from mitsuba_fspt.integral.lines.visible_window import visible_window
    from mitsuba_fspt.integral.pupil.draft import Draft
    from mitsuba_fspt.integral.pupil.nodes import first_nodes
    from mitsuba_fspt.integral.quadrature import Quadrature

    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "luminance"}
    scene = {"type": "scene", "sensor": {"type": "fspt_lens", "f_number": f_number, **LENS, "film": film}}
    for name in names:
        centre, radius, exitance = SPHERES[name]
        glow = {"type": "fspt_surface", "exitance": exitance}
        scene[name] = {"type": "sphere", "center": list(centre), "radius": radius, "emitter": glow}
    scene = mi.load_dict(scene)
    camera = scene.sensors()[0].camera
    window = visible_window(scene, camera)
    draft = Draft(View.of(scene, camera, window), window, Quadrature(rtol=RTOL), None)
    first_nodes(draft, np.zeros(window.shape))
    return draft


def parted_pixels(draft: Draft) -> np.ndarray:
    """True, one a pixel of the film row by row, where an edge parts the first nodes."""
    from mitsuba_fspt.jit.pixel_grid import parted

    return on_film(draft, parted(draft.coverage)) > 0


def on_film(draft: Draft, values: object) -> np.ndarray:
    """Values on the draft's window, one a pixel of the film row by row; 0 beyond the window."""
    return draft.window.expand(np.array(values, np.float64).reshape(draft.window.shape)).ravel()


def reference(f_number: float, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean radiance on film [W/mm²/sr] of pixels, numbered row by row, and its standard error, both in float64."""
    camera = ReferenceCamera(**LENS, f_number=f_number, width=SIZE, height=SIZE)
    bodies = [
        Body(Simple(Sphere(centre, radius)), lambda points, _, j=exitance: np.full(len(points), j), most=exitance)
        for centre, radius, exitance in SPHERES.values()
    ]
    etendue = camera.scale * math.pi  # [mm² sr] of a pixel on the axis
    goal = GOAL * camera.scale * max(exitance for *_, exitance in SPHERES.values())
    pixels = np.stack(np.unravel_index(chosen, (SIZE, SIZE)), axis=1)
    power, error = FanReference(camera, Stops.of(camera), bodies).power(pixels, goal, most=FANS)
    return power / etendue, error / etendue / CERTAIN


def rules(draft: Draft, chosen: np.ndarray) -> list[Rule]:
    """Every rule on the chosen pixels, numbered row by row."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_fspt.integral.pupil.lattices import SHIFTS, Means
    from mitsuba_fspt.integral.pupil.nodes import apply_nodes
    from mitsuba_fspt.integral.pupil.transects import apply_transects, edges_of

    marked = np.zeros(SIZE * SIZE, bool)
    marked[chosen] = True
    where = mi.Bool(draft.window.cut(marked.reshape(SIZE, SIZE)).ravel())
    found = []

    def note(name: str, value: object, since: int) -> None:
        found.append(Rule(name, on_film(draft, value)[chosen], (draft.rays - since) / len(chosen)))

    for rule in (node_rules.four(True), node_rules.twelve(True)):
        since = draft.rays
        note(f"{len(rule)} nodes", apply_nodes(draft, rule, where).value, since)
    edges = edges_of(draft)
    for level, count in enumerate(node_rules.TRANSECT_LEVELS):
        since = draft.rays
        along = node_rules.along_transect(level, RTOL)
        means = apply_transects(draft, where, edges, node_rules.transects(count), along)
        note(f"{count} transects", means.value, since)
        if level == 0:  # the edges that were met say how blurred they are
            edges.update(draft, means, where)
    means, since, last = Means.none(draft.grid.pixels(where)), draft.rays, 0
    for points in LATTICES:  # each with the points of the one before
        means, last = means.refined(draft, last, points), points
        lattice = dr.zeros(mi.Float64, dr.width(where))
        dr.scatter(lattice, means.value, means.pixels)
        note(f"{SHIFTS} lattices of {points}", lattice, since)
    return found


def shares(error: np.ndarray) -> list[float]:
    """Errors as in `SHARES`."""
    return [np.sqrt(np.mean(error**2)) if s is None else np.quantile(error, s) for s in SHARES.values()]


def report(title: str, measured: list[tuple[Rule, list[float]]], fitted: tuple[str, ...]) -> None:
    """The table of one kind of pixels, as Markdown, with the orders of the rules `fitted` and of lattices."""
    print(f"\n| {title} | lines of sight a pixel | {' | '.join(SHARES)} |\n|---|---|{'---|' * len(SHARES)}")
    for rule, errors in measured:
        print(f"| {rule.name} | {rule.rays:.0f} | {' | '.join(f'{e:.1e}' for e in errors)} |")
    groups = {
        f"order from {fitted[0]} to {fitted[-1]}": [entry for entry in measured if entry[0].name in fitted],
        "order of lattices": [entry for entry in measured if "lattices" in entry[0].name],
    }
    for name, group in groups.items():
        orders = [fitted_order([rule.rays for rule, _ in group], [e[k] for _, e in group]) for k in range(len(SHARES))]
        print(f"| {name} | | {' | '.join(f'{p:.2f}' if p else '–' for p in orders)} |")


if __name__ == "__main__":
    main()
