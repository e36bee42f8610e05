"""scripts/edge_bands.py: which edges of a cube are its silhouette, and how many pixels a band takes."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from small_scenes import camera_scene, disk

pytestmark = pytest.mark.usefixtures("mono")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import edge_bands  # noqa: E402


@pytest.mark.parametrize(("f_number", "edges"), [(22, 4), (1.0, 12)])
def test_a_cube_face_on_shows_its_front_or_by_a_wide_pupil_all_edges(f_number, edges):
    """Rationale: the middle of the pupil sees the front face alone; a pupil wider than the cube all but the back.

    Seen to fail with the radius of the pupil left out (4 edges at f/1).
    """
    cube = trimesh.creation.box((10, 10, 10)).apply_translation((0, 0, 165))
    camera = camera_scene(disk(165.0), f_number=f_number).sensors()[0].camera
    assert len(edge_bands.silhouette(cube, camera)) == edges


def test_a_band_has_the_area_of_a_stadium():
    """Expected: 2 w l + π w² pixels for a line of length l, and two where two lines cross."""
    ends, width = np.array([[[10.2, 20.0], [50.2, 50.0]], [[10.2, 50.0], [50.2, 20.0]]]), np.array([3.3, 3.3])
    count = edge_bands.bands(ends, width, (64, 64))
    assert count.sum() == pytest.approx(2 * (2 * 3.3 * 50 + math.pi * 3.3**2), rel=0.02)
    assert count.max() == 2


def test_every_case_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(edge_bands, "F_NUMBERS", (8.0,))
    monkeypatch.setattr(sys, "argv", ["edge_bands.py", "--out", str(tmp_path)])
    edge_bands.main()
    with open(tmp_path / "edge_bands.csv", newline="") as file:
        rows = {row["mesh"]: row for row in csv.DictReader(file)}
    assert all(float(row["edges_a_pixel_median"]) > 1 > float(row["one_edge"]) for row in rows.values())
    assert float(rows["ring"]["hidden_alone"]) > 0.1 > float(rows["cylinder"]["hidden_alone"])
