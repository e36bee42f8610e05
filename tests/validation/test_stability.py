"""Stiff and extreme cases: every row of `fspt stability` meets its bound, and the runner names one that does not."""

from __future__ import annotations

import json
import math

import pytest

from mitsuba_fspt.cli import app
from mitsuba_fspt.runtime.errors import SceneError
from mitsuba_fspt.validation import stiff_cases, stiff_scenes
from mitsuba_fspt.validation.stability import NAME_WIDTH, Case, check

# Rows that take the same way through the code as another row of their kind, or as a test of another file; a user's
# `fspt stability` has them.
REPEATED = {
    "sphere through the plane z = u",
    "edge 1e-7 behind the plane z = u",
    "edge at u = 10000 mm",
    "f/1e6",  # against the surface form; the row against the pinhole model stays
    *(f"f/{stop}, edge out of focus" for stop in ("2.8", "64", "10000")),
    "body smaller than its blur",  # tests/integral/test_physics.py
    *(
        f"camera turned {angle}° about ({axis})"
        for angle, axis in ((90, "0, 1, 0"), (-90, "1, 0, 0"), (200, "-3, 1, 1"))
    ),
}
CASES = [case for case in stiff_cases.cases() if not case.slow and case.name not in REPEATED]


@pytest.mark.usefixtures("mono")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_row_meets_its_bound(case):
    result = check(case)
    assert result.ok, result.render_text()


@pytest.mark.parametrize("stretch", [(1.0005, 1, 1), (-1, 1, 1)])
def test_a_lens_that_stretches_or_mirrors_is_refused(mono, stretch):
    """Rationale: 5e-4 in length is 1e-3 in power; a mirrored image is a wrong one."""
    place = mono.ScalarTransform4f().rotate([0.6, 0, 0.8], 50).scale(list(stretch))
    with pytest.raises(RuntimeError, match="'to_world' scales lengths or mirrors"):
        stiff_scenes.scene(stiff_scenes.ball(), at=place)


def test_names_tell_the_rows_apart_and_fit_their_column():
    names = [case.name for case in stiff_cases.cases()]
    assert len(set(names)) == len(names)
    assert REPEATED <= set(names)
    assert max(len(name) for name in names) <= NAME_WIDTH


def refuse():
    raise SceneError("scene: too large.")


@pytest.mark.parametrize(
    ("run", "tolerance", "ok"),
    [
        (lambda: 1e-6, 1e-5, True),
        (lambda: 1e-4, 1e-5, False),
        (lambda: math.nan, 1e-5, False),
        (lambda: math.inf, 1e-5, False),
        (lambda: 0.0, None, False),  # computed where float32 cannot be right
        (refuse, None, True),
        (refuse, 1e-5, False),  # refused where there is a right answer
    ],
)
def test_a_row_is_right_to_its_tolerance_or_refused_where_it_must_be(run, tolerance, ok):
    result = check(Case("name", "truth", run, tolerance))
    assert result.ok is ok
    assert ("FAIL" in result.render_text()) is not ok
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["ok"] is ok


def test_a_fault_of_the_code_is_no_refusal():
    with pytest.raises(ZeroDivisionError):
        check(Case("name", "truth", lambda: 1 / 0, None))


def test_the_command_prints_the_table_and_fails_with_a_row(monkeypatch, capsys):
    good, bad = Case("a good one", "", lambda: 1e-6, 1e-5), Case("a bad one", "", lambda: 1.0, 1e-5)
    long = Case("a long one", "", refuse, None, slow=True)
    monkeypatch.setattr(stiff_cases, "cases", lambda: [good, long])
    assert app.run(["stability"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("1 of 1 hold")
    assert app.run(["stability", "--all"]) == 0
    assert "refused  ok      0.00 s  scene: too large." in capsys.readouterr().out
    monkeypatch.setattr(stiff_cases, "cases", lambda: [good, bad])
    assert app.run(["stability"]) == 1
    assert "FAIL" in capsys.readouterr().out
    assert app.run(["stability", "--json"]) == 1
    assert [row["ok"] for row in json.loads(capsys.readouterr().out)] == [True, False]
