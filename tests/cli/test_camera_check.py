"""`fspt camera check`: the numbers of a camera file against closed forms."""

from __future__ import annotations

import json
import math

import pytest

CAMERA = """[lens]
focal_length = 50
f_number = 1.4
pixel_pitch = 0.013
width = 1024
height = 1024
pupil_magnification = 0.8
distortion = "-0.4, 0"
transmittance = 0.81
[detector]
quantum_efficiency = 0.9
dark_current = 1e-3
read_noise = 3.5
full_well = 1e5
gain = 1.6
bias = 500
bits = 16
"""


@pytest.fixture
def camera(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA)
    return path


def test_the_numbers_are_those_of_closed_forms(run, camera):
    """t = 0.1: N_w = N (1 + t/P); the corner of a k1 distortion δ = k1 r² has cos⁴ times about 1 − 4δ of the power."""
    code, out, err = run("camera", "check", camera, "-D", "magnification=0.1", "--wavelength-nm", 660, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["working_f_number"] == pytest.approx(1.4 * (1 + 0.1 / 0.8))
    assert found["t_stop"] == pytest.approx(1.4 / 0.9)
    assert found["scale"] == pytest.approx(0.13)
    assert found["field_of_view"] == pytest.approx([133.12, 133.12])
    assert found["focus_distance"] == pytest.approx(550)
    assert found["airy_radius"] == pytest.approx(1.22 * 660e-6 * 1.4 * (1 + 0.1 / 0.8))
    slope = math.hypot(66.56, 66.56) / (50 * (1 + 0.1 / 0.8) / 0.1)
    assert found["corner_distortion"] == pytest.approx(-0.4 * slope**2)
    away = 0.4 * slope**2
    assert found["corner_illumination"] == pytest.approx((1 + slope**2) ** -2 * (1 + 4 * away), rel=0.01)
    # The pupil subtends a cone; a blur of one pixel is reached where the point's distance from the plane in focus is
    # scale · ℓ/(2 R_p ∓ scale), ℓ from the pupil.
    length, radius = 50 * (1 + 0.1 / 0.8) / 0.1, 50 / 1.4 / 2
    near, far = found["depth_of_field"]
    assert 550 - near == pytest.approx(0.13 * length / (2 * radius + 0.13), rel=1e-9)
    assert far - 550 == pytest.approx(0.13 * length / (2 * radius - 0.13), rel=1e-9)
    assert found["electrons_per_joule"] == pytest.approx(0.9 * 660e-9 / (6.62607015e-34 * 299792458), rel=1e-9)


def test_the_table_has_a_line_for_each_number(run, camera):
    code, out, err = run("camera", "check", camera, "-D", "focus_distance=550")
    assert (code, err) == (0, "")
    assert [line[:18].strip() for line in out.splitlines()] == [
        *("focus", "working f-number", "T-stop", "field of view", "scale", "depth of field", "Airy radius", "corner")
    ]


def test_vignetting_and_light_of_the_lens(run, camera, tmp_path):
    """Shares of the corner multiply its illumination; electrons are those of the light behind the filters."""
    (tmp_path / "v.csv").write_text("0,1\n20,0.6\n")
    (tmp_path / "band.csv").write_text("600,1\n700,1\n")
    (tmp_path / "filter.csv").write_text("500,0\n700,0.8\n")
    plain = json.loads(run("camera", "check", camera, "-D", "magnification=0.1", "--json")[1])
    more = 'vignetting = "v.csv"\nspectrum = "band.csv"\ntransmittance_curve = "filter.csv"\n'
    camera.write_text(CAMERA.replace("transmittance = 0.81\n", more))
    code, out, err = run("camera", "check", camera, "-D", "magnification=0.1", "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    corner = math.hypot(511.5, 511.5) * 0.013
    share = (1 - 0.02 * corner) / (1 - 0.02 * math.hypot(0.5, 0.5) * 0.013)
    assert found["corner_illumination"] / plain["corner_illumination"] == pytest.approx(share, rel=1e-4)
    assert found["t_stop"] == pytest.approx(1.4 / math.sqrt(0.6))  # the mean of the curve over the band
    mean = (700**3 - 600**3) / 3 - 500 * (700**2 - 600**2) / 2
    mean /= (700**2 - 600**2) / 2 - 500 * 100
    assert found["electrons_per_joule"] == pytest.approx(0.9 * mean * 1e-9 / (6.62607015e-34 * 299792458), rel=1e-6)
    code, out, err = run("camera", "check", camera, "-D", "magnification=0.1", "--wavelength-nm", 660)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "but the lens is for" in err


@pytest.mark.parametrize(
    ("define", "message"),
    [
        ((), "exactly one of 'focus_distance', 'magnification', 'image_distance' sets the focus"),
        (("magnification=0.1", "lens_diameter=40"), "exclude each other"),
        (("magnification=0.1", "distortion=-40, 0"), "folds the image at a radius of"),
        (("magnification=0.1", "aperture=3"), "'aperture' is no parameter of a lens"),
        (("magnification=0.1", "transmittance=1.2"), "'transmittance' must be > 0 and at most 1"),
    ],
)
def test_what_contradicts_itself_is_refused_in_one_line(run, camera, define, message):
    code, out, err = run("camera", "check", camera, *(word for text in define for word in ("-D", text)))
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
