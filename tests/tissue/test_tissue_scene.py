"""The phantom as tissue: what the file says of itself is so, and Monte Carlo from source to CCD meets diffusion."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.tissue.phantom_file import PhantomFile

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SCENE = SCENES / "nylon_cylinder_tissue.xml"
DEFAULTS = {node.get("name"): node.get("value") for node in ET.parse(SCENE).getroot().iter("default")}
REFERENCE = 7.51e-4  # W of 1 W
SMALL = {"width": 16, "height": 16, "pixel_pitch": 1.728, "f_number": 2.8}


def default(name):
    return float(DEFAULTS[name])


def test_optics_and_source_are_those_of_the_solved_phantom():
    """Same µa, µs', n and place; 1 W; and the source spreads its first collisions as the solved rod of light does."""
    told = PhantomFile.read(SCENES / "nylon_cylinder.toml")
    medium, (source,) = told.medium, told.sources
    assert default("sigma_t") == pytest.approx(medium.mua + medium.musp, rel=1e-6)
    assert default("sigma_t") * default("albedo") == pytest.approx(medium.musp, rel=1e-6)
    assert default("int_ior") == medium.n
    assert (default("source_x"), 0, default("source_z")) == tuple(source.shape.centre)
    radius = default("source_radius")
    assert math.pi * default("source_radiance") * 4 * math.pi * radius**2 == pytest.approx(source.power, rel=1e-5)
    rod = source.shape.radius**2 / 2 + source.shape.length**2 / 12
    assert radius**2 + 4 / 3 * radius / default("sigma_t") == pytest.approx(rod, rel=0.01)


def test_camera_is_that_of_the_other_cylinder():
    other = {n.get("name"): n.get("value") for n in ET.parse(SCENES / "nylon_cylinder.xml").getroot().iter("default")}
    camera = ("f_number", "view", "focal_length", "magnification", "distance", "width", "height", "pixel_pitch")
    assert [DEFAULTS[name] for name in camera] == [other[name] for name in camera]


def test_total_power_and_its_error():
    """7.51e-4 W of 1 W (± 0.05e-4, 17 million paths) from the front at f/2.8; without 1/n² or 1/π it fails by far.

    Coverage is that of the silhouette, the tissue's and not the source's.
    """
    image = fspt.render(fspt.load(SCENE, **SMALL), spp=512, seed=2)
    total, error = image.power.sum(), math.sqrt((image.error**2).sum())
    assert 0 < error < 0.12 * total
    assert abs(total - REFERENCE) < 4 * error
    assert image.metadata["method"] == "volpath"
    half_width = 15 / math.sqrt(180**2 - 15**2) * 165 / (2 * 1.728)  # of the outline on the plane z = u, in pixels
    assert image.coverage[8].sum() == pytest.approx(2 * half_width, abs=1)
    assert np.all(image.power[image.coverage == 0] == 0)
