"""Error against run time on the nylon cylinder: `fspt_integral` and Mitsuba's `path` with each stock sampler.

    python scripts/work_precision.py [--truth FILE.npz] [--out docs]

f/2.8, focused on the phantom's front, magnification 0.5, 256 x 256 pixels. The truth is the float64 reference, which
shares no code with the plugins and states its own error; it takes minutes, so it is kept in FILE.npz and read from
there the next time. Every setting is timed warm, in one process, in rounds that go through all settings in turn, so
that a slow moment of the machine meets them all; the median over the rounds counts.

Errors are RMS over all pixels, and over the pixels whose whole cone sees the phantom, relative to the brightest pixel.
Writes work_precision.csv and work_precision.png, prints the time each method needs for an error and the ratios.
"""

from __future__ import annotations

import argparse
import copy
import csv
import os
import platform
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mitsuba_fspt as fspt
from mitsuba_fspt.atomic import atomic_path
from mitsuba_fspt.reference import Camera, look_at
from mitsuba_fspt.reference_mesh import load_ply, mesh_truth

SCENES = Path(__file__).resolve().parent.parent / "scenes"
ROUNDS = 5
RTOL = (0.2, 0.05, 0.02, 0.014, 0.01, 5e-3, 2e-3, 1e-3, 3e-4, 1e-4)
SPP = {"multijitter": (4, 16, 36, 64, 100, 144, 256, 529), "independent": (16, 64, 256)}
SPP |= {"stratified": (16, 64, 256), "orthogonal": (25, 121, 289), "ldsampler": (16, 64, 256)}
TARGETS = (("all", 1e-4), ("full", 3e-5), ("all", 3e-5), ("all", 1e-5))

Picture = NDArray[np.float64]


@dataclass
class Setting:
    """One method at one accuracy: how to run it, and what the runs gave."""

    method: str
    knob: float
    run: Callable[[], Picture]
    seconds: list[float] = field(default_factory=list)
    rms: dict[str, float] = field(default_factory=dict)


def main() -> None:
    """Measure, write the files, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truth", type=Path, default=Path("out/nylon_cylinder_truth.npz"))
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    arguments = parser.parse_args()
    truth, truth_error = read_truth(arguments.truth)
    cylinder = scene()
    settings = integral_settings(cylinder) + path_settings(cylinder)
    full = fspt.render(cylinder, rtol=1e-4).coverage > 1 - 1e-4  # a sum of float32 weights
    measure(settings, truth, {"all": np.ones_like(full), "full": full}, arguments.rounds)
    arguments.out.mkdir(exist_ok=True)
    write_csv(settings, arguments.out / "work_precision.csv")
    stated = float(np.sqrt(np.mean(truth_error**2)) / truth.max())
    draw(settings, stated, arguments.out / "work_precision.png")
    report(settings, stated, int(full.sum()))


# ---------------------------------------------------------------------- truth


def read_truth(path: Path) -> tuple[Picture, Picture]:
    """Power and its error [W] of the float64 reference; made and kept if the file is not there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        camera = Camera(55, 2.8, 165, 0.108, 256, 256, look_at([180, 0, 0], [0, 0, 0], [0, 0, 1]))
        power, error = mesh_truth(camera, load_ply(SCENES / "nylon_cylinder.ply"))
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, power=power, error=error)
    with np.load(path) as stored:
        return stored["power"], stored["error"]


# ---------------------------------------------------------------------- methods


def scene() -> object:
    """The cylinder at f/2.8 before one camera a stock sampler: one scene, since every living one costs all kernels."""
    tree = ElementTree.parse(SCENES / "nylon_cylinder.xml")
    sensor = next(tree.iter("sensor"))
    for node in sensor.findall("sampler"):
        sensor.remove(node)
    for sampler in SPP:
        camera = copy.deepcopy(sensor)
        ElementTree.SubElement(camera, "sampler", type=sampler)
        tree.getroot().append(camera)
    tree.getroot().remove(sensor)
    mesh = next(node for node in tree.iter("string") if node.get("name") == "filename")
    mesh.set("value", str(SCENES / mesh.get("value", "")))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "nylon_cylinder.xml"
        tree.write(path)
        return fspt.load(path, f_number=2.8)


def integral_settings(cylinder: object) -> list[Setting]:
    """The integral over rtol, and with four lines of sight a pixel and no more."""
    import mitsuba as mi

    lens = cylinder.sensors()[0]

    def setting(method: str, knob: float, **accuracy: float) -> Setting:
        integrator = mi.load_dict({"type": "fspt_integral", **accuracy})
        return Setting(method, knob, lambda: integrator.solve(cylinder, lens).power)

    return [setting("integral", rtol, rtol=rtol) for rtol in RTOL] + [
        setting("integral, 4 nodes", 4, rtol=1e-3, max_nodes=4)
    ]


