"""scripts/figures_tasks.py: the figure of simpler projectors is drawn, of equal total power."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import figures_tasks


def test_differences_have_no_total(monkeypatch, mono):
    """Red and blue balance in each panel. Seen to fail without the factor to equal total power."""
    monkeypatch.setattr(figures_tasks, "FILM", figures_tasks.FILM | {"width": 16, "height": 16, "pixel_pitch": 1.08})
    figure = figures_tasks.comparisons_figure()
    differences = [np.asarray(ax.images[0].get_array()) for ax in figure.axes if ax.images][1:3]
    for off in differences:
        assert abs(off).max() > 0.1
        assert off.sum() == pytest.approx(0, abs=1e-6 * abs(off).sum())
