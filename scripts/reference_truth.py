"""The float64 reference's picture of the nylon cylinder, from which `fspt converge` counts errors in the README.

    python scripts/reference_truth.py out/nylon_cylinder_truth.npz
    fspt converge scenes/nylon_cylinder.xml -D f_number=2.8 --reference out/nylon_cylinder_truth.npz -o out

f/2.8, focused on the phantom's front, magnification 0.5, 256 x 256 pixels: arrays power and error [W], the error being
the one that the reference states of itself. It shares no code with the plugins and takes minutes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mitsuba_fspt.atomic import atomic_path
from mitsuba_fspt.reference import Camera, look_at
from mitsuba_fspt.reference_mesh import load_ply, mesh_truth

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def main() -> None:
    """Compute it and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path, metavar="FILE.npz")
    path = parser.parse_args().output
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = Camera(55, 2.8, 165, 0.108, 256, 256, look_at([180, 0, 0], [0, 0, 0], [0, 0, 1]))
    power, error = mesh_truth(camera, load_ply(SCENES / "nylon_cylinder.ply"))
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, power=power, error=error)
    rms, largest = np.sqrt(np.mean(error**2)) / power.max(), error.max() / power.max()
    print(f"{path}: stated error {rms:.1e} RMS, {largest:.1e} at the most, of the brightest pixel")


if __name__ == "__main__":
    main()
