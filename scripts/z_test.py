"""The z-test of `compare` on right images: how its p-values are distributed, by samples a pixel.

    python scripts/z_test.py [--pairs 20] [-o docs/z_test.csv]

Pairs of images by `path`, each of a seed of its own, of scenes/nylon_cylinder.xml at f/2.8 on 16 x 16 pixels. For right
images p is uniform in 0 ... 1: its mean is 1/2 with a standard deviation of 0.29/sqrt(pairs). Columns: mean and least
p, share of pairs below 0.05, mean of chi2.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from csv_table import write_rows

import mitsuba_fspt as fspt

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "scenes" / "nylon_cylinder.xml"
CAMERA = {"f_number": 2.8, "view": 90, "width": 16, "height": 16, "pixel_pitch": 1.728}
SAMPLES = (16, 64, 256)


def row(samples: int, pairs: int) -> dict[str, float]:
    """Numbers of the pairs with so many samples a pixel."""
    scene = fspt.load(SCENE, **CAMERA)
    images = [fspt.render(scene, method="path", spp=samples, seed=seed) for seed in range(2 * pairs)]
    tests = [fspt.compare(*pair).z_test for pair in zip(images[::2], images[1::2], strict=True)]
    p = np.array([test.p_value for test in tests])
    return {
        "samples": samples,
        "pairs": pairs,
        "p_mean": round(float(p.mean()), 3),
        "p_least": float(f"{p.min():.2g}"),
        "below_5_percent": round(float(np.mean(p < 0.05)), 3),
        "chi2": round(float(np.mean([test.chi2 for test in tests])), 3),
    }


def main() -> None:
    """Write the table as CSV and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "z_test.csv")
    arguments = parser.parse_args()
    rows = []
    for samples in SAMPLES:
        rows.append(row(samples, arguments.pairs))
        print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    write_rows(arguments.output, rows)


if __name__ == "__main__":
    main()
