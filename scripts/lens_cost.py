"""CPU time of an image through a real lens over that of the thin lens.

    python scripts/lens_cost.py [--rounds 7] [-o docs/lens_cost.csv]

scenes/nylon_cylinder.xml on 256² pixels, rtol 1e-3. In each round the thin lens and every other one are rendered in
turn, warm; the table has the median of the quotients of a round, and the smallest and the largest.
"""

from __future__ import annotations

import argparse
import csv
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np

import mitsuba_fspt as fspt

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "scenes/nylon_cylinder.xml"
PUPIL = '<float name="pupil_magnification" value="0.8"/>'
DISTORTION = '<string name="distortion" value="-0.5, 0.2, 0.001, 0.001"/>'
CURVE = "0,1\n10,0.8\n20,0.5\n"


def texts(folder: Path) -> dict[str, str]:
    """Text of the scene with each property of the lens."""
    (folder / "v.csv").write_text(CURVE)
    vignetting = f'<string name="vignetting" value="{folder / "v.csv"}"/>'
    more = {
        "thin lens": "",
        "pupil magnification": PUPIL,
        "distortion": DISTORTION,
        "vignetting": vignetting,
        "all three": PUPIL + DISTORTION + vignetting,
    }
    plain = re.sub(r'value="(\w+\.ply)"', lambda found: f'value="{SCENE.parent / found[1]}"', SCENE.read_text())
    sensor = re.compile(r'(<sensor [^>]*type="fspt_lens"[^>]*>)')
    return {name: sensor.sub(lambda found, own=own: found[1] + own, plain, count=1) for name, own in more.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/lens_cost.csv")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        scenes = {name: fspt.load(text) for name, text in texts(Path(folder)).items()}
        for name, scene in scenes.items():
            known = fspt.render(scene).metadata  # compiles, too
            own = {"pupil_magnification", "distortion", "vignetting"} & {k for k in known if known[k] != 1}
            if len(own) != {"thin lens": 0, "all three": 3}.get(name, 1):
                raise RuntimeError(f"the lens of '{name}' has {sorted(own)}")
        seconds: dict[str, list[float]] = {name: [] for name in scenes}
        for _ in range(options.rounds):
            for name, scene in scenes.items():
                start = process_time()
                fspt.render(scene)
                seconds[name].append(process_time() - start)
    rows: list[list[object]] = [["lens", "CPU time over that of the thin lens", "smallest", "largest"]]
    for name, own in seconds.items():
        ratio = np.array(own) / np.array(seconds["thin lens"])
        rows.append([name, *(f"{value:.3f}" for value in (np.median(ratio), ratio.min(), ratio.max()))])
        print(*rows[-1], f"{np.median(own):.3f} s", sep="\t")
    with options.output.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