def path_settings(cylinder: object) -> list[Setting]:
    """Mitsuba's `path` of depth 1 over the samples a pixel, with each sampler."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "path", "max_depth": 1})

    def setting(sampler: str, sensor: object, spp: int) -> Setting:
        seed = iter(range(1, 1 << 30))

        def run() -> Picture:
            return np.array(integrator.render(cylinder, sensor, seed=next(seed), spp=spp), np.float64)[..., 0]

        return Setting(f"path, {sampler}", spp, run)

    cameras = zip(SPP, cylinder.sensors(), strict=True)
    return [setting(sampler, sensor, spp) for sampler, sensor in cameras for spp in SPP[sampler]]


def measure(settings: list[Setting], truth: Picture, masks: dict[str, NDArray[np.bool_]], rounds: int) -> None:
    """Time every setting once a round, after a first run that compiles and is not counted."""
    for k in range(rounds + 1):
        for setting in settings:
            start = time.perf_counter()
            power = setting.run()
            seconds = time.perf_counter() - start
            if k == 0:
                continue
            setting.seconds.append(seconds)
            for name, mask in masks.items():
                mean_square = np.mean((power - truth)[mask] ** 2) / truth.max() ** 2
                # Monte Carlo errors differ from seed to seed: the RMS over the rounds.
                setting.rms[name] = float(np.sqrt((setting.rms.get(name, 0) ** 2 * (k - 1) + mean_square) / k))


def time_to(settings: list[Setting], method: str, pixels: str, target: float) -> float:
    """Least time [s] in which a method gets below an error; NaN where no setting does.

    Between two neighbouring settings the power law through both is followed.
    """
    points = sorted((np.median(s.seconds), s.rms[pixels]) for s in settings if s.method.startswith(method))
    best = np.nan
    for (t0, e0), (t1, e1) in zip([points[0], *points], [*points, points[-1]], strict=True):
        if e1 <= target < e0:
            t = t0 * (t1 / t0) ** (np.log(e0 / target) / np.log(e0 / e1))
        elif e1 <= target:
            t = t1
        else:
            continue
        best = t if np.isnan(best) else min(best, t)
    return float(best)


# ---------------------------------------------------------------------- output


def write_csv(settings: list[Setting], path: Path) -> None:
    """One row a setting: method, knob, median, least and largest time [s], both RMS errors over the peak."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["method", "knob", "seconds_median", "seconds_min", "seconds_max", "rms_all", "rms_full"])
        for s in settings:
            times = [f"{f(s.seconds):.5f}" for f in (np.median, min, max)]
            rows.writerow([s.method, f"{s.knob:g}", *times, f"{s.rms['all']:.4e}", f"{s.rms['full']:.4e}"])


def draw(settings: list[Setting], stated: float, path: Path) -> None:
    """Error over time, all pixels and those whose whole cone sees the phantom."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.6), layout="constrained")
    titles = {"all": "all pixels", "full": "pixels whose whole cone sees the phantom"}
    for axes, (pixels, title) in zip(figure.subplots(1, 2, sharey=True), titles.items(), strict=True):
        for method in dict.fromkeys(s.method for s in settings):
            points = [(np.median(s.seconds), s.rms[pixels]) for s in settings if s.method == method]
            width = 2.0 if method in ("integral", "path, multijitter") else 0.9
            axes.loglog(*zip(*points, strict=True), "o-", markersize=3.5, linewidth=width, label=method)
        axes.axhline(stated, color="grey", linestyle=":", linewidth=1)
        axes.text(axes.get_xlim()[0], stated * 1.1, "stated error of the truth", color="grey", fontsize="small")
        axes.set(xlabel="run time, warm [s]", title=title)
        axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.axes[0].set_ylabel("RMS error / brightest pixel")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


def report(settings: list[Setting], stated: float, full: int) -> None:
    """Times to an error and the ratios, as a Markdown table."""
    print(f"{os.cpu_count()} cores, {platform.machine()}; truth: float64 reference, stated RMS error {stated:.1e}")
    print(f"'full': the {full} pixels whose whole cone sees the phantom\n")
    print("| pixels | RMS error | integral | path, multijitter | ratio | best other sampler |")
    print("|---|---|---|---|---|---|")
    others = [f"path, {sampler}" for sampler in SPP if sampler != "multijitter"]
    for pixels, target in TARGETS:
        ours, peer = (time_to(settings, method, pixels, target) for method in ("integral", "path, multijitter"))
        times = {method: time_to(settings, method, pixels, target) for method in others}
        reached = {method: t for method, t in times.items() if not np.isnan(t)}
        other = min(reached, key=reached.__getitem__, default="none gets there")
        note = f"{other[6:]} {reached[other]:.3g} s" if reached else other
        print(f"| {pixels} | {target:g} | {_time(ours)} | {_time(peer)} | {peer / ours:.0f} | {note} |")


def _time(seconds: float) -> str:
    return "not reached" if np.isnan(seconds) else f"{seconds * 1e3:.0f} ms"


if __name__ == "__main__":
    main()
