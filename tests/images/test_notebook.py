"""What images and comparisons show in a notebook, and the axes that `plot` and `plot_profile` return."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from PIL import Image as Picture

import mitsuba_fspt as fspt
from mitsuba_fspt.images import picture
from mitsuba_fspt.runtime.errors import BackendError, ImageError


@pytest.fixture
def image():
    """A spot at row 4, column 6, of 1 nW."""
    y, x = np.mgrid[0:9, 0:12]
    power = 1e-9 * np.exp(-((x - 6.0) ** 2 + (y - 4.0) ** 2) / 8)
    metadata = {"scene": "<b>s.xml view=90", "method": "integral", "f_number": 2.8, "pixel_pitch": 0.2}
    return fspt.Image(power, 0.1 * power, np.clip(1e9 * power, 0, 1), metadata | {"magnification": 0.5})


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    pyplot.close("all")


def test_an_image_shows_its_numbers_and_picture(image):
    html = image._repr_html_()
    assert f"{image.power.sum():.6g} W" in html
    assert "1e-09 W" in html
    assert "12 × 9" in html
    assert "&lt;b&gt;s.xml" in html  # no markup out of a file's name
    assert re.search(r'<img alt="Image" src="data:image/png;base64,[A-Za-z0-9+/=]+">', html)
    with Picture.open(io.BytesIO(image._repr_png_())) as shown:
        assert min(shown.size) > 200
        assert len(shown.convert("RGB").getcolors(1 << 24)) > 100


def test_a_comparison_shows_its_numbers_and_profiles(image):
    other = fspt.Image(1.1 * image.power, metadata=image.metadata)
    found = fspt.compare(other, image)
    html = found._repr_html_()
    for line in found.render_text().splitlines():
        assert line.split()[1] in html
    with Picture.open(io.BytesIO(found._repr_png_())) as shown:
        assert shown.size[0] > shown.size[1]


def test_without_matplotlib_the_numbers_are_left(image, monkeypatch):
    def missing():
        raise BackendError("picture: matplotlib is not installed.")

    monkeypatch.setattr(picture, "require_matplotlib", missing)
    assert image._repr_png_() is None
    assert "<img" not in image._repr_html_()
    assert "total power" in image._repr_html_()
    with pytest.raises(BackendError, match="matplotlib is not installed"):
        image.plot()


def test_plot_returns_axes_in_mm_with_the_scale_of_the_picture(image):
    axes = image.plot()
    (shown,) = axes.get_images()
    assert shown.get_extent() == pytest.approx([-2.4, 2.4, -1.8, 1.8])
    assert axes.get_xlabel() == "mm on the virtual detector plane"
    assert "view 90°" in axes.get_title()
    assert [child.get_ylabel() for child in axes.child_axes] == ["power [$10^{-9}$ W/pixel]"]
    assert shown.norm.vmax == pytest.approx(1)
    own = Figure().subplots()
    assert image.plot(own, log=True, limits=(1e-12, 1e-9), outline=True) is own
    assert own.get_images()[0].norm.vmin == pytest.approx(1e-12)
    with pytest.raises(ImageError, match="the range must be A < B"):
        image.plot(limits=(2, 1))


def test_a_profile_goes_through_the_brightest_pixel(image):
    axes = image.plot_profile()
    x, y = axes.get_lines()[0].get_data()
    np.testing.assert_allclose(x, 0.4 * (np.arange(12) - 5.5), rtol=1e-12)
    np.testing.assert_allclose(y, image.power[4] / 1e-9, rtol=1e-12)
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(1.1)
    assert axes.get_title().startswith("row 4")
    own = Figure().subplots()
    assert image.plot_profile(column=2, axes=own) is own
    x, y = own.get_lines()[0].get_data()
    np.testing.assert_allclose(y, image.power[:, 2] / 10.0 ** (3 * np.floor(np.log10(image.power[:, 2].max()) / 3)))
    assert x[0] > x[-1]  # the top row has the largest y


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ({"row": 9}, r"row 9 does not exist\. Give one in 0 … 8"),
        ({"column": -1}, r"column -1 does not exist\. Give one in 0 … 11"),
        ({"row": 1, "column": 1}, "row 1 and column 1 exclude each other"),
        ({"row": 1.5}, "must be a whole number"),
    ],
)
def test_profiles_that_are_not_there(image, line, message):
    with pytest.raises(ImageError, match=message):
        image.plot_profile(**line)
