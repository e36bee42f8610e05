"""Solutions for slightly other media and sources, from one solution: against a closed form and whole solutions."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from closed_forms import ball_exitance

from mitsuba_fspt.optics.boundary import robin_a
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.runtime.errors import FluxError
from mitsuba_fspt.runtime.interrupt import in_threads
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.diffusion import Tissue
from mitsuba_fspt.tissue.elements import Elements
from mitsuba_fspt.tissue.tetrahedra import Tetrahedra

skfem = pytest.importorskip("skfem")
STEP = 1e-4  # relative change of a coefficient
MEDIA = Medium(0.05, 1.0, 1.37, 0.6), Medium(0.1, 1.4, 1.45)
SOURCE = Source(Sphere((1.0, 0.5, 0.0)))


def slopes(tissue, source, points, others):
    """(V, P) change of J_n over `STEP`, from one solution for the source."""
    present, places = tissue.solve([source]), tissue.places(points)
    near = tissue.near(present, others)
    base = present.exitance_at(points, places)
    return np.column_stack([one.exitance_at(points, places) - base for one in near]) / STEP


def test_slopes_of_a_sphere_in_closed_form():
    """J_n of a point 2 mm off the middle of a sphere of 6 mm: slopes with ln µa, ln µs', ln n and mm.

    Central differences of the series. Expected: the 0.2 % of this mesh for the coefficients, of the largest slope each.
    Seen to fail with the change of the matrix, or of the sources' field, left out.
    """
    grid, offset = skfem.MeshTet1.init_ball(3), 2.0
    mesh = Tetrahedra(6 * grid.p.T, grid.t.T, snap=lambda p: 6 * p / np.linalg.norm(p, axis=1, keepdims=True))
    medium = Medium(0.05, 1.0, 1.37)

    def tissue(**changed):
        return Tissue(mesh, [replace(medium, **changed)], model="diffusion", elements=elements)

    elements = Elements(mesh, 2)
    cosine = np.linspace(-1, 1, 21)
    points = 6 * np.column_stack([cosine, np.sqrt(1 - cosine**2), 0 * cosine])
    at = Source(Sphere((offset, 0.0, 0.0)))
    others = [(tissue(**{key: (1 + STEP) * getattr(medium, key)}), [at]) for key in ("mua", "musp", "n")]
    found = slopes(tissue(), at, points, [*others, (tissue(), [Source(Sphere((offset + STEP, 0.0, 0.0)))])])

    def exact(mua=0.05, musp=1.0, n=1.37, x=offset):
        return ball_exitance(6.0, x, mua, musp, robin_a(n), cosine)

    def central(key, value, step):
        return (exact(**{key: value + step}) - exact(**{key: value - step})) / (2 * STEP)

    expected = [central(key, getattr(medium, key), STEP * getattr(medium, key)) for key in ("mua", "musp", "n")]
    for one, other in zip(found.T, [*expected, central("x", offset, STEP)], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-3 * np.abs(other).max())


@pytest.mark.parametrize(
    ("model", "cases"),
    [
        ("diffusion", [(k, key) for k in (0, 1) for key in ("mua", "musp", "n")]),
        ("sp3", [(0, "mua"), (1, "musp"), (0, "n")]),
    ],
)
def test_slopes_are_those_of_whole_solutions(model, cases):
    """Two regions of tissue, the source in one: central differences of solutions with ten times the step.

    Expected: within 0.2 % of the largest slope, of first and second order in the steps.
    """
    mesh = cylinder_tetrahedra(5, 8, 4.0)
    region = (mesh.vertices[mesh.cells].mean(axis=1)[:, 2] > 1).astype(int)
    mesh = replace(mesh, region=region)
    tissue = Tissue(mesh, MEDIA, model=model, repeated=True)
    angle = np.linspace(0, 2 * np.pi, 9)
    points = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), np.linspace(-3.5, 3.5, 9)])

    def changed(k, key, share):
        media = list(MEDIA)
        media[k] = replace(media[k], **{key: (1 + share) * getattr(media[k], key)})
        return tissue.of_media(media)

    found = slopes(tissue, SOURCE, points, [(changed(*case, STEP), [SOURCE]) for case in cases])
    places = tissue.places(points)
    for one, case in zip(found.T, cases, strict=True):
        up, down = (changed(*case, s * STEP).solve([SOURCE]).exitance_at(points, places) for s in (10, -10))
        other = (up - down) / (20 * STEP)
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-3 * np.abs(other).max())


def test_solutions_in_a_thread_end_where_another_fails():
    """Iterations ask whether they have to end: of 400 solutions, some seconds, few are left. Seen to fail without."""
    tissue = Tissue(cylinder_tetrahedra(5, 8, 2.0), MEDIA[:1], model="diffusion")
    begun, count = threading.Event(), 0

    def work(fails):
        nonlocal count
        if fails:
            begun.wait(10)
            raise FluxError("solve: no.")
        for _ in range(400):
            begun.set()
            tissue.solve([SOURCE])
            count += 1

    with pytest.raises(FluxError):
        in_threads(work, [False, True])
    assert count < 50
