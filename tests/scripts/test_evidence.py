"""scripts/evidence.py: the committed tables confirm README.md, and other tables do not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import evidence  # noqa: E402

README = (ROOT / "README.md").read_text(encoding="utf-8")
WRONG = {  # a column of the table, and a factor by which the claim no longer holds
    "work_precision": ("seconds_median", 100.0),
    "inversion": ("l2_percent", 1.3),
    "location": ("sd_power_percent", 1.5),
    "paper": ("value", 0.9999),
}


@pytest.mark.parametrize("claim", evidence.CLAIMS, ids=lambda claim: claim.name)
def test_the_committed_table_confirms_the_claim(claim):
    assert evidence.failures_of(claim, ROOT / "docs", README) == []
    assert (ROOT / claim.command[0]).is_file()


@pytest.mark.parametrize("claim", evidence.CLAIMS, ids=lambda claim: claim.name)
def test_another_table_does_not(claim):
    column, factor = WRONG[claim.name]
    rows = evidence.rows_of(ROOT / "docs" / claim.table)
    for row in rows:
        if row.get("method", "integral") == "integral" and row.get("quantity", "CF") == "CF":
            row[column] = str(float(row[column]) * factor)
    assert claim.check(rows)


def test_a_claim_that_readme_does_not_make_fails(tmp_path):
    failures = evidence.failures_of(evidence.CLAIMS[0], tmp_path, "")
    assert len(failures) == 2
    assert "README.md does not contain" in failures[0]
    assert "was not written" in failures[1]
