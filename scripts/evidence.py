"""Measure every claim of README.md anew and compare: fails where a claim does not hold.

    scripts/evidence [--only NAME …] [--committed] [--out out/evidence]

Each claim is a text of README.md, the script that measures it, the table that it writes and a check of that table.
Without options all scripts run, one after the other, which takes a night on two cores; the machine must be idle for
the times.
--committed runs none and checks the tables of docs/. Exits with 1 if a claim fails.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
Rows = list[dict[str, str]]


@dataclass(frozen=True)
class Claim:
    """A text of README.md, the words of the command that measures it (`{out}`: folder), its table and the check.

    `check` returns the failures, each with the number found.
    """

    name: str
    text: str
    command: Sequence[str]
    table: str
    check: Callable[[Rows], list[str]]


def within(name: str, value: float, low: float, high: float) -> list[str]:
    """A failure unless low <= value <= high."""
    return [] if low <= value <= high else [f"{name} is {value:.4g}, not in {low:g} … {high:g}"]


def least_time(rows: Rows, method: str, error: str, below: float) -> float:
    """Shortest median time in which a method reaches the error; infinite where it does not."""
    times = [float(r["seconds_median"]) for r in rows if r["method"] == method and float(r[error] or "inf") <= below]
    return min(times, default=float("inf"))


def check_speed(rows: Rows) -> list[str]:
    """Ratio of the times at RMS errors of 1e-4 of all pixels and 3e-5 of the full ones: 19 and 26 in README.md."""
    failures = []
    for error, below, least in (("rms_all", 1e-4, 10.0), ("rms_full", 3e-5, 13.0)):
        paths = {row["method"] for row in rows if row["method"].startswith("path")}
        monte_carlo = min(least_time(rows, method, error, below) for method in paths)
        ratio = monte_carlo / least_time(rows, "integral", error, below)
        failures += within(f"time of path over that of the integral at {error} {below:g}", ratio, least, float("inf"))
    return failures


def check_inversion(rows: Rows) -> list[str]:
    """1000 electrons on the brightest pixel: bias, half width of the interval and error of J_n [%]."""
    (row,) = (row for row in rows if row["table"] == "light" and row["electrons"] == "1000")
    return [
        *within("error of the total power [%]", abs(float(row["bias_percent"])), 0, 0.21),
        *within("half width of its interval [%]", float(row["half_width_percent"]), 0.15, 0.3),
        *within("error of J_n [%]", float(row["l2_percent"]), 0, 2.0),
    ]


def check_location(rows: Rows) -> list[str]:
    """Four views, 1000 electrons: standard deviations; share of the intervals that contain the true value in all."""
    (row,) = (row for row in rows if row["case"] == "4 views, 1000 electrons")
    failures = [f for axis in "xyz" for f in within(f"sd of {axis} [mm]", float(row[f"sd_{axis}_mm"]), 0, 0.0149)]
    failures += within("sd of the power [%]", float(row["sd_power_percent"]), 0, 0.3)
    for row in rows:  # 60 images a case, the power correlated with x by -0.7: 0.90 ± 3.3 standard errors
        failures += within(f"{row['case']}: share of intervals that contain the value", float(row["holds"]), 0.82, 0.98)
    failures += within("share of all intervals", sum(float(r["holds"]) for r in rows) / len(rows), 0.87, 0.93)
    return failures


def check_paper(rows: Rows) -> list[str]:
    """CF of the integral against `path` from the same J_n."""
    found = [float(row["value"]) for row in rows if row["quantity"] == "CF" and row["case"].endswith(", path")]
    return within("views compared with path", len(found), 3, 3) + within("least CF", min(found, default=0), 0.99998, 1)


CLAIMS = (
    Claim(
        "work_precision",
        "until the RMS error",
        ("scripts/work_precision.py", "-o", "{out}"),
        "nylon_cylinder_converge.csv",
        check_speed,
    ),
    Claim(
        "inversion",
        "total power wrong by 0.11 %, 90 %\n  interval ± 0.20 %, J_n by 1.7 %",
        ("scripts/inversion.py", "--tables", "light", "--seeds", "2", "-o", "{out}/inversion.csv"),
        "inversion.csv",
        check_inversion,
    ),
    Claim(
        "location",
        "located with a standard deviation of 0.01 mm, its power with 0.24 %",
        ("scripts/location_coverage.py", "-o", "{out}/location_coverage.csv"),
        "location_coverage.csv",
        check_location,
    ),
    Claim(
        "paper",
        "The paper's images and numbers, recomputed",
        ("scripts/paper.py", "--out", "{out}"),
        "paper.csv",
        check_paper,
    ),
)


def rows_of(path: Path) -> Rows:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def failures_of(claim: Claim, folder: Path, readme: str) -> list[str]:
    """What is wrong with a claim: its text is not in README.md, its table is missing or says otherwise."""
    missing = [] if claim.text in readme else [f"README.md does not contain: {claim.text!r}"]
    table = folder / claim.table
    return [*missing, *(claim.check(rows_of(table)) if table.is_file() else [f"{table} was not written"])]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[claim.name for claim in CLAIMS], help="these claims alone")
    parser.add_argument("--committed", action="store_true", help="run nothing, check the tables of docs/")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "evidence")
    given = parser.parse_args(arguments)
    folder = ROOT / "docs" if given.committed else given.out
    folder.mkdir(parents=True, exist_ok=True)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    results: Mapping[str, list[str]] = {}
    for claim in (claim for claim in CLAIMS if not given.only or claim.name in given.only):
        start, failures = time.monotonic(), []
        if not given.committed:
            words = [word.format(out=folder) for word in claim.command]
            code = subprocess.run([sys.executable, *words], cwd=ROOT, check=False).returncode
            failures = [f"{' '.join(words)} ended with {code}"] if code else []
        failures += failures_of(claim, folder, readme)
        results = {**results, claim.name: failures}
        print(
            f"{'FAILED' if failures else 'holds':6} {claim.name} ({time.monotonic() - start:.0f} s)",
            *failures,
            sep="; ",
        )
    return int(any(results.values()))


if __name__ == "__main__":
    sys.exit(main())
