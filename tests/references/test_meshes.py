"""The reference over triangle meshes against rays, the analytic bodies and its own finer runs.

Seen to fail: with the depth buffer off, backs lit or left out, cos² for cos⁴, J_n interpolated without perspective,
or the grid's shift dropped: the ray casting; with the standard error halved, or no pixel refined: the stated error.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from references import meshes
from references.cases import EXITANCE, camera, pose, rms, sheet, uniform, wavy
from references.meshes import TriangleMesh, load_ply, mesh_truth
from references.sampled import pupil_form
from references.shapes import Sphere


def ball_mesh(centre, radius, subdivisions, exitance=uniform) -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices, faces = np.asarray(ball.vertices) + centre, np.asarray(ball.faces)
    return TriangleMesh(vertices, faces, exitance(vertices, 0)[faces])


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    start = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + i for mesh, i in zip(meshes, start, strict=True)]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate([mesh.exitance for mesh in meshes]),
    )


def cast(mesh: TriangleMesh, origin, direction):
    """J_n met by every ray, and whether it meets anything: all rays against all triangles."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    edge, other, start = b - a, c - a, origin - a
    p, q = np.cross(direction[:, None], other), np.cross(start, edge)
    det = np.sum(edge * p, axis=-1)
    u, v = np.sum(start * p, axis=-1) / det, np.sum(direction[:, None] * q, axis=-1) / det
    s = np.sum(other * q, axis=-1) / det
    s = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (s > 0), s, np.inf)
    ray, face = np.arange(len(direction)), np.argmin(s, axis=1)
    u, v = u[ray, face], v[ray, face]
    flux = np.sum(np.stack([1 - u - v, u, v], axis=1) * mesh.exitance[face], axis=1)
    met = np.isfinite(s[ray, face])
    return np.where(met & (det[ray, face] > 0), flux, 0.0), met


@pytest.mark.parametrize("closed", [True, False])
def test_rasteriser_agrees_with_traced_rays(closed):
    """Rationale: scan conversion with a depth buffer and ray casting look along the same lines of sight.
    Expected: the same image to 1e-11, with occlusion, perspective, exitance per face and dark backs.
    """
    lens = camera(width=12, height=10, pixel_pitch=0.7)
    far, near = ball_mesh([0, 0, 200.0], 7.0, 2, wavy), ball_mesh([3.0, 2, 150.0], 2.5, 1, wavy)
    parts = [near, far]
    if not closed:
        steps = EXITANCE * (1 + np.arange(len(near.faces)) % 3)
        parts.append(TriangleMesh(near.vertices - [7, 1, 0], near.faces, np.repeat(steps[:, None], 3, axis=1)))
        parts[-1] = TriangleMesh(parts[-1].vertices, parts[-1].faces[::3], parts[-1].exitance[::3])
    mesh = joined(*parts)
    assert mesh.closed() == closed
    pupil, shift, samples = np.array([4.0, -7.0]), np.array([0.37, 0.81]), 3
    image = meshes._View.of(lens, mesh).radiate(pupil, shift, samples, np.zeros(12 * 10 * samples**2))
    x = (6 - (np.arange(12 * samples) + shift[0]) / samples) * 1.4
    y = (5 - (np.arange(10 * samples) + shift[1]) / samples) * 1.4
    origin = np.array([*pupil, 0.0])
    line = np.stack([*np.meshgrid(x, y), np.full((30, 36), 165.0)], axis=-1).reshape(-1, 3) - origin
    flux, met = cast(mesh, origin, line)
    assert np.count_nonzero(flux) > 200
    assert (np.count_nonzero(met) > np.count_nonzero(flux)) != closed  # backs are met where the mesh is open
    light = flux * (165 / np.linalg.norm(line, axis=1)) ** 4
    expected = light.reshape(10, samples, 12, samples).sum(axis=(1, 3)).ravel()
    np.testing.assert_allclose(image, expected, rtol=1e-11, atol=1e-11 * expected.max())


def test_doubled_faces_shine_once_and_insides_are_dark():
    """Rationale: the first point of a line of sight is one point, however many triangles share it."""
    lens, ball = camera(pixel_pitch=0.8), ball_mesh([0, 0, 180.0], 4.0, 2)
    once, twice, turned = (
        mesh_truth(lens, mesh, levels=((16, 2),))[0]
        for mesh in (ball, joined(ball, ball), TriangleMesh(ball.vertices, ball.faces[:, ::-1], ball.exitance))
    )
    assert once.max() > 0
    np.testing.assert_array_equal(twice, once)
    assert turned.max() == 0


