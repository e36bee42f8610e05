"""What transport matrices and inversions show in a notebook."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image as Picture
from sphere_views import RADIUS, sphere_views

import mitsuba_fspt as fspt
from mitsuba_fspt.images import picture
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.runtime.errors import BackendError


@pytest.fixture(scope="module")
def matrix(mono):
    return sphere_views()


@pytest.fixture(scope="module")
def inversion(matrix):
    truth = 1e-3 * (1 + 0.5 * Surface.of(matrix).vertices[:, 2] / RADIUS)
    power = matrix.forward(truth)
    return fspt.invert(matrix, power, error=np.full_like(power, 0.01 * power.max()), samples=20, seed=1)


def colours(png):
    with Picture.open(io.BytesIO(png)) as shown:
        return len(shown.convert("RGB").getcolors(1 << 24))


def test_a_matrix_shows_its_numbers_and_its_sensitivity(matrix):
    html = matrix._repr_html_()
    views, height, width = matrix.image_shape
    assert f"{views} of {width} × {height} pixels" in html
    seen = matrix.areas[matrix.sensitivity > 0].sum() / matrix.areas.sum()
    assert f"{seen:.1%}" in html
    assert '<img alt="TransportMatrix"' in html
    assert colours(matrix._repr_png_()) > 100


def test_an_inversion_shows_its_total_with_its_interval(inversion):
    html = inversion._repr_html_()
    low, high = inversion.total_interval
    assert f"{inversion.total:.6g} W (90% interval {low:.6g} to {high:.6g} W)" in html
    assert '<img alt="Inversion"' in html
    assert colours(inversion._repr_png_()) > 100


def test_without_matplotlib_the_numbers_are_left(matrix, inversion, monkeypatch):
    def missing():
        raise BackendError("picture: matplotlib is not installed.")

    monkeypatch.setattr(picture, "require_matplotlib", missing)
    for shown in (matrix, inversion):
        assert shown._repr_png_() is None
        assert "<img" not in shown._repr_html_()
        assert "surface seen" in shown._repr_html_()
