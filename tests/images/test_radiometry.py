"""Units of images: the radiance of a focused Lambertian disk is J_n/π, whatever the lens; photons from watts."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from small_scenes import HEIGHT, WIDTH, camera_scene, disk

import mitsuba_fspt as fspt
from mitsuba_fspt.images.formats import read_planes
from mitsuba_fspt.images.picture import draw_panels
from mitsuba_fspt.images.radiometry import RADIANCE, etendue, in_unit
from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.runtime.errors import BackendError, DetectorError, ImageError

pytestmark = pytest.mark.usefixtures("mono")
PER_JOULE = 660e-9 / (6.62607015e-34 * 299792458.0)  # photons of 660 nm
LENSES = {
    "plain": {},
    "wide open": {"f_number": 0.7},
    "filter": {"transmittance": 0.37},
    "vignetting": {"f_number": 4.0, "lens_diameter": 18.0, "diaphragm_distance": 15.0},
    "hrrt": {"model": "hrrt", "lens_diameter": 24.0},
    "pinhole": {"model": "pinhole", "f_number": 8.0},
    "cone": {"model": "ripoll", "numerical_aperture": 0.03},
    "crop": {"crop": (1, 3, 20, 12)},
    "compound": {"pupil_magnification": 0.8},
    "wide field": {"pixel_pitch": 2.0},
}


@pytest.mark.parametrize("settings", LENSES.values(), ids=LENSES)
def test_a_focused_lambert_disk_has_the_radiance_of_its_exitance(settings):
    """L = J_n/π on every pixel. Seen to fail with cos⁴θ = 1, with τ and with the crop's offset left out."""
    scene = camera_scene(disk(165, 400.0), exitance=2.0, **settings)
    image = fspt.render(scene, method="integral", rtol=1e-4)
    radiance = image.to_radiance(wavelength_nm=660)
    assert radiance.attrs["units"] == "photons/s/cm²/sr"
    assert image.coverage.min() > 0
    expected = 2.0 / math.pi * 100 * PER_JOULE  # W/mm² to photons/s/cm²
    np.testing.assert_allclose(radiance.values, expected, rtol=2e-4)
    assert float(radiance.error.max()) == pytest.approx(0, abs=1e-3 * expected)


