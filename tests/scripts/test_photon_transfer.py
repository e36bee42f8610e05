"""scripts/photon_transfer.py on few pixels and frames."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import photon_transfer


def test_photon_transfer_gives_back_the_numbers_put_in(tmp_path, monkeypatch):
    """All within five standard errors, with a picture. Seen to fail with F² = 1 in `NoiseModel`."""
    pytest.importorskip("ccdproc")
    options = ["--side", "64", "--frames", "10", "--exposures", "3", "-o", str(tmp_path / "p.csv")]
    monkeypatch.setattr(sys, "argv", ["photon_transfer.py", *options])
    photon_transfer.main()
    rows = list(csv.DictReader((tmp_path / "p.csv").read_text().splitlines()))
    assert {row["camera"] for row in rows} == {"CCD", "EMCCD, gain 1", "EMCCD, gain 300", "sCMOS"}
    assert [row for row in rows if abs(float(row["deviation"])) > 5] == []
    assert (tmp_path / "p.png").stat().st_size > 10000
