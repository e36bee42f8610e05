"""scripts/markdown_tables.py, and the tables of README.md and docs that scripts write."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import markdown_tables  # noqa: E402
import work_precision  # noqa: E402

README = (ROOT / "README.md").read_text(encoding="utf-8")
TEXT = "before\n<!-- table: one -->\nold\n<!-- /table -->\nbetween\n<!-- table: two -->\nkept\n<!-- /table -->\nafter\n"
PADDED = """machine

| a |
|---|
| 1 |

| pixels | time  |
|--------|-------|
| all    | 17 ms |
| full   | –     |

files
"""
TABLE = "| pixels | time |\n|---|---|\n| all | 17 ms |\n| full | – |"


def test_one_table_is_replaced_and_nothing_else():
    replaced = markdown_tables.replace(TEXT, "one", TABLE)
    assert replaced == TEXT.replace("old", f"\n{TABLE}\n")
    assert markdown_tables.replace(replaced, "one", TABLE) == replaced
    assert markdown_tables.names(replaced) == ["one", "two"]


def test_a_table_that_is_not_marked_or_not_closed_is_refused():
    with pytest.raises(ValueError, match="no table 'three'"):
        markdown_tables.replace(TEXT, "three", TABLE)
    with pytest.raises(ValueError, match="no table 'one', or several"):
        markdown_tables.replace(TEXT + TEXT, "one", TABLE)
    with pytest.raises(ValueError, match="table 'one' has 0 lines"):
        markdown_tables.names(TEXT.replace("<!-- /table -->", "", 1))


def test_last_table_of_a_printed_text_loses_its_padding():
    assert markdown_tables.last_table(PADDED) == TABLE
    with pytest.raises(ValueError, match="no Markdown table"):
        markdown_tables.last_table("nothing")


def test_every_table_of_the_readme_names_a_script_that_writes_it():
    names = markdown_tables.names(README)
    assert "work_precision" in names
    for name in names:
        assert "--readme" in (ROOT / "scripts" / f"{name}.py").read_text(encoding="utf-8"), name


def test_every_table_of_docs_is_closed_and_marked_once():
    for path in sorted((ROOT / "docs").glob("*.md")):
        names = markdown_tables.names(path.read_text(encoding="utf-8"))
        assert len(names) == len(set(names)), path.name


def test_work_precision_writes_its_table(tmp_path, monkeypatch, capsys):
    """Expected: the last table that is printed stands in the file, and a measurement that fails changes nothing."""
    truth, readme, code = tmp_path / "truth.npz", tmp_path / "README.md", 2
    np.savez(truth, power=np.ones((2, 2)), error=np.zeros((2, 2)))
    readme.write_text(TEXT.replace("one", "work_precision"), encoding="utf-8")

    def measured(arguments):
        print(PADDED)
        return code

    monkeypatch.setattr(work_precision, "run", measured)
    monkeypatch.setattr(sys, "argv", ["work_precision.py", "--truth", str(truth), "--readme", str(readme)])
    with pytest.raises(SystemExit, match="2"):
        work_precision.main()
    assert "old" in readme.read_text(encoding="utf-8")
    code = 0
    with pytest.raises(SystemExit, match="0"):
        work_precision.main()
    assert TABLE in readme.read_text(encoding="utf-8")
    assert "old" not in readme.read_text(encoding="utf-8")
    assert capsys.readouterr().out.count("machine") == 2
