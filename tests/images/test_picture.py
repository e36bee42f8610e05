"""Pictures: the numbers at their colour bars and axes, which way up they are, and what cannot be written."""

import os
import subprocess
import sys
from contextlib import nullcontext

import numpy as np
import pytest
from PIL import Image as Picture

from mitsuba_fspt.images import picture
from mitsuba_fspt.images.image import Image
from mitsuba_fspt.images.picture import caption, write_comparison_png, write_png
from mitsuba_fspt.runtime.errors import BackendError, ImageError

LENS = {
    "method": "integral",
    "focal_length": 55.0,
    "f_number": 2.8,
    "magnification": 0.5,
    "pixel_pitch": 0.108,
}


def spot(height: int = 8, width: int = 12, power: float = 2.5e-10, **metadata) -> Image:
    """One bright pixel, in the top left corner; errors of a tenth of it."""
    values = np.zeros((height, width))
    values[0, 0] = power
    return Image(values, np.full_like(values, power / 10), metadata=metadata)


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """The figures that would have been saved, here."""
    monkeypatch.chdir(tmp_path)
    figures = []
    monkeypatch.setattr(picture, "figure_file", lambda figure, path: nullcontext(figures.append(figure)))
    return figures


def test_colour_bar_and_scale(drawn):
    """250e-12 W are 250 on a bar of 10^-12 W/pixel; at t = 1/2, 12 pixels of 0.108 mm see 2.592 mm.

    Seen to fail without the division by the magnification and without that by the unit's factor.
    """
    write_png(spot(**LENS), "a.png")
    (figure,) = drawn
    (axes,) = figure.axes
    (bar,) = axes.child_axes
    (shown,) = axes.get_images()
    assert shown.get_array()[0, 0] == pytest.approx(250)
    assert shown.get_clim() == pytest.approx((0, 250))
    assert bar.get_ylabel() == "power [$10^{-12}$ W/pixel]"
    assert shown.get_extent() == pytest.approx((-1.296, 1.296, -0.864, 0.864))
    assert axes.get_xlabel() == axes.get_ylabel() == "mm on the sharp plane"
    assert axes.get_title() == "integral,  F = 55 mm,  f/2.8,  magnification 0.5"


def test_axes_say_what_they_know(drawn):
    write_png(spot(pixel_pitch=0.1), "a.png")
    write_png(spot(), "a.png")
    detector, pixels = (figure.axes[0] for figure in drawn)
    assert detector.get_xlabel() == "mm on the detector"
    assert detector.get_xlim() == pytest.approx((-0.6, 0.6))
    assert pixels.get_xlabel() == "pixel"
    assert pixels.get_ylim() == (7.5, -0.5)  # row 0 at the top


def test_comparison(drawn):
    """One scale for both images, a symmetric one for the difference, a profile through the peak."""
    calculated, standard = spot(power=1e-9, **LENS), spot(power=3e-9, **LENS)
    write_comparison_png(calculated, standard, "a.png")
    (figure,) = drawn
    first, second, difference, profile = figure.axes
    assert first.get_images()[0].get_clim() == second.get_images()[0].get_clim() == pytest.approx((0, 3))
    assert difference.get_images()[0].get_clim() == pytest.approx((-2, 2))
    assert difference.get_images()[0].get_array()[0, 0] == pytest.approx(-2)
    curves = {line.get_label(): line for line in profile.get_lines()}
    assert curves["calculated"].get_ydata()[0] == pytest.approx(1)
    assert curves["standard"].get_ydata()[0] == pytest.approx(3)
    assert curves["standard"].get_xdata()[[0, -1]] == pytest.approx([-1.188, 1.188])  # centres of the outer pixels
    assert figure.get_suptitle().startswith("ME 0,  CF 1,  ratio of powers 0.33333")


def test_upright(tmp_path):
    """The brightest spot of the file itself lies in its upper left quarter."""
    write_png(spot(power=1.0), tmp_path / "a.png")
    with Picture.open(tmp_path / "a.png") as shown:
        pixels = np.asarray(shown.convert("RGB")).astype(float)
    yellow = (pixels[..., 0] > 240) & (pixels[..., 1] > 240) & (pixels[..., 2] < 200)  # the top of the colour map
    height, width = yellow.shape
    rows, columns = np.nonzero(yellow[:, : width * 3 // 4])  # without the colour bar
    assert rows.size > 100
    assert rows.max() < height / 2
    assert columns.max() < width / 2


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (40, 3)])
@pytest.mark.parametrize("power", [0.0, 1e-300, 1e300])
def test_any_image_can_be_shown(tmp_path, shape, power):
    write_png(spot(*shape, power=power), tmp_path / "a.png")
    with Picture.open(tmp_path / "a.png") as shown:
        assert min(shown.size) > 100


def test_comparison_file(tmp_path):
    write_comparison_png(spot(), spot(power=2e-10), tmp_path / "a.png")
    with Picture.open(tmp_path / "a.png") as shown:
        assert min(shown.size) > 400


def test_caption_of_an_unknown_image():
    assert caption(spot()) == ""
    assert caption(spot(f_number=8)) == "f/8"


def test_pictures_that_cannot_be_written(tmp_path, monkeypatch):
    with pytest.raises(ImageError, match=r"Give a name that ends in \.png"):
        write_png(spot(), tmp_path / "a.jpg")
    with pytest.raises(ImageError, match="Create it first"):
        write_png(spot(), tmp_path / "none" / "a.png")
    with pytest.raises(ImageError, match="calculated image has 12 × 8 pixels, the standard 12 × 9"):
        write_comparison_png(spot(), spot(9), tmp_path / "a.png")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for write in (write_png, lambda image, path: write_comparison_png(image, image, path)):
        with pytest.raises(BackendError, match=r"matplotlib is not installed. pip install 'mitsuba-fspt\[plot\]'"):
            write(spot(), tmp_path / "a.png")
    assert os.listdir(tmp_path) == []


def test_matplotlib_waits_until_it_is_needed():
    imports = "import sys, mitsuba_fspt.images.picture, mitsuba_fspt.images.detector;"
    found = subprocess.run(
        [sys.executable, "-c", imports + " print({'matplotlib', 'PIL'} & {*sys.modules})"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.strip() == "set()"