def test_a_stop_leaves_no_light_and_no_radiance_outside():
    image = fspt.render(camera_scene(disk(165), exitance=2.0, image_stop_diameter=8.0), method="integral", rtol=1e-4)
    radiance = in_unit(image, "p/s/cm2/sr", Light.given(660)).values
    assert radiance[0, 0] == 0
    assert radiance[HEIGHT // 2, WIDTH // 2] == pytest.approx(200 / math.pi * PER_JOULE, rel=1e-4)


CUT = {
    "stop": {"image_stop_diameter": 8.0},
    "vignetting": {"f_number": 4.0, "lens_diameter": 18.0, "diaphragm_distance": 40.0, "pixel_pitch": 1.2},
}


@pytest.mark.parametrize("settings", CUT.values(), ids=CUT)
def test_pixels_cut_by_a_border_have_the_radiance_of_the_others_at_their_centres(settings):
    """With `pixel` = centre, L = J_n/π wherever light arrives, and no pixel without light has an étendue.

    Seen to fail with the étendue of the pixel's area: up to 1.69 times J_n/π at the stop, 1.5 by vignetting, and
    pixels with an étendue but no light.
    """
    scene = camera_scene(disk(165, 400.0), exitance=2.0, **settings)
    image = fspt.render(scene, method="integral", rtol=1e-4, pixel="centre")
    own = etendue(image)
    lit = image.power > 1e-3 * image.power.max()
    assert 0 < np.count_nonzero(lit) < lit.size
    np.testing.assert_allclose(image.power[lit] / own[lit], 2.0 / math.pi, rtol=5e-4)
    np.testing.assert_array_equal(own > 0, image.power > 0)


def test_photons_and_watts():
    image = fspt.Image([[1e-9, 0.0]], [[1e-12, 0.0]], metadata={"f_number": 8.0})
    photons = in_unit(image, "photons/s", Light.given(660))
    assert photons.values[0, 0] == pytest.approx(1e-9 * PER_JOULE, rel=1e-12)
    assert photons.error[0, 0] == pytest.approx(1e-12 * PER_JOULE, rel=1e-12)
    assert (photons.quantity, photons.unit) == ("photon_rate", "photons/s")
    np.testing.assert_array_equal(in_unit(image, "W").values, image.power)


@pytest.mark.parametrize(
    ("unit", "label"),
    [("photons/s", "photon rate [$10^{15}$ photons/s/pixel]"), ("p/s/cm2/sr", f"radiance [$10^{{18}}$ {RADIANCE}]")],
)
def test_a_picture_in_photons_shows_their_numbers_beside_its_colours(unit, label):
    image = fspt.render(camera_scene(disk(165, 400.0), exitance=2.0), method="integral")
    figure = draw_panels([image], unit=unit, light=Light.given(660))
    (axes,) = figure.axes
    (bar,) = axes.child_axes
    values = in_unit(image, unit, Light.given(660)).values
    factor = 10.0 ** int(re.search(r"\{(\d+)\}", label)[1])
    np.testing.assert_allclose(axes.get_images()[0].get_array(), values / factor)
    assert bar.get_ylabel() == label
    assert axes.get_images()[0].norm.vmax == pytest.approx(values.max() / factor)


@pytest.mark.parametrize("suffix", [".exr", ".fits", ".h5", ".npz", ".tif"])
def test_files_in_another_unit(tmp_path, suffix):
    """They state it, and `read` does not take them for watts."""
    image = fspt.render(camera_scene(disk(165)), method="integral", rtol=1e-2)
    in_unit(image, "p/s/cm2/sr", Light.given(660)).write(tmp_path / f"a{suffix}", image)
    planes, metadata = read_planes(tmp_path / f"a{suffix}")
    assert (metadata["quantity"], metadata["unit"], metadata["wavelength_nm"]) == ("radiance", RADIANCE, 660)
    assert set(planes) == {"radiance", "error", "coverage"}
    np.testing.assert_allclose(planes["radiance"], image.to_radiance(660).values, rtol=1e-6)
    with pytest.raises(ImageError, match="the values are radiance in photons/s/cm²/sr, not power in W"):
        fspt.read(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("unit", "wavelength", "message"),
    [
        ("lux", None, "'unit' must be one of W, photons/s, p/s/cm2/sr, got 'lux'"),
        ("W", 660, "'wavelength_nm' = 660 has no meaning for watts"),
        ("photons/s", None, "photons need a wavelength, the image has none"),
        ("photons/s", -1, "'wavelength_nm' must be in 200 … 2500 nm, got -1"),
        ("photons/s", "red", "'wavelength_nm' must be a number, got 'red'"),
        ("p/s/cm2/sr", 660, "its metadata have no 'focal_length', so that the étendue"),
    ],
)
def test_units_that_cannot_be(unit, wavelength, message):
    with pytest.raises(ImageError, match=message):
        in_unit(fspt.Image([[1.0]]), unit, Light.given(wavelength))


def test_metadata_of_no_lens():
    known = {"focal_length": 55.0, "f_number": -1.0, "focus_distance": 165.0, "pixel_pitch": 0.1}
    with pytest.raises(ImageError, match="its metadata describe no lens: 'f_number' must be > 0"):
        etendue(fspt.Image([[1.0]], metadata=known))


def test_numbers_of_the_metadata_that_are_none_are_told_once():
    """Seen to fail: "image: its metadata describe no lens: image: 'focal_length' …"."""
    known = {"focal_length": "abc", "f_number": 8, "focus_distance": 165, "pixel_pitch": 0.4}
    with pytest.raises(ImageError, match=r"^image: 'focal_length' of the metadata must be a finite number, got 'abc'"):
        etendue(fspt.Image(np.ones((4, 4)), metadata=known))


def test_the_wavelength_of_a_filter_is_that_of_the_image():
    """Another one would use the transmittance of the first: a wrong number without a word."""
    image = fspt.Image([[1e-12]], metadata={"wavelength_nm": 600.0, "pixel_pitch": 0.0135})
    assert in_unit(image, "photons/s").light.wavelength_nm == 600
    assert in_unit(image, "photons/s", Light.given(600)).light.wavelength_nm == 600
    with pytest.raises(ImageError, match="'wavelength_nm' = 660, but the image was rendered for 600 nm"):
        in_unit(image, "photons/s", Light.given(660))
    camera = fspt.Detector.typical_ccd()
    camera.expose(image, 1.0, 600)
    with pytest.raises((ImageError, DetectorError), match="rendered for 600 nm"):
        camera.expose(image, 1.0, 660)


def test_xarray_has_units_and_mm():
    """x to the right and y up, mm on the virtual detector plane; labels find the pixel that the disk lights."""
    scene = camera_scene(disk(165, 3.0, x=-8.0, y=5.0))  # the camera's +x is to the left of the image
    image = fspt.render(scene, method="integral", rtol=1e-2)
    data = image.to_xarray()
    assert data.power.dims == ("y", "x")
    assert {name: data[name].attrs["units"] for name in data.data_vars} == {"power": "W", "error": "W", "coverage": "1"}
    assert {data[name].attrs["units"] for name in ("x", "y")} == {"mm"}
    np.testing.assert_array_equal(data.power, image.power)
    assert data.power.idxmax("x").max() > 5
    at = data.power.sel(x=8, y=5, method="nearest")
    assert float(at) > 0.9 * image.power.max()
    assert float(data.power.sel(x=-8, y=-5, method="nearest")) == 0
    assert data.attrs["f_number"] == 2.8
    assert float(data.y[0]) > float(data.y[-1])
    bare = fspt.Image([[1.0, 2.0]]).to_xarray()
    assert (set(bare.data_vars), bare.x.attrs["units"]) == ({"power"}, "pixel")


@pytest.mark.parametrize("method", ["to_xarray", "to_radiance"])
def test_without_xarray_the_extra_is_named(method, monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr("mitsuba_fspt.runtime.extras.import_module", missing)
    with pytest.raises(BackendError, match=r"needs xarray, .* pip install 'mitsuba-fspt\[notebook\]'"):
        getattr(fspt.Image([[1.0]]), method)()
