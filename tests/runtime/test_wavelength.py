"""A wavelength in another unit than nm is refused wherever one is taken, with a guess at the unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.optics.transmittance import Curve, transmittance_of
from mitsuba_fspt.runtime.errors import DetectorError, ImageError, OpticsError
from mitsuba_fspt.runtime.wavelength import wavelength

CCD = fspt.Detector.typical_ccd()
SCENES = Path(__file__).resolve().parents[2] / "scenes"
LENS = {"focal_length": 55.0, "f_number": 8.0, "focus_distance": 165.0, "pixel_pitch": 0.0135}
IMAGE = fspt.Image(np.full((4, 4), 1e-15), metadata=LENS)
MICROMETRES = "must be in 200 … 2500 nm, got 0.66. In µm it would be 660 nm: give that."


@pytest.mark.parametrize(
    ("value", "guess"),
    [
        (0.66, "In µm it would be 660 nm"),
        (6600, "In Å it would be 660 nm"),
        (6.6e-7, "In m it would be 660 nm"),
        (6.6e-4, "In mm it would be 660 nm"),
        (1e6, "Give nm, for example 660"),
        (0, "Give nm"),
        (-660, "Give nm"),
        (float("nan"), "Give nm"),
        (float("inf"), "Give nm"),
    ],
)
def test_the_unit_is_guessed(value, guess):
    with pytest.raises(ImageError, match=guess):
        wavelength("image: 'wavelength_nm'", value, ImageError)


@pytest.mark.parametrize("value", [200, 660, 2500, np.float32(532)])
def test_light_is_taken(value):
    assert wavelength("w", value, ImageError) == float(value)


def test_every_function_refuses_micrometres(tmp_path):
    """Seen to fail: all of them took 0.66, with photons 1000 times too few."""
    (tmp_path / "filter.csv").write_text("500,0.2\n700,0.8\n")
    curve = Curve.read(tmp_path / "filter.csv")
    counts = np.full((4, 4), 1000, np.uint16)
    old = fspt.Image(IMAGE.power, metadata=LENS | {"wavelength_nm": 0.66})
    for error, call in (
        (ImageError, lambda: IMAGE.to_radiance(0.66)),
        (ImageError, lambda: old.to_radiance()),
        (DetectorError, lambda: CCD.expose(IMAGE, 60, 0.66)),
        (DetectorError, lambda: CCD.expected(IMAGE, 60, 0.66)),
        (DetectorError, lambda: CCD.reduce(counts, exposure_time=60, wavelength_nm=0.66)),
        (OpticsError, lambda: transmittance_of({"wavelength_nm": 0.66}, curve)),
    ):
        with pytest.raises(error) as caught:
            call()
        assert "nm, got 0.66. In µm it would be 660 nm: give that." in str(caught.value)


def test_every_verb_refuses_micrometres_before_its_work(tmp_path, run):
    """Exit code 2, one line, and no file."""
    IMAGE.write(tmp_path / "i.exr")
    CCD.to_toml(tmp_path / "camera.toml")
    np.save(tmp_path / "c.npy", np.full((4, 4), 1000, np.uint16))
    out = str(tmp_path / "out.exr")
    image, counts = str(tmp_path / "i.exr"), str(tmp_path / "c.npy")
    wrong = ["--wavelength-nm", "0.66"]
    for arguments in (
        ["roi", image, *wrong],
        ["expose", image, "--exposure-time", "60", *wrong, "-o", out],
        ["reduce", counts, "--detector", str(tmp_path / "camera.toml"), "--exposure-time", "60", *wrong, "-o", out],
        ["render", str(SCENES / "nylon_cylinder.xml"), "--unit", "photons/s", *wrong, "-o", out],
        ["plot", image, "--unit", "photons/s", *wrong, "-o", str(tmp_path / "out.png")],
    ):
        code, _, told = run(*arguments)
        assert code == 2
        assert MICROMETRES in told
        assert told.count("\n") == 1
    assert not list(tmp_path.glob("out*"))
