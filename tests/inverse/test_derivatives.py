"""Derivatives by the parameters of a scene, against closed forms and against their own stated error."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import InversionError

DISK = """
    <shape type="disk">
        <transform name="to_world"><scale value="60"/><rotate y="1" angle="90"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""


def test_f_number_of_a_filled_field(tmp_path, mono):
    """A disc fills every cone of lines of sight: P = J A_vd f (Eq. M.17) with R = F/(2N), so that dP/dN is known.

    The stated error holds on every pixel and is small.
    """
    scene = write_scene(tmp_path / "disk.xml", shapes=DISK)
    found = fspt.derivatives(scene, ["f_number"])["f_number"]
    u, side, n = 165.0, 1.6, 8.0
    # On the axis f = R²/(u² + R²), dP/dN = −2 J A_vd u² R²/(N (u² + R²)²); off axis times cos⁴θ to lowest order in R.
    radius = 55 / n / 2
    axis = -2e-3 * side**2 * u**2 * radius**2 / (n * (u**2 + radius**2) ** 2)
    y, x = np.meshgrid((np.arange(6) - 2.5) * side, (np.arange(8) - 3.5) * side, indexing="ij")
    expected = axis / (1 + (x**2 + y**2) / u**2) ** 2
    np.testing.assert_allclose(found.value, expected, rtol=1e-3)
    assert found.error.max() < 5e-3 * np.abs(axis)
    assert (np.abs(found.value - expected) < found.error + 3e-4 * np.abs(axis)).all()


def test_silhouettes_move(tmp_path, mono):
    """A sphere that goes away: the sum of all pixels follows M.9, d ln ΣP/d distance, silhouettes included."""
    scene = write_scene(tmp_path / "ball.xml")
    found = fspt.derivatives(scene, ["distance"], rtol=1e-4)["distance"]
    sums = [float(fspt.render(fspt.load(scene, distance=d), rtol=1e-5).power.sum()) for d in (163.0, 167.0)]
    assert found.value.sum() == pytest.approx((sums[1] - sums[0]) / 4, rel=0.01, abs=0)
    assert found.value.sum() < 0


def test_what_has_no_derivative_is_refused(tmp_path, mono):
    scene = write_scene(tmp_path / "ball.xml")
    for names, words in ((["colour"], "no parameter 'colour'"), ([], "list of names"), ("f_number", "list of names")):
        with pytest.raises(InversionError, match=words):
            fspt.derivatives(scene, names)
    nylon = "scenes/nylon_cylinder.xml"
    for name in ("width", "rtol"):
        with pytest.raises(InversionError, match="sets the film or the accuracy"):
            fspt.derivatives(nylon, [name])
