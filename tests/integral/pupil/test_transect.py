"""Transects: evenly through pixel and pupil, across a straight edge once, and right about its share at once."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import glow, lens, mi, world_scene

from mitsuba_fspt.integral.lines.eq9 import View
from mitsuba_fspt.integral.lines.visible_window import visible_window
from mitsuba_fspt.integral.pupil import node_rules
from mitsuba_fspt.integral.pupil.draft import Draft
from mitsuba_fspt.integral.pupil.jumps import integrate_transect
from mitsuba_fspt.integral.pupil.nodes import first_nodes
from mitsuba_fspt.integral.pupil.transect import transect
from mitsuba_fspt.integral.pupil.transects import apply_transects, edges_of
from mitsuba_fspt.integral.quadrature import Quadrature
from mitsuba_fspt.jit.pixel_grid import parted

pytestmark = pytest.mark.usefixtures("mono")

S = np.linspace(-1, 1, 1001)
BLURS = [0.05, 0.3, 1.0, -4.0, 25.0]
ANGLES = [0.0, 25.0, 130.0, -75.0]


def traced(place, weight, angle, blur, area=1.0):
    """Film places from the pixel's centre (n, s, 2), pupil points (n, s, 2), and weights (n, s) of all points."""
    n = len(place)
    every = mi.Point3f(*np.repeat(place, len(S), axis=0).T.astype(np.float32))
    centre = mi.Point2f(10.5, 20.5)
    curve = transect(centre, mi.Float(np.radians(angle)), mi.Float(blur), every, mi.Float(area))
    position, pupil, density = curve.at(mi.Float(np.tile(S, n).astype(np.float32)))
    position, pupil = (np.array(points, np.float64).T.reshape(n, len(S), 2) for points in (position, pupil))
    density = np.array(density, np.float64).reshape(n, len(S))
    return position - [10.5, 20.5], pupil, density * np.gradient(S) * np.asarray(weight)[:, None]


@pytest.mark.parametrize("blur", BLURS)
@pytest.mark.parametrize("angle", ANGLES)
def test_transects_fill_pixel_and_pupil_evenly(angle, blur):
    """Expected: moments of square and disc, 1/12 and 1/4, and no correlation. Fails if the density is left out."""
    rule = node_rules.transects(1024)
    pixel, pupil, weight = traced(rule.blurred, rule.weight, angle, blur)
    assert weight.sum() == pytest.approx(1, abs=2e-4)
    points = np.concatenate([pixel, pupil], axis=-1).reshape(-1, 4)
    assert np.all(np.abs(points[:, :2]) <= 0.5 + 1e-5)
    assert np.all((points[:, 2:] ** 2).sum(1) <= 1 + 1e-5)
    np.testing.assert_allclose(weight.ravel() @ points, 0, atol=5e-3)
    second = points.T @ (weight.reshape(-1, 1) * points)
    np.testing.assert_allclose(second, np.diag([1 / 12, 1 / 12, 1 / 4, 1 / 4]), atol=5e-3)


@pytest.mark.parametrize("blur", BLURS)
@pytest.mark.parametrize("angle", ANGLES)
def test_every_transect_meets_a_straight_edge_at_one_place(angle, blur):
    """n·(p - r a) less what the pixel's other axis adds is proportional to s, on every transect alike.

    Fails if the pupil leans the other way for one sign of the blur.
    """
    rule = node_rules.transects(24)
    pixel, pupil, _ = traced(rule.blurred, rule.weight, angle, blur)
    n = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    other = 1 - np.argmax(np.abs(n))
    across = pixel @ n - blur * (pupil @ n) - pixel[..., other] * n[other]
    half = np.abs(n).max() / 2 + abs(blur)
    np.testing.assert_allclose(across, np.broadcast_to(half * S, across.shape), atol=2e-4 * half)


@pytest.mark.parametrize("blur", [0.01, 0.3, 2.0, 32.0])
def test_moments_are_integrals_of_the_density(blur):
    place = np.full((1, 3), 0.5)
    _, _, weight = traced(place, [1.0], 30.0, blur)
    curve = transect(mi.Point2f(0), mi.Float(np.radians(30)), mi.Float(blur), mi.Point3f(0.5), mi.Float(1))
    ends = np.linspace(-1, 1, 9)
    measure, first = (np.array(column, np.float64) for column in curve.moments(mi.Float(ends.astype(np.float32))))
    middle = weight[0] - 0.5 * weight[0] * (np.arange(len(S)) % (len(S) - 1) == 0)
    counted = np.cumsum(middle) - 0.5 * middle
    np.testing.assert_allclose(measure, np.interp(ends, S, counted), atol=1e-3)
    np.testing.assert_allclose(first, np.interp(ends, S, np.cumsum(middle * S)), atol=1e-3)
    assert measure[[0, -1]] == pytest.approx([0, 1], abs=1e-6)


