"""Numbers of the metadata, which any program may have written: a wrong one is an error of one line with its name."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.stray_light import Kernel
from mitsuba_fspt.images.exposure import exposure_of
from mitsuba_fspt.images.noise_model import NoiseModel
from mitsuba_fspt.images.pixel_axes import PixelAxes
from mitsuba_fspt.images.pixel_map import recorded
from mitsuba_fspt.images.radiometry import etendue_of
from mitsuba_fspt.images.vignetting_file import read_vignetting
from mitsuba_fspt.inverse import calibrate
from mitsuba_fspt.runtime.errors import FsptError, ImageError

LENS = {"focal_length": 55.0, "f_number": 2.8, "focus_distance": 165.0, "pixel_pitch": 0.5, "transmittance": 0.9}
EXPOSED = {"gain": 1.6, "bias": 500.0, "bits": 16}
SLOPE = 1 + np.arange(16.0).reshape(4, 4)
ONES = np.ones((4, 4), np.float32)
CCD = fspt.Detector(0.9, 0.0, 3.0, 1e5, 1.6, 500, 16)


def image(**metadata):
    return fspt.Image(ONES, metadata=metadata)


@pytest.mark.parametrize("wrong", ["abc", [1.0], float("nan"), True])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("gain", lambda m: recorded(EXPOSED | m, "gain", (4, 4))),
        ("bits", lambda m: exposure_of("e.npz", {"electrons": ONES}, EXPOSED | m)),
        ("transmittance", lambda m: etendue_of((4, 4), LENS | m)),
        ("f_number", lambda m: etendue_of((4, 4), LENS | m)),
        ("electrons_per_watt", lambda m: image(**m).electrons_per_watt),
        ("crop_offset_x", lambda m: image(**m)[1:3]),
        (
            "passes",
            lambda m: fspt.compare(fspt.Image(SLOPE, SLOPE, metadata={"method": "path"} | m), fspt.Image(SLOPE)),
        ),
    ],
)
def test_a_number_that_is_none_is_refused_by_name(name, read, wrong):
    """Seen to fail: bare ValueError and TypeError of float(); True, a logical of other programs, was 1, so that an
    f-number of it gave an étendue 7.8 times too large.
    """
    with pytest.raises(FsptError, match=rf"'{name}' of the metadata must be a finite number, got"):
        read({name: wrong})


def test_a_vignetting_of_no_place_on_the_film_is_refused(tmp_path):
    """Seen to fail: the bare ValueError of float()."""
    crop = {"film_width": "abc", "film_height": 8, "crop_offset_x": 0, "crop_offset_y": 0}
    image(**crop).write(tmp_path / "v.npz")
    with pytest.raises(FsptError, match=r"'vignetting' = .*v\.npz': 'film_width' of the metadata must be"):
        read_vignetting(tmp_path / "v.npz")


@pytest.mark.parametrize("wrong", [0.0, -0.5, float("inf"), float("nan")])
@pytest.mark.parametrize(
    "read",
    [
        lambda m: PixelAxes.of((4, 4), LENS | m),
        lambda m: CCD.expose(image(**LENS | m), exposure_time=1.0, wavelength_nm=650),
        lambda m: calibrate.measured_of([image(**LENS | m)], [{}], [image(**LENS)], 1),
    ],
)
def test_a_pixel_pitch_that_no_film_has_is_refused(read, wrong):
    """Seen to fail: a pitch of -0.5 mirrored the axes of an image, 0 took them away, and both were exposed."""
    with pytest.raises(FsptError, match=r"'pixel_pitch' of the metadata must be"):
        read({"pixel_pitch": wrong})


def test_the_sign_of_a_magnification_says_nothing_about_sizes():
    """-0.5 of programs that give an inverted image a sign is 0.5; 0, of an object at infinity, is none.

    Seen to fail: the image was refused, and could be neither shown nor written.
    """
    axes = [PixelAxes.of((4, 4), LENS | {"magnification": t}) for t in (-0.5, 0.5, 0)]
    assert [one.side for one in axes] == [1.0, 1.0, 0.5]
    np.testing.assert_array_equal(axes[0].x, [-1.5, -0.5, 0.5, 1.5])
    assert [one.label for one in axes] == ["mm on the virtual detector plane"] * 2 + ["mm on the detector"]


@pytest.mark.parametrize(
    ("name", "wrong", "read"),
    [
        ("gain_error", -0.5, lambda one: one + one),
        ("gain_error", 1.0, lambda one: one.gain_error),
        ("electrons_per_watt", 0.0, lambda one: one.electrons_per_watt),
        ("read_noise", -3.5, lambda one: one.read_noise),
        ("transmittance", -0.9, lambda one: one.roi("25%", 650)),
        ("transmittance", 1.5, lambda one: one.roi("25%", 650)),
        ("prnu", -0.1, NoiseModel.of),
        ("excess_noise", float("inf"), NoiseModel.of),
    ],
)
def test_a_number_that_no_camera_has_is_refused(name, wrong, read):
    """Seen to fail: the radiance was 0 or too small by a third, and errors were infinite or without the gain's."""
    known = LENS | {"electrons_per_watt": 1e15, "read_noise": 3.5, "detector": "A"} | {name: wrong}
    with pytest.raises(ImageError, match="(?i)" + name.replace("_", ".")):
        read(image(**known))


@pytest.mark.parametrize("wrong", ["abc", -0.5])
def test_a_kernel_of_a_wrong_pitch_is_refused(wrong, tmp_path):
    np.savez(tmp_path / "psf.npz", power=ONES, metadata=json.dumps({"pixel_pitch": wrong}))
    with pytest.raises(FsptError, match=r"'psf' = .*'pixel_pitch' of the metadata must be"):
        Kernel.read(tmp_path / "psf.npz")
