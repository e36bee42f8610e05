"""The samples of docs/extending.md: put where they say, each is found by its file's name and does what it claims."""

from __future__ import annotations

import importlib
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
SAMPLES = dict(re.findall(r"<!-- sample: (\S+) -->\n\n```python\n(.*?)```", TEXT, re.S))


@pytest.fixture
def sample(tmp_path, monkeypatch):
    """`sample(path)`: the sample at this path below the package, as if its file lay there."""
    added = []

    def put(path):
        folder, name = path.rsplit("/", 1)
        (tmp_path / name).write_text(SAMPLES[path], encoding="utf-8")
        package = importlib.import_module(f"mitsuba_fspt.{folder.replace('/', '.')}")
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
        added.append((package, name.removesuffix(".py")))

    yield put
    for package, name in added:
        sys.modules.pop(f"{package.__name__}.{name}", None)
        vars(package).pop(name, None)


def camera(**numbers):
    film = {"type": "hdrfilm", "width": 5, "height": 5, "pixel_format": "luminance"}
    numbers = {"focal_length": 55.0, "f_number": 4.0, "magnification": 0.5, "pixel_pitch": 0.5} | numbers
    return {"type": "fspt_lens", "film": film, **numbers}


def plane(mi, **emitter):
    """A disk of 200 mm that faces the lens, 150 mm before it."""
    place = mi.ScalarTransform4f().translate([0, 0, 150]).rotate([0, 1, 0], 180).scale(200)
    return {"type": "disk", "to_world": place, "emitter": {"type": "fspt_surface", "exitance": 2e-3, **emitter}}


def rendered(mi, lens, surface):
    scene = mi.load_dict({"type": "scene", "lens": lens, "surface": surface})
    return np.asarray(fspt.render(scene, rtol=1e-4).power)


def test_both_samples_are_there():
    assert set(SAMPLES) == {"emission/laws/cosine_power.py", "optics/models/telecentric.py"}


def test_exit_law(mono, sample):
    """Rationale: a surface parallel to the lens has µ = cosθ, so that P = G (k + 2)/(2π) J_n ⟨cos^(4+k) θ⟩ (M.6).

    Expected: in the middle of the film, the mean over an f/4 pupil from its closed form, to 1e-4.
    """
    sample("emission/laws/cosine_power.py")
    k, u, virtual, radius = 3.0, 165.0, 1.0, 55 / 8
    power = rendered(mono, camera(), plane(mono, emission="cosine_power", exponent=k))[2, 2]
    # ⟨cos^m θ⟩ over the disc, seen from the axis: ∫ (1 + s R²/u²)^(-m/2) ds over s in [0, 1].
    slope, m = (radius / u) ** 2, 4 + k
    mean = (1 - (1 + slope) ** (1 - m / 2)) / ((m / 2 - 1) * slope)
    etendue = virtual**2 * math.pi * slope
    assert power == pytest.approx(etendue * (k + 2) / (2 * math.pi) * 2e-3 * mean, rel=1e-4)
    with pytest.raises(RuntimeError, match="'exponent' must be >= 0"):
        mono.load_dict({"type": "fspt_surface", "exitance": 1.0, "emission": "cosine_power", "exponent": -1.0})


def test_lens_model(mono, sample):
    """Rationale: a cone of half angle arctan(D/2F) that sees a uniform Lambertian surface gives P = J_n A_vd sin².

    Expected: alike on all pixels, as the cone is alike for all of them.
    """
    sample("optics/models/telecentric.py")
    power = rendered(mono, camera(model="telecentric", stop_scale=0.5), plane(mono))
    slope = 0.5 / 8
    np.testing.assert_allclose(power, 2e-3 * slope**2 / (1 + slope**2), rtol=1e-4)
    with pytest.raises(RuntimeError, match="'stop_scale' must be > 0"):
        mono.load_dict(camera(model="telecentric", stop_scale=-1.0))
