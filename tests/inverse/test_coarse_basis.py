"""Fewer unknowns than a mesh has vertices: functions that are linear between some of them, and J_n by them."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay
from sphere_views import RADIUS, noisy, sphere_views

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.coarse_basis import coarser, neighbours
from mitsuba_fspt.inverse.invert import Settings
from mitsuba_fspt.inverse.surface import Surface


def surface_of(vertices, faces, on="vertex"):
    number = np.arange(len(faces if on == "face" else vertices))
    return Surface(np.asarray(vertices, float), np.asarray(faces), {"shape": slice(0, len(number))}, on, number)


def test_linear_functions_on_a_plane_are_kept():
    """Coordinates on a flat mesh follow from those of the chosen vertices, but at its rim.

    Seen to fail with each vertex at the chosen one that it belongs to.
    """
    points = np.random.default_rng(0).random((3000, 2)) * 60
    points = np.c_[points, np.zeros(3000)]
    flat = surface_of(points, Delaunay(points[:, :2]).simplices)
    basis, _, chosen = coarser(neighbours(flat.faces, 3000), points)
    np.testing.assert_allclose(basis.sum(axis=1), 1, rtol=1e-12)
    assert basis.data.min() >= 0
    inside = (np.abs(points[:, :2] - 30) < 24).all(axis=1)
    error = np.abs(basis @ points[chosen] - points)[inside].max(axis=1)
    assert np.mean(error > 1e-9) < 0.02  # beside a triangle that does not have their own vertex as a corner
    assert error.max() < 60 / len(chosen) ** 0.5 / 2


@pytest.mark.parametrize("on", ["vertex", "face"])
def test_smooth_functions_on_a_sphere(on):
    """z on a sphere from a half to a quarter of the unknowns: −Δ z = 2 z/R² to 3 %, as on the whole mesh.

    Its areas are those of the sphere. Seen to fail with the areas of the chosen vertices alone.
    """
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    fine = surface_of(sphere.vertices, sphere.faces, on)
    level = fine.coarser()[1 if on == "vertex" else 2]
    assert 2 < fine.unknowns / level.unknowns < 10
    assert level.areas.sum() == pytest.approx(sphere.area)
    z = sphere.vertices[:, 2] if on == "vertex" else sphere.triangles_center[:, 2]
    c = np.linalg.lstsq(level.basis.toarray(), z)[0]
    np.testing.assert_allclose(level.basis @ c, z, atol=0.02 * RADIUS)
    assert c @ (level.stiffness @ c) / (c @ (level.areas * c)) == pytest.approx(2 / RADIUS**2, rel=0.03)


@pytest.fixture(scope="module")
def case(mono):
    """Matrix of a sphere of 642 vertices, and noisy images of 300 electrons."""
    matrix = sphere_views(subdivisions=3, rtol=3e-3)
    exitance = 1e-3 * (1 + 0.5 * Surface.of(matrix).vertices[:, 2] / RADIUS)
    return matrix, noisy(matrix, exitance, 300, 3)


def test_j_is_that_of_the_whole_mesh(case):
    """With a quarter of the unknowns J_n is the same to a fraction of its sd, the total of its interval.

    The default takes more unknowns where the data determine more than an eighth of them.
    """
    matrix, images = case
    few = Settings(unknowns=400, resolved=1.0)
    one, other = (fspt.invert(matrix, images, samples=100, settings=s) for s in (few, Settings()))
    assert one.surface.unknowns < 200
    half = np.ptp(other.total_interval) / 2
    assert one.total == pytest.approx(other.total, abs=0.1 * half)
    assert np.sqrt(np.mean(((one.exitance - other.exitance) / other.sd) ** 2)) < 0.3
    lost = 2 / np.pi * other.determined / one.surface.unknowns
    assert np.median(one.sd / other.sd) == pytest.approx((1 - lost) ** 0.5, abs=0.05)
    assert fspt.invert(matrix, images, settings=Settings(unknowns=400)).surface.unknowns == 642


def test_rounds_that_do_not_converge_are_reported(case, caplog):
    matrix, images = case
    assert fspt.invert(matrix, images).converged
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        found = fspt.invert(matrix, images, settings=Settings(rounds=1))
    assert not found.converged
    assert "still change after 1 rounds" in caplog.text