def test_fine_mesh_of_a_sphere_converges_to_the_sphere():
    """Rationale: inscribed triangles miss a sphere by O(h²).
    Expected: order 2 of the whole power under halved edges, 1e-3 of it at last, a pixel RMS of 1e-3.
    """
    lens = camera(pixel_pitch=0.8, to_world=pose())
    centre = lens.in_world(np.array([[0.5, 0.3, 180.0]]))[0]
    exact, _ = pupil_form(lens, [Sphere(centre, 4.0)], wavy, 2**15, "lattice")
    off = []
    for subdivisions in (2, 3, 4):
        power, _ = mesh_truth(
            lens, ball_mesh(centre, 4.0, subdivisions, wavy), levels=((128, 4 if subdivisions < 4 else 8),)
        )
        off.append(1 - power.sum() / exact.sum())
    assert 0 < off[2] < 1e-3
    assert rms(power - exact) < 1e-3 * exact.max()
    np.testing.assert_allclose(np.log2(np.divide(off[:2], off[1:])), 2, atol=0.2)


def test_mesh_reference_meets_the_closed_form():
    """Rationale: two triangles across all lines of sight are the analytic sheet. Expected: to 1e-6."""
    plane = sheet(400.0)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.asarray(plane.centre) + signs @ np.stack([plane.half_width, plane.half_height])
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full((2, 3), EXITANCE))
    exact, _ = pupil_form(camera(), [plane], uniform, 6)
    power, error = mesh_truth(camera(), mesh, levels=((256, 2),))
    np.testing.assert_allclose(power, exact, rtol=1e-6)
    assert 0 < error.max() < 1e-6 * power.max()


def test_mesh_reference_states_its_error():
    """Rationale: independent shifts make the standard error honest, and only hard pixels need refinement.
    Expected: the RMS error against a finer run is within a factor of two of the one stated, at both levels.
    """
    lens = camera(width=24, height=20, pixel_pitch=0.25)
    mesh = joined(ball_mesh([0, 0, 180.0], 4.0, 3), ball_mesh([2.0, 1, 150.0], 1.0, 2))
    truth, bound = mesh_truth(lens, mesh, levels=((512, 3),), replicas=4, seed=1)
    stated = []
    for levels in (((64, 3),), ((64, 3), (256, 3))):
        power, error = mesh_truth(lens, mesh, levels=levels, replicas=4)
        stated.append(rms(error) / truth.max())
        assert 0.5 < rms(power - truth) / rms(error) < 2
    assert rms(bound) / truth.max() < stated[1] < stated[0] / 2 < 1e-3


def test_mesh_reference_of_a_region_is_that_of_the_whole():
    lens = camera(width=24, height=20, pixel_pitch=0.25)
    mesh = ball_mesh([0, 0, 180.0], 4.0, 3)
    region = np.zeros((20, 24), bool)
    region[3:8, 6:15] = True
    whole, _ = mesh_truth(lens, mesh, levels=((16, 2),))
    part, error = mesh_truth(lens, mesh, levels=((16, 2),), region=region)
    assert whole[region].max() > 0
    np.testing.assert_allclose(part[region], whole[region], rtol=1e-12)
    assert np.isnan(part[~region]).all()
    assert np.isnan(error[~region]).all()


@pytest.mark.parametrize("element", ["vertex", "face"])
def test_load_ply_reads_the_exitance(tmp_path, element):
    ball = trimesh.creation.icosphere(subdivisions=1)
    values = np.arange(len(ball.vertices if element == "vertex" else ball.faces), dtype=np.float64)
    getattr(ball, f"{element}_attributes")["exitance_x"] = values
    ball.export(tmp_path / "ball.ply")
    mesh = load_ply(tmp_path / "ball.ply")
    np.testing.assert_allclose(mesh.vertices, ball.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    expected = values[ball.faces] if element == "vertex" else np.repeat(values[:, None], 3, axis=1)
    np.testing.assert_array_equal(mesh.exitance, expected)


def test_bad_input_is_refused(tmp_path):
    ball = ball_mesh([0, 0, 5.0], 6.0, 1)
    with pytest.raises(ValueError, match="lens plane"):
        mesh_truth(camera(), ball)
    with pytest.raises(ValueError, match="shape"):
        TriangleMesh(ball.vertices, ball.faces, ball.exitance[:, 0])
    trimesh.creation.box().export(tmp_path / "plain.ply")
    with pytest.raises(ValueError, match="exitance_x"):
        load_ply(tmp_path / "plain.ply")
    with pytest.raises(ValueError, match=r"nothing\.ply"):
        load_ply(tmp_path / "nothing.ply")
