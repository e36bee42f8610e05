"""The pure functions of scripts/paper.py: its sums, finders and tables do what docs/paper.md says."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import paper_common  # noqa: E402
import paper_models  # noqa: E402
import paper_stops  # noqa: E402
import paper_vignetting  # noqa: E402
from paper_common import Table  # noqa: E402

# --- stops ---


def test_half_per_full_stop_whatever_the_nominal_numbers():
    f = np.array(paper_stops.F_NUMBERS)
    np.testing.assert_allclose(paper_stops.ratio_per_stop(f, 3e-9 / f**2), 0.5)
    np.testing.assert_allclose(paper_stops.ratio_per_stop(f, np.full(len(f), 2.0)), 1.0)


def disc(centre, radius, blur):
    """Image of a disc, brightest in its middle at the column `centre` [pixels], its edge a ramp of width `blur`."""
    y, x = np.mgrid[0:61, 0:91]
    away = np.hypot(x - centre, y - 30)
    return np.clip((radius - away) / blur + 0.5, 0, 1) * (1 - 1e-3 * away**2 / radius**2)


@pytest.mark.parametrize("radius", [12.3, 20.0])
def test_border_of_a_disc_lies_at_its_radius(radius):
    """Expected: at half of the peak the radius, at 5 % that and 0.45 of the ramp more, the peak between the pixels.

    At 5 % to a quarter of a pixel: a straight line between pixels cuts off the corner where the ramp ends.
    """
    power = disc(40.3, radius, 4.0)
    peak, half = paper_stops.peak_to_border(power, 0.5)
    assert peak == pytest.approx(40.3, abs=0.01)
    assert half == pytest.approx(radius, abs=0.05)
    assert paper_stops.peak_to_border(power, 0.05)[1] == pytest.approx(radius + 1.8, abs=0.25)


def test_the_nearer_border_counts_and_one_outside_the_image_does_not():
    power = disc(40.0, 10.0, 2.0)
    power[:, :40] = np.maximum(power[:, :40], 0.9)  # light up to the left edge
    assert paper_stops.peak_to_border(power, 0.5)[1] == pytest.approx(10.0, abs=0.05)


# --- vignetting ---


def test_circles_that_overlap():
    """Expected: apart nothing, one inside the other the smaller; equal ones a radius apart 2π/3 − √3/2, its middle."""
    area, aside = paper_vignetting.overlap(2.0, 2.0, np.array([1e-9, 2.0, 4.0 - 1e-9]))
    np.testing.assert_allclose(area / 4, [np.pi, 2 * np.pi / 3 - np.sqrt(3) / 2, 0], atol=1e-6)
    np.testing.assert_allclose(aside[:2], [0, 1], atol=1e-6)
    area, aside = paper_vignetting.overlap(1.0, 3.0, np.array([0.5]))
    assert (area[0], aside[0]) == pytest.approx((np.pi, 0), abs=1e-6)


def test_illumination_falls_from_one():
    light = paper_vignetting.illumination(np.linspace(0, 38, 20), 55 / 4)
    assert light[0] == pytest.approx(1)
    assert (np.diff(light) < 0).all()


# --- the exposure, tables ---


def test_exposure_gives_the_power_back():
    """Expected: within three standard errors of the shot noise over all pixels."""
    image = fspt.Image(np.full((64, 64), 3e-9), metadata={"pixel_pitch": 0.216, "magnification": 0.5})
    found, electrons = paper_models.expose(image)
    error = found.power.std() / 64
    assert 0 < error < 1e-3 * 3e-9
    assert found.power.mean() == pytest.approx(3e-9, abs=3 * error)
    assert electrons > 1000


def test_binning_sums_and_keeps_the_scale():
    image = fspt.Image(np.arange(36.0).reshape(6, 6), metadata={"pixel_pitch": 0.1, "magnification": 0.5})
    found = paper_common.binned(image, 3)
    np.testing.assert_array_equal(found.power, [[63, 90], [225, 252]])
    assert found.metadata["pixel_pitch"] == pytest.approx(0.3)
    np.testing.assert_allclose(paper_common.places(found), [-0.3, 0.3])


def test_tables_are_written_between_their_marks(tmp_path):
    table = Table("one", {"view": "", "ME": ".3f"}, [("left", 0.12345), ("back", None)])
    text = tmp_path / "text.md"
    text.write_text("before\n<!-- table: one -->\nold\n<!-- /table -->\nafter\n", encoding="utf-8")
    for _ in range(2):
        paper_common.fill(text, [table, Table("other", {"view": ""}, [])])
    filled = (
        "before\n<!-- table: one -->\n\n| view | ME |\n|---|---|\n| left | 0.123 |\n| back | – |\n\n<!-- /table -->\n"
        "after\n"
    )
    assert text.read_text(encoding="utf-8") == filled
    paper_common.write_csv([table], tmp_path / "values.csv")
    assert (tmp_path / "values.csv").read_text().splitlines() == ["table,case,quantity,value", "one,left,ME,0.12345"]
