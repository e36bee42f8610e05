"""Error against run time of every method on the nylon cylinder: the README's table and figure.

    python scripts/work_precision.py [-o docs] [--truth out/nylon_cylinder_truth.npz] [--rounds 5] [--budget 2]
                                     [--readme README.md]

f/2.8, focused on the phantom's front, magnification 0.5, 256 x 256 pixels. `fspt converge` measures, writes
nylon_cylinder_converge.csv and .png and prints the ratios. It counts errors from the float64 reference's image,
arrays power and error [W], the error being the one that the reference states of itself; this shares no code with the
plugins, takes minutes, and is made once. With --readme the last table is written into that file, too.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
from pathlib import Path

import markdown_tables
import numpy as np
import tests_folder  # noqa: F401
from references.camera import ReferenceCamera, look_at
from references.meshes import load_ply, mesh_truth

from mitsuba_fspt.cli.app import run
from mitsuba_fspt.runtime.atomic_files import atomic_path

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Make the truth where it is not there, then measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs", help="folder for CSV and PNG")
    parser.add_argument("--truth", type=Path, default=ROOT / "out" / "nylon_cylinder_truth.npz", metavar="FILE.npz")
    parser.add_argument("--rounds", default="5")
    parser.add_argument("--budget", default="2")
    parser.add_argument("--readme", type=Path, metavar="FILE.md", help="write the table between its markers there")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    if not arguments.truth.exists():
        write_truth(arguments.truth)
    # Named in CSV and PNG: as seen from where the script is run, not from the root of the machine.
    scene = [os.path.relpath(ROOT / "scenes" / "nylon_cylinder.xml"), "-D", "f_number=2.8"]
    counted_from = ["--reference", os.path.relpath(arguments.truth)]
    how = ["--rounds", arguments.rounds, "--budget", arguments.budget, "-o", str(arguments.output)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = run(["converge", *scene, *counted_from, *how])
    print(printed.getvalue(), end="")
    if code == 0 and arguments.readme:
        markdown_tables.write(arguments.readme, "work_precision", markdown_tables.last_table(printed.getvalue()))
    sys.exit(code)


def write_truth(path: Path) -> None:
    """The reference's image and its stated error, as a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = ReferenceCamera(55, 2.8, 165, 0.108, 256, 256, look_at([180, 0, 0], [0, 0, 0], [0, 0, 1]))
    power, error = mesh_truth(camera, load_ply(ROOT / "scenes" / "nylon_cylinder.ply"))
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, power=power, error=error)
    rms, largest = np.sqrt(np.mean(error**2)) / power.max(), error.max() / power.max()
    print(f"{path}: stated error {rms:.1e} RMS, {largest:.1e} at the most, of the brightest pixel")


if __name__ == "__main__":
    main()
