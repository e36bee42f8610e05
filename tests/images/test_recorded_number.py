"""Numbers of the metadata, which any program may have written: a wrong one is an error of one line with its name."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.detector.stray_light import Kernel
from mitsuba_fspt.images.exposure import exposure_of
from mitsuba_fspt.images.pixel_axes import PixelAxes
from mitsuba_fspt.images.pixel_map import recorded
from mitsuba_fspt.images.radiometry import etendue_of
from mitsuba_fspt.images.vignetting_file import read_vignetting
from mitsuba_fspt.inverse import calibrate
from mitsuba_fspt.runtime.errors import FsptError

LENS = {"focal_length": 55.0, "f_number": 2.8, "focus_distance": 165.0, "pixel_pitch": 0.5, "transmittance": 0.9}
EXPOSED = {"gain": 1.6, "bias": 500.0, "bits": 16}
SLOPE = 1 + np.arange(16.0).reshape(4, 4)
ONES = np.ones((4, 4), np.float32)
CCD = fspt.Detector(0.9, 0.0, 3.0, 1e5, 1.6, 500, 16)


def image(**metadata):
    return fspt.Image(ONES, metadata=metadata)


@pytest.mark.parametrize("wrong", ["abc", [1.0], float("nan")])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("gain", lambda m: recorded(EXPOSED | m, "gain", (4, 4))),
        ("bits", lambda m: exposure_of("e.npz", {"electrons": ONES}, EXPOSED | m)),
        ("transmittance", lambda m: etendue_of((4, 4), LENS | m)),
        (
            "passes",
            lambda m: fspt.compare(fspt.Image(SLOPE, SLOPE, metadata={"method": "path"} | m), fspt.Image(SLOPE)),
        ),
    ],
)
def test_a_number_that_is_none_is_refused_by_name(name, read, wrong):
    """Seen to fail: bare ValueError and TypeError of float()."""
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


@pytest.mark.parametrize("wrong", ["abc", -0.5])
def test_a_kernel_of_a_wrong_pitch_is_refused(wrong, tmp_path):
    np.savez(tmp_path / "psf.npz", power=ONES, metadata=json.dumps({"pixel_pitch": wrong}))
    with pytest.raises(FsptError, match=r"'psf' = .*'pixel_pitch' of the metadata must be"):
        Kernel.read(tmp_path / "psf.npz")
