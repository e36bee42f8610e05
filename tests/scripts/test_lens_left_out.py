"""The table of what leaving out costs: its closed forms, and that page and CSV are of one run."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import lens_left_out as study  # noqa: E402


@pytest.fixture(scope="module")
def rows():
    with (ROOT / "docs/lens_left_out.csv").open(newline="", encoding="utf-8") as file:
        header, *found = csv.reader(file)
    assert tuple(header) == study.COLUMNS
    return [[name, float(magnification), *values] for name, magnification, *values in found]


def test_page_and_table_are_of_one_run(rows):
    assert study.table(rows) in (ROOT / "docs/lens_left_out.md").read_text(encoding="utf-8")
    assert {row[0] for row in rows} == set(study.CASES)


def test_factors_of_the_image_are_those_of_closed_forms(rows):
    """The source's power has a factor of all pixels: of P that of the working f-number, of HRRT that of areas."""
    for name, t, _, _, _, power, _ in rows:
        if name == "pupil magnification":
            expected = ((1 + t) / (1 + t / study.MAGNIFIED)) ** 2 - 1
        elif name == "diaphragm (HRRT)":
            expected = (study.FOCAL / study.F_NUMBER / study.BORDER) ** 2 - 1
        elif name == "spectrum":
            expected = study.band_factor() - 1
        else:
            continue
        assert float(power) == pytest.approx(expected, abs=0.012), (name, t)


def test_with_nothing_left_out_nothing_is_wrong(rows):
    for name, _, total, exitance, depth, power, told in rows:
        if name == "nothing":
            assert max(map(abs, map(float, (total, exitance, depth, power)))) < 4e-3
            assert told == "no"
