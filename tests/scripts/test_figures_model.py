"""scripts/figures_model.py: its own blur formula is the package's, and both figures are drawn."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import figures_model

from mitsuba_fspt.optics.discs import defocus
from mitsuba_fspt.optics.thin_lens import Lens


@pytest.mark.parametrize(
    ("model", "numbers"),
    [
        ("diaphragm", {}),
        ("diaphragm", {"lens_diameter": 30.0, "diaphragm_distance": 20.0}),
        ("diaphragm", {"lens_diameter": 30.0, "diaphragm_distance": -12.0}),
        ("ripoll", {"numerical_aperture": 0.1}),
    ],
)
def test_blur_radius_is_that_of_the_package(model, numbers):
    """Rationale: R b/m of Eq. M.8, in front of the virtual detector plane, on it and behind it."""
    lens = Lens.focused(55, 2.8, magnification=0.5, model=model, **numbers)
    disc, depth = lens.discs[0], np.array([130.0, 165.0, 200.0])
    back, scale = defocus(depth, lens.focus_distance, disc.shift)
    found = figures_model.blur_radius(depth, lens.focus_distance, disc.radius, disc.shift)
    np.testing.assert_allclose(found, disc.radius * back / scale, rtol=1e-14)
    assert found[0] > 1
    assert found[2] < -1


def test_figures_are_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["figures_model.py", "-o", str(tmp_path)])
    figures_model.main()
    for name in ("model_geometry.png", "model_blur.png"):
        assert 10_000 < (tmp_path / name).stat().st_size < 150_000