def test_at_its_centre_a_pixel_has_no_width():
    rule = node_rules.transects(8)
    pixel, pupil, weight = traced(rule.blurred, rule.weight, 40.0, 3.0, area=0.0)
    assert np.abs(pixel).max() < 1e-5
    assert np.einsum("ns,nsk->k", weight, pupil**2) == pytest.approx([0.25, 0.25], abs=3e-3)


def share_of_corner(place, weight, blur, other, turn):
    """Share of pixel × pupil before an edge across transects and behind another, `turn`ed and blurred by `other`."""
    pixel, pupil, weight = traced(place, weight, 0.0, blur)
    n = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    before = pixel[..., 0] - blur * pupil[..., 0] > 0
    return float(np.sum(weight * (before & (pixel @ n - other * (pupil @ n) > 0.3 * other))))


@pytest.mark.parametrize(("blur", "other"), [(4.0, 2.5), (-4.0, 3.0), (1.0, 0.5)])
def test_transects_across_the_pupil_give_the_share_of_a_corner(blur, other):
    """Where a second edge crosses the first one transects kink across the pupil, and little along their other places.

    Expected: 24 of them right to 6e-3 of the whole; 27, three on each axis, miss it by more than twice that.
    """
    three, weight = node_rules.gauss(3)
    cube = np.stack(np.meshgrid(three, three, three), axis=-1).reshape(-1, 3)
    even = np.multiply.outer(np.outer(weight, weight), weight).ravel()
    few, many = node_rules.transects(24), node_rules.transects(1024)
    off = {"few": [], "cube": []}
    for turn in (50.0, 80.0, 110.0):
        share = share_of_corner(many.blurred, many.weight, blur, other, turn)
        assert 0.05 < share < 0.3
        off["few"].append(share_of_corner(few.blurred, few.weight, blur, other, turn) - share)
        off["cube"].append(share_of_corner(cube, even, blur, other, turn) - share)
    few, cube = (np.sqrt(np.mean(np.square(errors))) for errors in off.values())
    assert few < 6e-3
    assert cube > 2 * few


def test_scatter_is_large_at_kinks_and_small_at_slopes():
    """One sphere before another, both blurred: 24 transects against 1024, on the pixels that silhouettes part.

    Expected: no less than the error wherever that is a thousandth of the peak, but for one pixel in twenty; and on most
    pixels, which see one edge alone, little. Fails without KINK, and if the trend is not taken off (1.1e-2).
    """
    import drjit as dr

    balls = [{"type": "sphere", "center": [x, y, 0], "radius": 4.0, "emitter": glow()} for x, y in ((12, -2), (-15, 2))]
    scene = world_scene(*balls, sensor=lens(48, pitch=0.2, f_number=2.8))
    sensor = scene.sensors()[0]
    window = visible_window(scene, sensor.camera)
    draft = Draft(View.of(scene, sensor.camera, window), window, Quadrature(rtol=1e-4), None)
    first_nodes(draft, np.zeros(draft.grid.shape))
    cut = parted(draft.coverage)
    edges = edges_of(draft)
    edges.update(
        draft, apply_transects(draft, cut, edges, node_rules.transects(2), node_rules.along_transect(0, 1e-4)), cut
    )
    few, many = (
        apply_transects(draft, cut, edges, node_rules.transects(count), node_rules.along_transect(level, 1e-4))
        for level, count in ((2, 24), (5, 1024))
    )
    pixels, peak = np.array(dr.compress(cut)), float(draft.peak[0])
    error = np.abs(np.array(few.value) - np.array(many.value))[pixels] / peak
    scatter = np.array(few.scatter)[pixels] / peak
    kinked = error > 1e-3
    assert kinked.sum() > 10
    assert np.mean(scatter[kinked] >= error[kinked]) > 0.95
    assert np.median(scatter) < 5e-3


