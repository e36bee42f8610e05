"""The transmittance of a lens: a number or a curve, and what neither can be."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mitsuba_fspt.optics.transmittance import Curve, t_stop, transmittance_of
from mitsuba_fspt.runtime.errors import OpticsError

ROWS = "500,0.2\n600,0.8\n700,0.5\n"


def curve(folder, text):
    (folder / "filter.csv").write_text(text)
    return Curve.read(folder / "filter.csv")


@pytest.mark.parametrize(
    "text", [ROWS, "nm,T\n" + ROWS, "# a filter\n" + ROWS, "700,0.5\n500,0.2\n\n600,0.8 # peak\n", "\ufeff" + ROWS]
)
def test_linear_between_the_rows(tmp_path, text):
    """By hand: 0.2 + 0.6 · 30/100 = 0.38, 0.8 − 0.3 · 60/100 = 0.62, and the rows themselves, the ends included."""
    found = curve(tmp_path, text)
    assert [found.at(nm) for nm in (500, 530, 600, 660, 700)] == pytest.approx([0.2, 0.38, 0.8, 0.62, 0.5], rel=1e-14)


@pytest.mark.parametrize("nm", [499.999, 700.001, 0, np.nan, np.inf])
def test_no_value_beyond_the_curve(tmp_path, nm):
    """A guess there would be a wrong number without a word."""
    with pytest.raises(OpticsError, match=rf"'wavelength_nm' = {nm:g} is outside '.*filter\.csv', which has 500 … 700"):
        curve(tmp_path, ROWS).at(nm)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no columns, must have 2"),
        ("nm,T\n", "has no columns, must have 2"),
        ("500\n600\n", "has 1 columns, must have 2"),
        ("500,0.2,1\n", "has 3 columns, must have 2"),
        ("500;0.2\n", "could not convert string '500;0.2'"),
        ("500,0.2\n600,dark\n", "could not convert string 'dark'"),
        ("500,20\n600,80\n", "must be in 0 … 1, got 20 at 500 nm. Divide percent by 100"),
        ("500,-0.1\n", "must be in 0 … 1, got -0.1 at 500 nm"),
        ("500,nan\n", "must be in 0 … 1, got nan at 500 nm"),
        ("0,0.1\n", "wavelengths must be > 0 nm, got 0"),
        ("0.5,0.2\n0.7,0.8\n", "are used, got 0.5 … 0.7. In µm it would be 500 nm: give that."),
        ("500,0.1\n500,0.2\n", "has 500 nm twice"),
    ],
)
def test_files_that_are_no_curve(tmp_path, text, message):
    with pytest.raises(OpticsError, match=re.escape(message)) as caught:
        curve(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_no_text(tmp_path):
    with pytest.raises(OpticsError, match=r"gone\.csv' cannot be read: No such file"):
        Curve.read(tmp_path / "gone.csv")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(OpticsError, match=r"a\.csv' is no text"):
        Curve.read(tmp_path / "a.csv")


def test_a_number_or_a_curve(tmp_path):
    assert transmittance_of({}, None) == 1
    assert transmittance_of({"transmittance": 0.9}, None) == 0.9
    assert transmittance_of({"wavelength_nm": 660.0}, curve(tmp_path, ROWS)) == pytest.approx(0.62, rel=1e-14)


@pytest.mark.parametrize(
    ("numbers", "text", "message"),
    [
        ({"transmittance": 0.0}, None, "'transmittance' must be > 0 and at most 1, got 0."),
        ({"transmittance": 1.1}, None, "'transmittance' must be > 0 and at most 1, got 1.1."),
        ({"transmittance": np.nan}, None, "'transmittance' must be > 0 and at most 1, got nan."),
        ({"wavelength_nm": 660.0}, None, "'wavelength_nm' = 660 goes with 'transmittance_curve', which is missing"),
        ({}, ROWS, "'transmittance_curve' needs 'wavelength_nm'"),
        ({"transmittance": 0.5}, ROWS, "'transmittance' = 0.5 and 'transmittance_curve' exclude each other"),
        ({"wavelength_nm": 500.0}, "500,0\n600,1\n", "must be > 0 and at most 1, got 0 at 500 nm in '"),
    ],
)
def test_invalid_transmittances(tmp_path, numbers, text, message):
    with pytest.raises(OpticsError, match=re.escape(message)):
        transmittance_of(numbers, curve(tmp_path, text) if text else None)


def test_t_stop():
    """f/2 behind a filter of 1/4 is as bright as f/4: half the diameter, a quarter of the area."""
    assert t_stop(2.0, 0.25) == 4
    assert t_stop(1.8, 1.0) == 1.8
