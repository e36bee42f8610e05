"""Derivatives by the parameters of a scene, against closed forms and against their own stated error."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import LENS_XML, collected, mi, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.derivatives import Steps, _as_accurate_as_wanted, _Differences
from mitsuba_fspt.rendering import live_scene
from mitsuba_fspt.runtime.errors import InversionError

DISK = """
    <shape type="disk">
        <transform name="to_world"><scale value="60"/><rotate y="1" angle="90"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""


WALL = """
    <default name="shift" value="0.3"/>
    <shape type="rectangle">
        <transform name="to_world"><rotate y="1" angle="90"/><scale value="60"/><translate y="60"/>
            <translate x="-15" y="$shift"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>"""
FOCUSED = LENS_XML.replace('name="magnification" value="0.5"', 'name="focus_distance" value="$focus_distance"')


def pixels(nodes=8):
    """Points (nodes², 12, 14) of each pixel in its units from the axis, in two directions, and their weights."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    x = np.arange(8) - 3.5 + 0.5 * np.repeat(node, nodes)[:, None, None]
    y = np.arange(6)[:, None] - 2.5 + 0.5 * np.tile(node, nodes)[:, None, None]
    return x, y, np.outer(weight / 2, weight / 2).ravel()[:, None, None]


def filled(f_number, u, pitch=0.8, focal=55.0):
    """Power (h, w) of 1e-3 W/mm² that fills every cone: A_vd times the configuration factor, in closed form (M.17)."""
    side, radius = pitch * (u - focal) / focal, focal / f_number / 2
    x, y, weight = pixels()
    squared = side**2 * (x**2 + y**2)
    z = u**2 + radius**2 + squared
    root = np.sqrt(z**2 - 4 * radius**2 * squared)
    return 1e-3 * side**2 * (weight * 2 * radius**2 * u**2 / (root * (root + z - 2 * radius**2))).sum(axis=0)


def difference(law, at, step):
    """Derivative of a closed form, to fourth order in the step."""
    one, two = ((law(at + h) - law(at - h)) / (2 * h) for h in (step, step / 2))
    return (4 * two - one) / 3


def relative(found, expected):
    """Relative error in the norm of the image, and that which is stated."""
    return (np.linalg.norm(found.value - expected), np.linalg.norm(found.error)) / np.linalg.norm(expected)


def test_a_distorted_field_by_k1(tmp_path, mono):
    """By a coefficient inside the text of `distortion`, against differences of images at steps of our own.

    Of a uniform field P = A_vd f(r) times the Jacobian: the corner changes by about -4 r² of its power.
    """
    more = '<string name="distortion" value="$k1, 0.2, 0.01, 0"/>\n        <transform name="to_world">'
    sensor = '<default name="k1" value="-0.3"/>' + LENS_XML.replace('<transform name="to_world">', more)
    scene = write_scene(tmp_path / "s.xml", sensor=sensor, shapes=DISK)
    found = fspt.derivatives(scene, ["k1"], rtol=1e-5)["k1"]

    def image(k1):
        return fspt.render(fspt.load(scene, k1=k1), rtol=1e-5).power.astype(np.float64)

    expected = difference(image, -0.3, 0.5)
    off, stated = relative(found, expected)
    assert off < 1e-3
    assert off < 3 * stated + 1e-4
    corner = (3.5 * 0.8 / 82.5) ** 2 + (2.5 * 0.8 / 82.5) ** 2
    assert found.value[0, 0] / image(-0.3)[0, 0] == pytest.approx(-4 * corner, rel=0.05)


@pytest.mark.parametrize("loaded", [True, False])
def test_a_filled_field_by_f_number_and_focus(tmp_path, mono, loaded, monkeypatch):
    """A disc fills every cone of lines of sight: P = J A_vd f (Eq. M.17), so that dP/dN and dP/du are known.

    To 1e-3 in the norm, within the stated error, which is no more than 5e-3; of a scene that was loaded with other
    values, too, and from one load. Seen to fail with 2h for h, and with the values of a loaded scene left out.
    """
    loads, load = [], live_scene.load_source
    monkeypatch.setattr(live_scene, "load_source", lambda source: loads.append(source.given) or load(source))
    more = '<default name="focus_distance" value="150"/>'
    scene = write_scene(tmp_path / "disk.xml", sensor=more + FOCUSED, shapes=DISK)
    values = {"focus_distance": 165.0, "f_number": 5.6}
    names = ["f_number", "focus_distance"]
    found = fspt.derivatives(fspt.load(scene, **values), names) if loaded else fspt.derivatives(scene, names, **values)
    for name, law in (("f_number", lambda n: filled(n, 165.0)), ("focus_distance", lambda u: filled(5.6, u))):
        expected = difference(law, values[name], 1e-2 * values[name])
        off, stated = relative(found[name], expected)
        assert off <= 1e-3
        assert off <= stated <= 5e-3
    assert len(loads) == 1


def test_a_half_plane_that_is_shifted(tmp_path, mono):
    """Out of focus, dP/dshift is J/π times the étendue that the edge sweeps: the chord of the pupil that it cuts.

    Each pixel is a box of lines of sight through r_vd; of these the edge at y = s, z behind the focus, takes those
    with a = r + (s − r) u/(u − z): dP/ds = −J/π ∫ dA_vd ∫ chord · cos⁴θ/u² · u/(z_edge − u). Both axes to 1e-3.
    """
    scene = write_scene(tmp_path / "wall.xml", shapes=WALL)
    found = fspt.derivatives(fspt.load(scene), ["shift"], rtol=1e-5)["shift"]
    u, depth, side, radius, shift = 165.0, 180.0, 1.6, 55 / 8 / 2, 0.3
    x = np.arange(8) - 4 + ((np.arange(2000) + 0.5) / 2000)[:, None, None]  # the chord has a kink at either end
    y = np.arange(6)[:, None] - 2.5
    node, along = np.polynomial.legendre.leggauss(16)
    # Across the edge: from the virtual point r to the pupil point a in line with the edge.
    r, other = side * x, side * y
    a = r + (shift - r) * u / (u - depth)
    half = np.sqrt(np.maximum(radius**2 - a**2, 0))
    total = np.zeros(np.broadcast_shapes(r.shape, other.shape))
    for n, w in zip(node, along, strict=True):
        squared = u**2 + (r - a) ** 2 + (other - half * n) ** 2
        total = total + half * w * u**2 / squared**2
    expected = -1e-3 / np.pi * side**2 * total.mean(axis=0) * u / (depth - u)
    if np.vdot(found.value, expected) < 0:
        expected = expected[:, ::-1]
    off, stated = relative(found, expected)
    assert off <= 1e-3
    assert off <= 2 * stated <= 1e-2


def test_silhouettes_move(tmp_path, mono):
    """A sphere that goes away: the power on all pixels is that of form factors (M.9), silhouettes included, to 3e-3.

    Each pixel by Richardson's differences of images, within the stated error of some percent.
    """
    scene = write_scene(tmp_path / "ball.xml")
    found = fspt.derivatives(scene, ["distance"], rtol=1e-3)["distance"]

    def law(distance):
        return fspt.render(fspt.load(scene, distance=distance), method="integral", rtol=1e-3).power.astype(np.float64)

    off, stated = relative(found, difference(law, 165.0, 3.3))
    assert off <= stated <= 0.05
    total = difference(lambda distance: 1e-3 * collected(3.0, distance, pupil=55 / 8 / 2), 165.0, 1.0)
    assert found.value.sum() == pytest.approx(total, rel=3e-3, abs=0)


def test_what_has_no_derivative_is_refused(tmp_path, mono):
    scene = write_scene(tmp_path / "ball.xml")
    for names, words in ((["colour"], "no parameter 'colour'"), ([], "list of names"), ("f_number", "list of names")):
        with pytest.raises(InversionError, match=words):
            fspt.derivatives(scene, names)
    with pytest.raises(InversionError, match="a dictionary has no parameters"):
        fspt.derivatives({"type": "scene"}, ["f_number"])
    with pytest.raises(InversionError, match=r"that fspt\.load did not make of a file"):
        fspt.derivatives(mi.load_file(str(scene)), ["f_number"])
    with pytest.raises(InversionError, match=r"no parameter 'colour'"):
        fspt.derivatives(fspt.load(scene), ["colour"])
    nylon = "scenes/nylon_cylinder.xml"
    for name in ("width", "rtol"):
        with pytest.raises(InversionError, match="sets the film or the accuracy"):
            fspt.derivatives(nylon, [name])


def test_differences_are_of_fourth_order():
    """dP/dx of P = eˣ at x = 1 with steps 0.1 and 0.2: 4 h⁴/120 too small, 3.3e-6; one difference is 1.7e-3 too large.

    Seen to fail with the shorter difference alone.
    """

    def picture(change):
        return fspt.Image(np.full((1, 1), np.exp(change["x"])), np.zeros((1, 1)))

    found = _Differences("x", 1.0, picture, Steps(first=0.1, most=0)).best()
    assert found.value[0, 0] / np.e - 1 == pytest.approx(-4e-4 / 120, rel=0.05, abs=0)
    assert abs(found.value[0, 0] - np.e) < found.error[0, 0]


@pytest.mark.parametrize(
    ("share", "lines", "expected"),
    [
        (0.01, 100, [1e-3]),  # accurate at once
        (1.0, 100, [1e-3, 1e-4]),
        (10.0, 100, [1e-3, 1e-4, 1e-5]),  # never: the smallest rtol
        (10.0, 100_000, [1e-3, 1e-4]),  # a tenth of that would take more lines than allowed
    ],
)
def test_integrals_are_as_accurate_as_the_derivative_needs(share, lines, expected):
    """dP/dx of P = x² at x = 1 from images whose errors are a share of rtol; steps may take 1e7 lines of sight."""
    asked = []

    def image(rtol, change):
        asked.append(rtol)
        error = np.full((1, 1), share * rtol)
        return fspt.Image(np.full((1, 1), change["x"] ** 2), error, metadata={"nodes": lines * round(1e-3 / rtol)})

    found = _as_accurate_as_wanted("x", 1.0, image, Steps(first=0.1, most=0, lines=10_000_000))
    assert sorted(set(asked), reverse=True) == pytest.approx(expected)
    assert found.value[0, 0] == pytest.approx(2.0, rel=1e-6)
