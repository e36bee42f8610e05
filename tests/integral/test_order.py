"""How fast both forms of Eq. 9 converge: a fitted order of the error in lines of sight, a ceiling of the last error.

Work is `Solution.rays`, the lines of sight of all pixels together; the error is the RMS over all pixels, relative to
the brightest one. Its reference is float64 NumPy: closed form of the filled cone, Gauss's rule where all is smooth, and
references/rows.py at silhouettes. A fit ends above three times the reference's own error or, where that is less, the
FLOAT32 floor.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from references import rows
from references.camera import ReferenceCamera
from references.sampled import pupil_form
from references.shapes import Rectangle
from small_scenes import F_NUMBER, FOCAL, FOCUS, PITCH, camera_scene, configuration_factor, disk, glow, sphere

from mitsuba_fspt.integral.quadrature import Quadrature

pytestmark = pytest.mark.usefixtures("mono")

WIDTH, HEIGHT = 8, 6
MIDDLE = (16, 13, WIDTH, HEIGHT)  # of the film of 40 × 32 pixels
FLOAT32 = 2e-7
# Lines of sight that a pixel may take: so many that the pupil form goes on to the next rule where all is smooth (4, 12,
# 56 and 297 nodes), or at an edge (4 and 12 nodes, 8, 24 and 72 transects).
RULES, TRANSECTS = (4, 16, 1000, 4000), (4, 16, 800, 3500, 13000)


def measured(scene, truth, domain, **knobs):
    """Lines of sight and RMS errors for every value of one knob of the quadrature, `rtol` or `max_nodes`."""
    import mitsuba as mi

    integrator, sensor = mi.load_dict({"type": "fspt_integral"}), scene.sensors()[0]
    ((knob, values),) = knobs.items()
    settings = [{"rtol": 1e-6, "domain": domain} | {knob: value} for value in values]
    solutions = [integrator.solve(scene, sensor, Quadrature(**setting)) for setting in settings]
    errors = [np.sqrt(np.mean((solution.power - truth) ** 2)) / truth.max() for solution in solutions]
    return np.array([solution.rays for solution in solutions], float), np.array(errors)


def order(rays, errors, floor=FLOAT32):
    """p of error ∝ rays^-p by least squares in the logarithms."""
    assert (np.diff(rays) > 0).all()
    assert errors.min() > 3 * max(floor, FLOAT32)
    return -np.polyfit(np.log(rays), np.log(errors), 1)[0]


# --- where all is smooth ---


def uniform(depth, radius, f_number=F_NUMBER, magnification=0.5):
    """A disk that fills all cones, and the closed form: A_vd times the mean configuration factor over each pixel."""
    focus, side = FOCAL * (1 + 1 / magnification), PITCH / magnification
    node, weight = np.polynomial.legendre.leggauss(6)
    x, y = ((n / 2 - np.arange(n)[:, None] - 0.5 - node / 2) * side for n in (WIDTH, HEIGHT))
    off_axis = np.hypot(x[None, :, None], y[:, None, :, None])
    factor = configuration_factor(FOCAL / f_number / 2, focus, off_axis) @ weight @ weight / 4
    optics = {"f_number": f_number, "magnification": magnification}
    return camera_scene(disk(depth, radius), crop=MIDDLE, **optics), side**2 * factor


def rippled(depth, wave, half=13.0, texels=512):
    """A sheet with J_n = 1 + cos(wave · x) / 2, linear between texels of 50 µm, and its image by Gauss's rule."""
    import mitsuba as mi

    place = ((np.arange(texels) + 0.5) / texels * 2 - 1) * half
    values = (1 + 0.5 * np.cos(wave * place)).astype(np.float32)
    bitmap = mi.Bitmap(np.tile(values, (2, 1))[..., None])
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp", "accel": False}
    to_world = mi.ScalarTransform4f().translate([0, 0, depth]).rotate([0, 1, 0], 180).scale(half)
    sheet = {"type": "rectangle", "to_world": to_world, "emitter": glow(texture)}
    camera = ReferenceCamera(FOCAL, F_NUMBER, FOCUS, PITCH, WIDTH, HEIGHT)
    exact = Rectangle([0, 0, depth], [0, half, 0], [half, 0, 0])
    truth, error = pupil_form(camera, [exact], lambda points, _: np.interp(points[:, 0], place, values), 10)
    assert error.max() < 5 * FLOAT32 * truth.max()
    return camera_scene(sheet, crop=MIDDLE), truth


