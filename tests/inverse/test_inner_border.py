"""J_n of sources close to the border between two media, and its slopes, against a closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from closed_forms import layers_fluence

from mitsuba_fspt.inverse.band_images import BandImages
from mitsuba_fspt.optics.boundary import robin_a
from mitsuba_fspt.optics.media import Medium
from mitsuba_fspt.optics.shapes import Cylinder
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.diffusion import Tissue
from mitsuba_fspt.tissue.tetrahedra import Tetrahedra

pytest.importorskip("skfem")
MEDIA = Medium(0.1, 1.0, 1.37), Medium(0.03, 0.6, 1.5)  # below and above z = 0
FACE, AT, ACROSS = 6.0, (0.4, 0.2), np.array([0.0, 2.0, 4.0])


@pytest.fixture(scope="module")
def layers():
    """J_n at points of both faces of a disc of two layers."""
    mesh = cylinder_tetrahedra(12, 2 * FACE, 2)
    region = mesh.inside(Cylinder((0.0, 0.0, 3.0), 6, 30))
    tissue = Tissue(Tetrahedra(mesh.vertices, mesh.cells, region, mesh.snap), MEDIA, model="diffusion", repeated=True)
    faces = [np.column_stack([AT[0] + ACROSS, np.full(3, AT[1]), np.full(3, z)]) for z in (-FACE, FACE)]
    return BandImages(None, None, SimpleNamespace(vertices=np.concatenate(faces)), None, tissue, 1.0, None, None)


def exact(z):
    """(6,) J_n of a point source of 1 W at the height z [1/mm²], at the points of `layers`."""
    below, way = (MEDIA, 1) if z < 0 else (MEDIA[::-1], -1)  # the closed form has the source in the first layer
    coefficients = [[getattr(one, key) for one in below] for key in ("mua", "musp")]
    factors = [robin_a(one.n) for one in below]
    both = [
        layers_fluence((-FACE, 0, FACE), *coefficients, factors, way * z, ACROSS, face) / (2 * a)
        for face, a in zip((-FACE, FACE), factors, strict=True)
    ]
    return np.concatenate(both[::way])


@pytest.mark.parametrize("side", [-1, 1])
def test_sources_close_to_an_inner_border(layers, side):
    """A source 0.002 and 0.05 edges below or above the border of two layers: J_n, and the first one's slope.

    Expected: J_n over the closed form differs by 0.4 % between the two, 0.2 % as measured by errors of this mesh; the
    slope along z is within 4 % of the largest one, that of the source's side of the kink (on the other side it is
    57 %). Seen to fail with 64 equal parts of the cells at the source (1.7 %) and with steps across the border.
    """
    edge = layers.tissue.mesh.edge
    step, close = 0.01 * edge, 0.002 * edge * side
    ratios = [layers.exitance(np.array([*AT, z])) / exact(z) for z in (25 * close, close)]
    np.testing.assert_allclose(*ratios, rtol=4e-3)
    slope = layers.gradient(np.array([*AT, close]), 0.0, step)[:, 2] / exact(close)
    near, far = (exact(close + side * length * step) for length in (0.01, 0.02))
    expected = side * (4 * near - far - 3 * exact(close)) / (0.02 * step) / exact(close)
    np.testing.assert_allclose(slope, expected, rtol=0, atol=0.04 * np.abs(expected).max())


def test_steps_stay_in_the_medium_of_the_source(layers):
    """Shorter or backward steps where the usual one ends in another medium, or outside the tissue."""
    cases = {(0.0, 0.0, 1.0): (1, 1, 1), (0.0, 0.0, -0.05): (1, 1, -1), (0.0, 0.0, FACE - 0.05): (1, 1, -1)}
    for at, ways in cases.items():
        np.testing.assert_allclose(layers._steps(np.array(at), 0.1), 0.1 * np.array(ways))
