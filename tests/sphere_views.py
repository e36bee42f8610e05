"""A sphere in four views for the tests of inversion: its scene file, its transport matrix, noisy images."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import trimesh

import mitsuba_fspt as fspt

RADIUS = 6.0
VIEWS = [0, 90, 180, 270]
SCENE = """<scene version="3.0.0">
    <default name="view" value="0"/>
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        <float name="focal_length" value="55"/><float name="f_number" value="2.8"/>
        <float name="magnification" value="0.5"/><float name="pixel_pitch" value="0.5"/>
        <transform name="to_world"><lookat origin="165, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
            <string name="pixel_format" value="luminance"/></film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="sphere.ply"/><boolean name="face_normals" value="true"/>
        <transform name="to_world"><rotate z="1" angle="$view"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1e-3"/></emitter>
    </shape>
</scene>"""


FOLDER = tempfile.TemporaryDirectory(prefix="fspt-sphere-views-")  # of the scenes that the matrices name


def write_sphere(folder, subdivisions=2):
    """Name of the scene `sphere.xml`, written into the folder with its mesh, 162 vertices by default."""
    trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS).export(folder / "sphere.ply")
    (folder / "sphere.xml").write_text(SCENE)
    return folder / "sphere.xml"


def sphere_views(subdivisions=2, **options):
    """Transport matrix of the sphere, 162 vertices by default; made once in a process, no test changes it."""
    return _made(subdivisions, **options)


@cache
def _made(subdivisions, **options):
    folder = Path(FOLDER.name, str(_made.cache_info().misses))
    folder.mkdir()
    return fspt.transport(write_sphere(folder, subdivisions), view=VIEWS, **{"rtol": 1e-3} | options)


def noisy(matrix, exitance, electrons, seed, read_noise=3.5, **metadata):
    """Images with `electrons` on the brightest pixel, Poisson and read noise."""
    power, rng = matrix.forward(exitance), np.random.default_rng(seed)
    per_watt = electrons / power.max()
    counted = rng.poisson(power * per_watt) + read_noise * rng.standard_normal(power.shape)
    metadata = {"electrons_per_watt": per_watt, "read_noise": read_noise} | metadata
    return [fspt.Image(plane / per_watt, metadata=metadata) for plane in counted]


def warn_of_nothing(monkeypatch):
    """`invert` looks for no reason to warn of a fit, which takes two fifths of its time, where many fits are made."""
    monkeypatch.setattr("mitsuba_fspt.inverse.invert.fit_warnings", lambda *_: ([], 0.0))


def passes_of(true, events, rng, passes=16):
    """Mean and standard error of passes in which light arrives in `events` of random weight on the brightest pixel."""
    weight = true.max() / events
    met = rng.poisson(true / weight / passes, (passes, *true.shape))
    each = weight * passes * rng.gamma(np.maximum(met, 1e-300), 1.0)
    return each.mean(axis=0), each.std(axis=0, ddof=1) / passes**0.5
