"""The list of `scripts/mutants.py` fits the code, and a mutant that no test notices is found."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import mutants  # noqa: E402


@pytest.fixture(autouse=True)
def no_plugins(monkeypatch):
    """Pytest without the plugins that are installed: a third of the time of each process of it."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


def test_every_mutant_changes_one_place_of_the_code():
    assert len(mutants.MUTANTS) >= 30
    assert len({mutant.name for mutant in mutants.MUTANTS}) == len(mutants.MUTANTS)
    for mutant in mutants.MUTANTS:
        text = (ROOT / "mitsuba_fspt" / mutant.file).read_text(encoding="utf-8")
        assert mutant.applied(text) != text
        assert all((ROOT / name).is_file() for name in mutant.tests)


def test_a_text_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"occurs 0 times in a\.py. Correct the list"):
        mutants.Mutant("square", "a.py", "x**2", "x", ()).applied("x**3")


@pytest.mark.parametrize(("expected", "result"), [("2 + 2", "caught"), ("code.area(2)", "survived")])
def test_a_mutant_is_caught_by_a_test_alone(tmp_path, expected, result):
    """The last test compares the code with itself."""
    (tmp_path / "mitsuba_fspt").mkdir()
    (tmp_path / "mitsuba_fspt/code.py").write_text("def area(side):\n    return side**2\n")
    text = f"from mitsuba_fspt import code\n\ndef test_area():\n    assert code.area(2) == {expected}\n"
    (tmp_path / "test_code.py").write_text(text)
    mutant = mutants.Mutant("square", "code.py", "side**2", "3 * side", ("test_code.py",))
    assert mutants.tried(mutant, tmp_path)[0] == result
    assert (tmp_path / "mitsuba_fspt/code.py").read_text().endswith("side**2\n")


def test_tests_that_do_not_run_catch_nothing(tmp_path):
    (tmp_path / "mitsuba_fspt").mkdir()
    (tmp_path / "mitsuba_fspt/code.py").write_text("area = 1\n")
    mutant = mutants.Mutant("one", "code.py", "1", "2", ("no_such_test.py",))
    assert mutants.tried(mutant, tmp_path)[0] == "not run"


def test_the_test_that_caught_it_before_runs_first(tmp_path):
    """Where it is gone, the others decide."""
    (tmp_path / "mitsuba_fspt").mkdir()
    (tmp_path / "mitsuba_fspt/code.py").write_text("area = 1\n")
    text = "from mitsuba_fspt import code\n\ndef test_one():\n    assert code.area == 1\n"
    (tmp_path / "test_first.py").write_text(text)
    (tmp_path / "test_second.py").write_text(text)
    table = tmp_path / "mutants.csv"
    table.write_text('law,result,test\none,caught,"test_second.py::test_one[1, 2]"\ntwo,survived,\n')
    assert mutants.caught_by(table) == {"one": "test_second.py::test_one"}
    assert mutants.caught_by(tmp_path / "none.csv") == {}
    mutant = mutants.Mutant("one", "code.py", "1", "2", ("test_first.py",))
    for before in ("test_second.py::test_one", "gone.py::test_one"):
        by = before if before.startswith("test_second") else "test_first.py::test_one"
        assert mutants.tried(mutant, tmp_path, before) == ("caught", by)
