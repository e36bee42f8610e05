"""Start times: of the import, and of a rendering from the start of the process, with and without kernels on disk.

    python scripts/start_time.py [--scene scenes/nylon_cylinder.xml] [--rounds 5]

Every measurement is a process of its own. 'Without kernels' means that Dr.Jit's folder of compiled kernels is empty, as
after an update. Prints a table of medians, least and largest times, and the parts of the time without kernels.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "nylon_cylinder.xml"
IMPORT = """
import sys, time
start = time.perf_counter()
import mitsuba_fspt
print(time.perf_counter() - start)
assert not {"mitsuba", "drjit"} & set(sys.modules)
"""
STEPS = """
import sys, time
times = [time.perf_counter()]
def lap():
    times.append(time.perf_counter())
from mitsuba_fspt import load, render
from mitsuba_fspt.runtime import backend
backend.ensure_variant(); lap()
scene = load(sys.argv[1]); lap()
render(scene); lap()
render(scene); lap()
print(*(after - before for before, after in zip(times, times[1:])))
"""
STEP_NAMES = ("Mitsuba, its LLVM and plugins", "the scene", "first picture", "second picture")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    rows: dict[str, list[float]] = {"import mitsuba_fspt": [], "fspt render, no kernels": [], "fspt render again": []}
    steps: list[list[float]] = []
    kernels = 0
    for _ in range(arguments.rounds):
        with tempfile.TemporaryDirectory() as folder:
            rows["import mitsuba_fspt"] += numbers(IMPORT, folder)
            for name in list(rows)[1:]:
                rows[name].append(rendering(arguments.scene, folder))
            kernels = len(list(Path(folder, "kernels").iterdir()))
        with tempfile.TemporaryDirectory() as folder:
            steps.append(numbers(STEPS, folder, str(arguments.scene)))
    print("| process | median | least | largest |\n|---|---|---|---|")
    for name, seconds in rows.items():
        print(f"| {name} | " + " | ".join(f"{f(seconds):.2f} s" for f in (np.median, min, max)) + " |")
    print(f"\nWithout kernels, of which {kernels} are compiled:")
    for name, seconds in zip(STEP_NAMES, np.median(steps, axis=0), strict=True):
        print(f"  {name}: {seconds:.2f} s")


def numbers(code: str, folder: str, *arguments: str) -> list[float]:
    """Numbers that a program prints, with Dr.Jit's compiled kernels in a folder."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environment(folder), check=True, capture_output=True, text=True)
    return [float(number) for number in done.stdout.split()]


def rendering(scene: Path, folder: str) -> float:
    """Seconds that `fspt render` of a scene takes, from the start of the process to its end."""
    command = [sys.executable, "-m", "mitsuba_fspt", "render", str(scene), "-o", str(Path(folder, "image.exr"))]
    start = time.perf_counter()
    subprocess.run(command, env=environment(folder), check=True, capture_output=True)
    return time.perf_counter() - start


def environment(folder: str) -> dict[str, str]:
    """Environment variables of this process, with Dr.Jit's kernels in a folder."""
    return os.environ | {"DRJIT_CACHE_DIR": str(Path(folder, "kernels"))}


if __name__ == "__main__":
    main()
