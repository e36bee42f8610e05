"""A small cylinder with light sources inside, in four views, for the tests of `locate`: files, matrix, exact J_n."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import sphere_views
from cylinder_diffusion import Phantom, exitance

import mitsuba_fspt as fspt
from mitsuba_fspt.tissue.phantom_file import PhantomFile

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
edge = 1.5
[output]
edge = 0.8
"""


def cylinder_views(folder, **options):
    """Transport matrix of the cylinder; its scene `cylinder.xml` and phantom file `cylinder.toml` are in the folder."""
    (folder / "cylinder.toml").write_text(TOML)
    described = PhantomFile.read(folder / "cylinder.toml")
    replace(described, edge=2.5, order=1).solve().phantom(described.surface_edge).write(folder / "cylinder.ply")
    (folder / "cylinder.xml").write_text(sphere_views.SCENE.replace("sphere.ply", "cylinder.ply"))
    return fspt.transport(folder / "cylinder.xml", view=sphere_views.VIEWS, **{"rtol": 1e-3} | options)


def exact(vertices, sources, band=None):
    """J_n (V,) [W/mm²] of sources (x, y, z [mm], power [W]) at points of the cylinder, from a series."""
    share, mua, musp = COEFFICIENTS[band]
    total = np.zeros(len(vertices))
    for x, y, z, power in sources:
        far, angle = np.hypot(x, y), np.arctan2(y, x)
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        phantom = Phantom(RADIUS, HEIGHT, mua, musp, source_x=far, source_z=z, source_diameter=0.0)
        total += share * power * exitance(phantom, vertices @ turn.T)
    return total
