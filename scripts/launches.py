"""Kernel launches and time of a picture, on whatever Dr.Jit computes: is it bound by launches, by the host, by rays?

    python scripts/launches.py [--rounds 7] [--sides 256,2048] [--rtols 1e-2,1e-3] [--machine NAME] [-o FILE.csv]

The nylon cylinder at f/2.8 and the two spheres. Each row has the number of launches and the lines of sight of one warm
rendering, the time that kernels ran, the time of the whole rendering (median), and the time to trace four rays a pixel
and nothing else; from it follows the share of the bare rate of rays. The variant is that which `fspt doctor` would
choose; CUDA_VISIBLE_DEVICES="" hides the CUDA devices.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import backend

ROOT = Path(__file__).resolve().parent.parent
FIELD = {"nylon_cylinder": 27.648, "two_spheres": 27.648}  # mm: the detector's width
DEFINED = {"nylon_cylinder": {"f_number": 2.8}, "two_spheres": {}}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--sides", default="256,2048")
    parser.add_argument("--rtols", default="1e-2,1e-3")
    parser.add_argument("--machine", default="", help="first column of the table")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    print(backend.ensure_variant())
    rows = []
    for name in FIELD:
        for side in map(int, options.sides.split(",")):
            for rtol in map(float, options.rtols.split(",")):
                rows.append({"machine": options.machine} | measured(name, side, rtol, options.rounds))
                print(*(f"{key} {value}" for key, value in rows[-1].items()), sep="  ", flush=True)
    if options.output:
        import csv_table

        csv_table.write_rows(options.output, rows)


def measured(name: str, side: int, rtol: float, rounds: int) -> dict[str, object]:
    """One row of the table."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_fspt.studies.converge_methods import raw_rate

    size = {"width": side, "height": side, "pixel_pitch": FIELD[name] / side}
    scene = fspt.load(ROOT / "scenes" / f"{name}.xml", **DEFINED[name], **size)
    lens = scene.sensors()[0]
    integrator = mi.load_dict({"type": "fspt_integral", "rtol": rtol})
    for _ in range(2):
        integrator.solve(scene, lens)
    bare = raw_rate(scene, lens, True, least=1)
    bare()
    seconds, tracing = [], []
    for _ in range(rounds):
        start = time.perf_counter()
        rays = integrator.solve(scene, lens).rays
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
        start = time.perf_counter()
        count = bare()
        tracing.append((time.perf_counter() - start) / count)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        integrator.solve(scene, lens)
        dr.sync_thread()
        history = dr.kernel_history()
    total, ray = float(np.median(seconds)), float(np.median(tracing))
    return {
        "variant": mi.variant(),
        "scene": name,
        "side": side,
        "rtol": rtol,
        "ms": round(1e3 * total, 2),
        "launches": len(history),
        "kernels_ms": round(sum(float(entry.get("execution_time", 0)) for entry in history), 2),
        "lines_of_sight": rays,
        "bare_ns_a_ray": round(1e9 * ray, 2),
        "share_of_bare_rate": round(rays * ray / total, 3),
    }


if __name__ == "__main__":
    main()
