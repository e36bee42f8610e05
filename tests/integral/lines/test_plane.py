"""Planes of flat shapes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from small_scenes import mi

from mitsuba_fspt.integral.lines.plane import Plane

pytestmark = pytest.mark.usefixtures("mono")


def mesh_of(points, faces):
    """A mesh of points (V, 3) and faces (F, 3)."""
    mesh = mi.Mesh("mesh", len(points), len(faces))
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
    values["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    values.update()
    return mesh


def test_planes_of_a_mesh_are_told_apart(mono):
    """As of mirrors that Mitsuba merges into one mesh when it loads a dictionary."""
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale([1, 2, 3])})
    planes = Plane.of(cube)
    expected = {tuple(sign * axis) for axis in np.eye(3) for sign in (1, -1)}
    assert {tuple(np.round(plane.normal) + 0.0) for plane in planes} == {
        tuple(n + 0.0) for n in map(np.array, expected)
    }
    for plane in planes:
        assert np.ptp(plane.corners @ plane.normal) == pytest.approx(0, abs=1e-6)
        assert np.allclose(np.sort(np.ptp(plane.corners, axis=0)), np.sort(2 * (1 - abs(plane.normal)) * [1, 2, 3]))
        assert plane.filled
    assert Plane.of(mi.load_dict({"type": "sphere"})) == ()


def test_a_fine_mesh_far_from_the_origin_is_one_plane(mono):
    """Of 320,000 faces in float32, whose own normals differ by their rounding; and two such meshes in one."""
    side = np.linspace(-50, 50, 401)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.4]))[:3, :3]
    x, y = (c.ravel() for c in np.meshgrid(side, side))
    points = np.column_stack([x, y, np.full(x.size, 500.0)])
    number = np.arange(x.size).reshape(401, 401)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    for count in (1, 2):
        places = np.concatenate([points + np.array([0, 0, 60 * k]) for k in range(count)]) @ turn.T
        planes = Plane.of(mesh_of(places, np.concatenate([faces + k * x.size for k in range(count)])))
        assert len(planes) == count
        assert all(abs(plane.normal @ turn[:, 2]) == pytest.approx(1, abs=1e-9) for plane in planes)


def test_a_disk_does_not_fill_the_rectangle_around_it(mono):
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 30).scale(5)
    (plane,) = Plane.of(mi.load_dict({"type": "disk", "to_world": turn}))
    assert not plane.filled
    assert np.linalg.norm(plane.corners, axis=1) == pytest.approx(5 * np.sqrt(2))


def test_the_part_of_a_triangle_above_a_plane():
    """Seen to fail where points below it, or none of those on it, are corners of the part."""
    level = Plane(np.zeros(3), np.array([0.0, 0, 1]), np.empty((0, 3)))
    part = level.part_above(np.array([[0.0, 0, 3], [0, 0, -1], [4, 0, -1]]))
    assert sorted(part.round(9).tolist()) == [[0, 0, 0], [0, 0, 3], [3, 0, 0]]
    assert len(level.part_above(np.array([[0.0, 0, 0], [1, 0, -1]]))) == 0


def test_facets_of_similar_directions_have_their_own_normals(mono):
    """Of 45° and 46°, in one mesh. Seen to fail with the mean of both for one of them."""
    square = 10 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners = []
    for degrees in (45, 46):
        turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 1, 0])[:3, :3]
        corners.append(square @ turn.T + [21.0 * (degrees - 45), 0, 0])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    planes = Plane.of(mesh_of(np.concatenate(corners), np.concatenate([faces, faces + 4])))
    found = sorted(round(float(np.degrees(np.arctan2(plane.normal[0], plane.normal[2]))), 4) for plane in planes)
    assert found == [45.0, 46.0]
    assert all(plane.filled for plane in planes)


def test_bars_that_overlap_fill_no_frame(mono):
    """Four bars around an opening, as wide in all as the square. Seen to fail by the sum of their areas."""
    bars = [(-8, 8, -8, -4), (-8, 8, 4, 8), (-8, -4, -8, 8), (4, 8, -8, 8)]
    points = np.array([[x, y, 0.0] for a, b, c, d in bars for x, y in ((a, c), (b, c), (b, d), (a, d))])
    faces = np.array(
        [[4 * k, 4 * k + 1, 4 * k + 2] for k in range(4)] + [[4 * k, 4 * k + 2, 4 * k + 3] for k in range(4)]
    )
    (frame,) = Plane.of(mesh_of(points, faces))
    assert not frame.filled
