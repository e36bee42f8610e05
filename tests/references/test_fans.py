"""The adaptive reference: closed forms, its own error, and the other reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from references.bodies import Body, Simple, Triangles, fresnel_profile
from references.camera import ReferenceCamera, Stops
from references.fans import FanReference
from references.sampled import pupil_form
from references.shapes import Cylinder, Disc, Rectangle, Sphere

CAMERA = ReferenceCamera(55.0, 2.8, 165.0, 0.8, 12, 10)
PIXELS = np.array([(4, 3), (5, 6), (2, 9)])


def uniform(shape, **how):
    return Body(Simple(shape), lambda points, face: np.ones(len(points)), most=1.0, **how)


def power(*bodies, camera=CAMERA, stops=None, pixel="area", goal=1e-6):
    peak = np.pi * camera.scale
    return FanReference(camera, stops or Stops.of(camera), bodies, pixel).power(PIXELS, goal * peak, most=2048)


@pytest.mark.parametrize(
    ("shape", "pixel"),
    [
        (Sphere([0, 1, 170], 6.0), "area"),
        (Disc([2, 0, 150], [0.3, 0.1, -1.0], 5.0), "centre"),
        (Rectangle([1, 1, 175], [-5, 1, 0.3], [0.5, 2.5, 0.0]), "area"),
        (Cylinder([0, 0, 168], [1.0, 0.4, 0.2], 3.0, 11.0), "centre"),
    ],
)
def test_it_is_the_lattice_reference(shape, pixel):
    """Both state their errors. Seen to fail with cos³θ, and without the edges of the shapes."""
    found, error = power(uniform(shape), pixel=pixel, goal=1e-5)
    other, others = pupil_form(CAMERA, [shape], lambda points, k: np.ones(len(points)), 1 << 13, "lattice", pixel)
    row, column = PIXELS.T
    peak = other.max()
    assert other[row, column].max() > 0.3 * peak
    assert (np.abs(found - other[row, column]) <= error + 3 * others[row, column] + 2e-4 * peak).all()
    assert error.max() < 1e-3 * peak


def test_a_box_of_triangles_is_six_rectangles():
    import trimesh

    solid = trimesh.creation.box((8.0, 6.0, 5.0))
    turn = trimesh.transformations.rotation_matrix(0.6, [1, 2, 0.5])
    turn[:3, 3] = (0.5, 0.3, 160.0)
    solid.apply_transform(turn)
    vertices, faces = np.array(solid.vertices), np.array(solid.faces)
    mesh = Body(Triangles(vertices, faces, np.arange(12)), lambda points, face: np.ones(len(points)), most=1.0)
    sides = []
    for axis, size, others in ((0, 8.0, (6.0, 5.0)), (1, 6.0, (5.0, 8.0)), (2, 5.0, (8.0, 6.0))):
        for sign in (1, -1):
            a, b = turn[:3, (axis + 1) % 3] * others[0] / 2, turn[:3, (axis + 2) % 3] * others[1] / 2
            sides.append(uniform(Rectangle(turn[:3, 3] + sign * size / 2 * turn[:3, axis], sign * a, b)))
    (one, e1), (six, e6) = power(mesh, goal=1e-4), power(*sides, goal=1e-4)
    assert six.max() > 0
    assert (np.abs(one - six) <= e1 + e6).all()


def test_a_mirror_at_half_a_right_angle_shows_what_lies_beside():
    """A disc seen straight on, and one at the mirrored place off a mirror of 45 degrees."""
    straight, error = power(uniform(Disc([1.0, 0, 180], [0, 0, -1.0], 4.0)), goal=1e-4)
    mirror = Body(Simple(Rectangle([0, 0, 120], [0, 50, 0], [-50, 0, 50])), role="mirror")
    aside = uniform(Disc([-60.0, 0, 119.0], [1.0, 0, 0], 4.0))
    turned, other = power(mirror, aside, goal=1e-4)
    if not turned.any():  # the mirror's other side
        mirror = Body(Simple(Rectangle([0, 0, 120], [-50, 0, 50], [0, 50, 0])), role="mirror")
        turned, other = power(mirror, aside, goal=1e-4)
    assert straight.max() > 0
    assert (np.abs(turned - straight) <= error + other).all()


def test_a_pane_takes_its_share():
    """(1 - R)/(1 + R), at normal incidence R = ((n - 1)/(n + 1))²; nearly so in the middle of the field."""
    disc = uniform(Disc([0, 0, 180], [0, 0, -1.0], 60.0))
    pane = Body(Simple(Rectangle([0, 0, 100], [-90, 0, 0], [0, 90, 0])), role="pane", glass=1.5)
    bare, behind = (power(*bodies, goal=1e-4)[0][0] for bodies in ([disc], [disc, pane]))
    reflectance = (0.5 / 2.5) ** 2
    assert behind / bare == pytest.approx((1 - reflectance) / (1 + reflectance), rel=2e-3)


def test_the_exit_law_carries_the_exitance():
    """∫ L µ dΩ = J_n (Eq. M.14). Seen to fail with A = 1."""
    node, weight = np.polynomial.legendre.leggauss(400)
    cosine = (node + 1) / 2
    assert math.pi * (weight @ (fresnel_profile(cosine, 1.37) * cosine)) == pytest.approx(1, abs=1e-5)


def test_an_image_stop_and_a_lens_border_hold_light_back():
    """A stop leaves a quarter of its disc on a pixel beside the axis, a border of half the pupil a quarter of it."""
    disc = uniform(Disc([0, 0, 165], [0, 0, -1.0], 60.0))
    bare, _ = power(disc)
    dark, _ = power(disc, stops=Stops.of(CAMERA, image_stop=0.2))
    narrow, error = power(disc, stops=Stops.of(CAMERA, lens_diameter=CAMERA.pupil_radius))
    assert dark[[0, 2]].tolist() == [0, 0]
    assert dark[1] == pytest.approx(bare[1] * np.pi * 0.1**2 / 4 / CAMERA.pixel_pitch**2, rel=5e-3, abs=0)
    assert narrow == pytest.approx(bare / 4, rel=5e-3)
    assert (error < 1e-3 * bare).all()
