"""A small cylinder with light sources inside, in four views, for the tests of `locate`: files, matrix, exact J_n."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sphere_views
from cylinder_diffusion import Phantom, exitance

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse import locate as module
from mitsuba_fspt.tissue.elements import Elements
from mitsuba_fspt.tissue.phantom_file import PhantomFile
from mitsuba_fspt.tissue.tetrahedra import Tetrahedra

RADIUS, HEIGHT = 6.0, 8.0
COEFFICIENTS = {None: (1.0, 0.05, 1.0), "red": (0.6, 0.05, 1.0), "green": (0.3, 0.15, 1.2)}  # share, mua, musp [1/mm]
TOML = f"""[geometry]
shape = "cylinder"
radius = {RADIUS}
height = {HEIGHT}
[optical]
model = "diffusion"
mua = 0.05
musp = 1.0
[bands.red]
share = 0.6
mua = 0.05
musp = 1.0
[bands.green]
share = 0.3
mua = 0.15
musp = 1.2
[[sources]]
shape = "point"
centre = [0, 0, 0]
[mesh]
edge = 2
[output]
edge = 0.8
"""


FOLDER = tempfile.TemporaryDirectory(prefix="fspt-cylinder-views-")  # of the scene that the matrix names


def cylinder_views(folder):
    """Transport matrix of the cylinder; its scene `cylinder.xml` and phantom file `cylinder.toml` are in the folder.

    Made once in a process; no test changes it.
    """
    matrix = _made()
    shutil.copytree(FOLDER.name, folder, dirs_exist_ok=True)
    return matrix


@cache
def _made():
    folder = Path(FOLDER.name)
    (folder / "cylinder.toml").write_text(TOML)
    described = PhantomFile.read(folder / "cylinder.toml")
    replace(described, edge=2.5, order=1).solve().phantom(described.surface_edge).write(folder / "cylinder.ply")
    (folder / "cylinder.xml").write_text(sphere_views.SCENE.replace("sphere.ply", "cylinder.ply"))
    return fspt.transport(folder / "cylinder.xml", view=sphere_views.VIEWS, rtol=1e-3)


@contextmanager
def tetrahedra_made_once() -> Iterator[None]:
    """`locate` makes the tetrahedra of a cylinder and their finite elements once for each length of their edges.

    They depend on nothing else that the tests change, and are a third of the time of a fit of one source.
    """
    plain, meshes = PhantomFile.checked_mesh, dict[tuple[object, float], Tetrahedra]()
    elements = dict[tuple[float, int], Elements]()

    def mesh_of(described: PhantomFile) -> Tetrahedra:
        assert not described.regions
        key = described.geometry, described.edge
        if key not in meshes:
            meshes[key] = plain(described)
        return meshes[key]

    def elements_of(mesh: Tetrahedra, order: int) -> Elements:
        key = mesh.edge, order
        if key not in elements or not elements[key].are_of(mesh, order):
            elements[key] = Elements(mesh, order)
        return elements[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PhantomFile, "checked_mesh", mesh_of)
        patch.setattr(module, "Elements", elements_of)
        yield


def exact(vertices, sources, band=None):
    """J_n (V,) [W/mm²] of sources (x, y, z [mm], power [W]) at points of the cylinder, from a series."""
    points = np.ascontiguousarray(vertices, np.float64)
    return sum(
        (source[3] * _per_watt(points.tobytes(), *source[:3], band) for source in sources), np.zeros(len(points))
    )


@cache
def _per_watt(points, x, y, z, band):
    """J_n (V,) [1/mm²] of a source of 1 W over all bands, at points given by their bytes."""
    vertices, (share, mua, musp) = np.frombuffer(points).reshape(-1, 3), COEFFICIENTS[band]
    far, angle = np.hypot(x, y), np.arctan2(y, x)
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    phantom = Phantom(RADIUS, HEIGHT, mua, musp, source_x=far, source_z=z, source_diameter=0.0)
    return share * exitance(phantom, vertices @ turn.T)
