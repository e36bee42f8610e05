"""scripts/audit.py on a few fixed scenes: the stated errors hold, and the audit notices where they do not."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import audit  # noqa: E402

SCENES = [("spheres", 3), ("plates", 6), ("exit laws", 1), ("crops", 3), ("boxes", 2)]
FEW = {"likely": 4, "random": 2}


@pytest.mark.parametrize(("family", "seed"), SCENES)
def test_stated_errors_bound_the_errors(family, seed):
    """Of six pixels each, four of them where errors are likely, none is beyond its own error at rtol 1e-2."""
    found = audit.audited(family, seed, 1e-2, **FEW)
    assert (found.beyond_error, found.silent, found.beyond_random) == (0, 0, 0)
    assert found.largest <= 1e-2


@pytest.mark.parametrize(("family", "seed"), [("boxes", 0), ("meshes", 1)])
def test_stated_errors_of_the_matrix_bound_the_errors(family, seed):
    """As for images, with J_n random on vertices and on faces."""
    found = audit.audited(family, seed, 1e-2, **FEW, matrix=True)
    assert (found.beyond_error, found.silent, found.beyond_random) == (0, 0, 0)
    assert found.largest <= 1e-2


def test_wrong_images_are_noticed(monkeypatch):
    """An image that is 3 % too bright: beyond rtol and beyond its errors on bright pixels, silently."""
    render = audit._rendered

    def wrong(made, rtol):
        image, seconds = render(made, rtol)
        bright = image.power == image.power.max()
        return replace(image, power=np.where(bright, image.power, 1.03 * image.power)), seconds

    monkeypatch.setattr(audit, "_rendered", wrong)
    found = audit.audited("spheres", 3, 1e-3, **FEW)
    assert found.beyond_likely > 0
    assert found.silent > 0


def test_the_table_has_a_line_for_each_family(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(audit, "LIKELY", 2)
    arguments = ["audit.py", "--scenes", "1", "--family", "spheres,centre", "--rtol", "1e-2", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    audit.main()
    with open(tmp_path / "audit.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["family"] for row in rows] == ["spheres", "centre"]
    assert all(float(row["seconds"]) > 0 for row in rows)
    *_, head, _, first, second, whole = capsys.readouterr().out.strip().splitlines()
    assert [line.split(" | ")[0] for line in (head, first, second, whole)] == [
        "| rtol 0.01",
        "| spheres",
        "| centre",
        "| all",
    ]
