"""The table of what a scene's integral leaves out: which savings count."""

from __future__ import annotations

import pytest

from mitsuba_fspt.studies.explain import Explanation, _saved


@pytest.mark.parametrize(
    ("saved", "spread", "text"),
    [(0.31, 0.04, "31 %"), (0.03, 0.04, "no gain"), (-0.03, 0.0, "no gain"), (0.0, 0.0, "no gain"), (None, 0.0, "")],
)
def test_a_saving_within_the_noise_is_no_gain(saved, spread, text):
    """Seen to fail with '-3 %'."""
    line = Explanation("what", True, "why", None if saved is None else 0.5, saved, spread).render_text()
    assert line.split("left out", 1)[1].split() == [*([] if saved is None else ["50", "%"]), *text.split(), "why"]


def test_the_spread_is_half_that_of_the_rounds(monkeypatch):
    """Runs of 1 s with the shortcut and of 2 s, 1 s and 1.25 s without: savings of 0.5, 0 and 0.2."""

    class Run:
        rays = 3

    times = iter([3, 1, 2, 1, 1, 1, 1.25])
    assert _saved(lambda _: (Run, next(times)), "with", "without") == (0, pytest.approx(0.2), 0.25)