def share_of_edge(offset, normal, blur):
    """Share of pixel × pupil with n·p + r y < offset: of the pupil by its segments, over the pixel by midpoints."""
    x, y = np.meshgrid((np.arange(400) + 0.5) / 400 - 0.5, (np.arange(400) + 0.5) / 400 - 0.5)
    a = np.clip((offset - normal[0] * x - normal[1] * y) / blur, -1, 1)
    return float(np.mean(0.5 + (a * np.sqrt(1 - a * a) + np.arcsin(a)) / np.pi))


@pytest.mark.parametrize(("shift", "turn"), [(-14.0, 12.0), (20.0, 40.0)], ids=["nearer", "farther"])
def test_eight_transects_give_the_share_of_a_straight_edge(shift, turn):
    """Half a plane that glows all alike, out of focus, at any angle to the pixels; small angles, cos⁴θ is 1.

    Expected: the segment of the blur disc averaged over the pixel, to 3e-4 of the whole wherever the edge passes.
    Fails if the blur's sign is dropped, and if what the pixel adds is left out.
    """
    width = 20.0
    corner = mi.ScalarTransform4f().translate([shift, 0, 0]).rotate([1, 0, 0], turn).rotate([0, 1, 0], 90)
    plane = corner.translate([0, width, 0]).scale(width)
    scene = world_scene(
        {"type": "rectangle", "to_world": plane, "emitter": glow()}, sensor=lens(24, pitch=0.02, f_number=20.0)
    )
    rays = [node_rules.along_transect(level, 1e-4).rays for level in (0, 1)]
    sensor, few = scene.sensors()[0], Quadrature(rtol=1e-4, max_nodes=16 + 2 * rays[0] + 8 * rays[1] + 56)
    solution = scene.integrator().solve(scene, sensor, few)
    assert any("8 transects" in level for level in solution.levels)
    assert not any("24 transects" in level for level in solution.levels)
    blur = abs(float(sensor.camera.blur_radius(mi.Float64(165.0 - shift))[0]))
    assert 2 < blur < 12
    # The plane's border runs through the middle of the film; depth stretches the pixels, and no more than that.
    rows, columns = np.mgrid[:24, :24] + 0.5 - 12
    edge = np.array([[-np.cos(np.radians(turn)), np.sin(np.radians(turn))]])
    whole = np.median(solution.power[solution.coverage > 1 - 1e-6])
    cut = (solution.coverage > 1e-3) & (solution.coverage < 1 - 1e-3)
    assert cut.sum() > 40
    found, place = (solution.power / whole)[cut], np.stack([columns, rows], -1)[cut] @ edge[0]
    signs = [np.array([share_of_edge(sign * p, edge[0], blur) for p in place]) for sign in (1, -1)]
    off = min(np.abs(found - expected).max() for expected in signs)
    assert off < 3e-4


def test_a_transect_is_split_where_it_enters_one_body_leaves_it_for_another_and_leaves_that():
    """One sphere before another, transects from side to side: dark, one, the other, dark.

    Expected: the mean over 4000 points of the same transect to 1e-3. Fails if only two jumps are searched for (3e-2).
    """
    balls = [
        {"type": "sphere", "center": [x, y, 0], "radius": 2.0, "emitter": glow(j)}
        for x, y, j in ((10, -1, 2e-3), (-10, 1, 1e-3))
    ]
    scene = world_scene(*balls, sensor=lens(8, pitch=4.0, f_number=2.8))
    sensor, points, number = scene.sensors()[0], 4000, 16
    view = View.of(scene, sensor.camera, visible_window(scene, sensor.camera))
    place = np.stack([np.linspace(0.3, 0.7, number), np.full(number, 0.5), np.linspace(0.4, 0.6, number)])

    def curves(copies):
        return transect(mi.Point2f(4), mi.Float(0), mi.Float(0.2), mi.Point3f(np.repeat(place, copies, 1)), mi.Float(1))

    s = (np.tile(np.arange(points), number) + 0.5) / points * 2 - 1
    position, pupil, density = curves(points).at(mi.Float(s))
    light = np.array(view.integrand(position, pupil).integrand * density, np.float64)
    expected = 2 * light.reshape(number, points).mean(axis=1)
    along = node_rules.AlongTransect(scan=24, bisections=16, nodes=6)
    phase = mi.Float(node_rules.transects(24).phase[:number])
    value, _, _, jumps, *_ = integrate_transect(view, curves(1), phase, along, mi.Float(1e-2), mi.Float(1e-9), 4.0)
    assert np.all(np.array(jumps) == 3)
    np.testing.assert_allclose(value, expected, atol=1e-3 * expected.max())
