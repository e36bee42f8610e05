"""A sweep with the power of the light source."""

from __future__ import annotations

import json

import pytest
from small_scenes import write_scene

import mitsuba_fspt as fspt


def test_a_source_power_scales_every_image(tmp_path, run):
    """And makes other images of the same points. Seen to fail with the fingerprint of 1 W, whose images were reused."""
    path, folder = write_scene(tmp_path / "s.xml"), tmp_path / "o"
    one = fspt.sweep(path, {"f_number": [4, 8]}, folder, rtol=1e-2)
    faint = fspt.sweep(path, {"f_number": [4, 8]}, folder, rtol=1e-2, source_power=1e-9)
    assert [row.power for row in faint] == pytest.approx([1e-9 * row.power for row in one], rel=1e-6)
    assert fspt.read(faint[0].file).metadata["source_power"] == 1e-9
    words = ("sweep", path, "-D", "f_number=4,8", "--rtol", "1e-2", "-o", folder, "--source-power")
    code, out, err = run(*words, "1e-9", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["index"] == str(folder / "index.csv")
    assert [point["power"] for point in told["points"]] == [row.power for row in faint]
    assert [point["parameters"] for point in told["points"]] == [{"f_number": 4}, {"f_number": 8}]
    assert all(point["reused"] for point in told["points"])
    assert run(*words, "1e-9", "--quiet") == (0, "", "")
    code, out, err = run(*words, "-1")
    assert (code, out) == (2, "")
    assert "'source_power' must be finite and > 0 W, got -1" in err
