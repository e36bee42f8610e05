"""Every simulated number and image of the paper, recomputed and compared with the printed one.

    python scripts/paper.py [--out docs] [--tissue-spp 8192] [--part vignetting|stops|models|agreement]

Parts: vignetting (Fig. 2b), the diaphragm from f/2.8 to f/22 (stops; Figs. 6-8), with and without a diaphragm (models;
Table 2, Fig. 9), the integral against Monte Carlo (agreement; Table 1, Fig. 5). Prints the tables in Markdown; writes
them into paper.csv and paper.md and the figures paper_*.png. Solved phantoms stay in out/paper.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from paper_agreement import agreement
from paper_common import Table, fill, write_csv
from paper_models import models
from paper_stops import stops
from paper_vignetting import vignetting

from mitsuba_fspt.runtime import backend

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("vignetting", "stops", "models", "agreement")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--out", type=Path, default=ROOT / "docs", help="for paper.csv, paper.md and paper_*.png")
    options.add_argument("--tissue-spp", type=int, default=8192, help="Monte Carlo paths a pixel from the source on")
    options.add_argument("--part", choices=PARTS, help="this one only")
    given = options.parse_args()
    folder = ROOT / "out" / "paper"
    folder.mkdir(parents=True, exist_ok=True)
    backend.ensure_variant()
    make: dict[str, Callable[[], list[Table]]] = {
        "vignetting": lambda: vignetting(given.out),
        "stops": lambda: stops(folder, given.out),
        "models": lambda: models(folder, given.out),
        "agreement": lambda: agreement(folder, given.out, given.tissue_spp),
    }
    tables = []
    for name in [given.part] if given.part else PARTS:
        start = time.perf_counter()
        made = make[name]()
        print(f"\n{name} ({time.perf_counter() - start:.0f} s)")
        for table in made:
            print(f"\n{table.markdown()}", flush=True)
        tables += made
    write_csv(tables, given.out / "paper.csv")
    if (given.out / "paper.md").exists():
        fill(given.out / "paper.md", tables)


if __name__ == "__main__":
    main()