@pytest.mark.parametrize(
    "build",
    [lambda: uniform(84.5, 30.0, f_number=1.0, magnification=2.0), lambda: rippled(230.0, 0.3)],
    ids=["uniform J_n at f/1", "rippled J_n"],
)
def test_pupil_form_where_all_is_smooth(build):
    """Rationale: each rule is exact for polynomials of a higher degree, so that smooth integrands converge spectrally.

    Expected: order 1.5 from 4 over 12 to 56 nodes (measured 1.75 and 2.26: a spectral rate has no fixed order, hence
    the margin), and the float32 floor, 5e-7, with the 297 that follow. Seen to fail with cos⁴θ → cos³θ (order 0) and
    with even nodes in place of Gauss's (0.2 and 0.8).
    """
    scene, truth = build()
    rays, errors = measured(scene, truth, "pupil", max_nodes=RULES)
    assert order(rays[:3], errors[:3]) > 1.5
    assert errors[3] < 5e-7


def test_surface_form_where_all_is_smooth():
    """Rationale: pieces of the surface and cells of the pupil, two dimensions each, are sampled in their middles, which
    leaves errors ∝ h²; with h ∝ lines^(-1/4) the order is 1/2.

    Expected, of rippled J_n nearly in focus: order 0.4 over one and a half decades of work (measured 0.46; of uniform
    J_n, blurred, 0.62) and, at rtol = 3e-3, an error of 5e-4. Seen to fail with the cosine at the surface dropped
    (0.18).
    """
    scene, truth = rippled(167.0, 0.6)
    rays, errors = measured(scene, truth, "surface", rtol=(0.3, 0.03, 1e-2, 3e-3))
    assert order(rays, errors) > 0.4
    assert errors[-1] < 5e-4


# --- where a silhouette crosses the pixels ---


# Pitch, nodes of the reference, and an object: kind, centre, radius. All edges are out of focus.
EDGED = {
    "disk": (0.6, 1 << 17, ("disk", (-37.0, -15.0, 140.0), 40.0)),
    "small sphere": (0.6, 1 << 15, ("sphere", (-12.0, -5.0, 185.0), 12.0)),
}


def edged(name):
    """Scene, reference and its RMS error relative to the brightest pixel."""
    pitch, _, *objects = EDGED[name]
    make = {"disk": disk, "sphere": sphere}
    shapes = [make[kind](z, radius, x, y) for kind, (x, y, z), radius in objects]
    return camera_scene(*shapes, crop=MIDDLE, pixel_pitch=pitch), *edged_truth(name)


@cache
def edged_truth(name):
    pitch, nodes, *objects = EDGED[name]
    make = {"disk": rows.Disk, "sphere": rows.Sphere}
    exact = [make[kind](centre, radius) for kind, centre, radius in objects]
    truth, error = rows.truth(ReferenceCamera(FOCAL, F_NUMBER, FOCUS, pitch, WIDTH, HEIGHT), *exact, nodes=nodes)
    return truth, np.sqrt(np.mean(error**2)) / truth.max()


@pytest.mark.parametrize(("name", "least", "ceiling"), [("disk", 1.7, 1e-5), ("small sphere", 1.2, 1e-4)])
def test_pupil_form_where_one_edge_crosses_the_pixels(name, least, ceiling):
    """Rationale: transects find an edge by bisection, and only the three places along it are left to sample.

    Expected, from 4 nodes to 72 transects: 1.7 where the edge is nearly straight (measured 2.05), above the
    1.5 that the estimate of the error counts on; 1.2 where the limb turns by 0.1 rad within a pixel (measured 1.46).
    The fit ends there: the last levels are made for whatever bends, and stay at 1e-5. Seen to fail with cos⁴θ → cos³θ
    (1.0 to 1.1), with four bisections of each edge (0.9 to 1.0) and with transects beside their places (0.3 to 0.6).
    """
    scene, truth, floor = edged(name)
    rays, errors = measured(scene, truth, "pupil", max_nodes=TRANSECTS)
    assert order(rays, errors, floor) > least
    assert errors[-1] < ceiling


def test_surface_form_where_edges_cross_the_pixels():
    """Rationale: what faces away or is hidden is decided line by line, at places that fill surface and pupil evenly.

    Expected: order 0.4, no worse than where all is smooth (measured 1.14 at a limb). Seen to fail with the cosine at
    the surface dropped (0.0).
    """
    scene, truth, floor = edged("small sphere")
    rays, errors = measured(scene, truth, "surface", rtol=(0.3, 0.03, 1e-2, 1e-3))
    assert order(rays, errors, floor) > 0.4
    assert errors[-1] < 2e-4
