"""Coefficients of tissue from its composition, against published numbers written out here."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from mitsuba_fspt.optics.media import Medium
from mitsuba_fspt.runtime.errors import FluxError
from mitsuba_fspt.tissue.composition import FOLDER, PER_MM, Absorbers, absorption, reduced_scattering
from mitsuba_fspt.tissue.phantom_file import PhantomFile

# M. K. Moaveni (1970) and J. M. Schmitt, as compiled by S. Prahl: nm, 1/(cm mol/l) of HbO2 and Hb, for 66500 g/mol.
MOAVENI = ((650, 380, 3420), (700, 320, 2160), (800, 800, 920), (850, 1060, 800), (900, 1200, 880), (950, 1200, 720))
# G. M. Hale and M. R. Querry, Appl. Opt. 12, 555 (1973): nm, 1/cm.
HALE_QUERRY = ((650, 0.0032), (700, 0.006), (750, 0.026), (800, 0.02), (850, 0.043), (900, 0.068), (970, 0.45))


@pytest.mark.parametrize(("nm", "oxy", "deoxy"), [(600, 3200, 14677.2), (650, 368, 3750.12), (800, 816, 761.72)])
def test_absorption_of_whole_blood(nm: float, oxy: float, deoxy: float) -> None:
    """Prahl's own formula for his table: µa [1/cm] = 2.303 ε · 150 g/l / (64500 g/mol). Seen to fail without ln 10."""
    for saturation, extinction in ((1, oxy), (0, deoxy), (0.7, 0.7 * oxy + 0.3 * deoxy)):
        expected = 2.303 * extinction * 150 / 64500 / 10
        assert Absorbers(blood=1, saturation=saturation).mua(nm) == pytest.approx(expected, rel=3e-4)
        assert Absorbers(blood=0.02, saturation=saturation).mua(nm) == pytest.approx(0.02 * expected, rel=3e-4)


def test_isosbestic_point() -> None:
    """Oxy- and deoxyhaemoglobin absorb alike once between 780 and 820 nm, at 797 nm in this table."""
    nm = np.arange(780, 821)
    difference = np.array([absorption("oxyhaemoglobin", x) - absorption("deoxyhaemoglobin", x) for x in nm])
    assert nm[difference < 0].max() == 796
    assert nm[difference > 0].min() == 797


def test_tables_against_other_measurements() -> None:
    """Another pair of haemoglobin spectra and another water spectrum, whose differences docs/phantom-file.md states."""
    for nm, oxy, deoxy in MOAVENI:
        factor = math.log(10) * 150 / 66500 / 10
        assert absorption("oxyhaemoglobin", nm) == pytest.approx(factor * oxy, rel=0.08)
        assert absorption("deoxyhaemoglobin", nm) == pytest.approx(factor * deoxy, rel=0.17)
    for nm, water in HALE_QUERRY:
        assert absorption("water", nm) == pytest.approx(water / 10, rel=0.025)


def test_water_and_fat() -> None:
    """Rows of the tables: Segelstein 0.43851 /cm at 980 nm, van Veen et al. 13.10 /m at 930 nm, 1.278 /m at 760 nm."""
    assert absorption("water", 980) == pytest.approx(0.043851)
    assert absorption("fat", 930) == pytest.approx(0.01310)
    assert Absorbers(water=0.5, fat=0.25).mua(760) == pytest.approx(0.5 * 0.0026114 + 0.25 * 0.001278)


def test_tables_state_their_source() -> None:
    for name in PER_MM:
        text = (FOLDER / f"{name}.csv").read_text(encoding="utf-8")
        assert "# Source: " in text
        nm = np.loadtxt(text.splitlines()[text.count("#") + 1 :], delimiter=",")[:, 0]
        assert nm[0] == 450
        assert nm[-1] == 1000
        assert np.diff(nm).max() <= 10


def test_power_law_of_scattering() -> None:
    """µs' at 1200 nm is a half of that at 600 nm to the power b = 1, a quarter for b = 2."""
    assert reduced_scattering(1.2, 1.4, 600) == 1.2
    assert reduced_scattering(1.2, 1, 1200) == pytest.approx(0.6)
    assert reduced_scattering(1.2, 2, 1200) == pytest.approx(0.3)
    assert reduced_scattering(1.2, 1.4, 500) == pytest.approx(1.2 * 1.2**1.4)


PHANTOM = """
[geometry]
shape = "cylinder"
radius = 6
height = 8
[optical]
mua = 0.05
musp = 1
[[regions]]
shape = "sphere"
centre = [-3, 0, 0]
radius = 2
mua = 0.3
musp = 1
[bands.red]
share = 0.25
wavelength_nm = 650
blood = 0.02
saturation = 0.7
water = 0.6
fat = 0.1
scattering = 1.1
scattering_power = 1.3
[[bands.red.regions]]
mua = 0.2
scattering = 0.8
scattering_power = 0
n = 1.4
"""


def described(tmp_path: Path, text: str) -> PhantomFile:
    (tmp_path / "phantom.toml").write_text(text, encoding="utf-8")
    return PhantomFile.read(tmp_path / "phantom.toml")


def test_band_of_a_phantom_file(tmp_path: Path) -> None:
    """A band with a composition is the band with the numbers that were computed by hand from the published rows."""
    blood = 0.7 * 368 + 0.3 * 3750.12
    mua = 0.02 * math.log(10) * blood * 150 / 64500 / 10 + 0.6 * 0.00032358 + 0.1 * 0.000471
    musp = 1.1 * (650 / 600) ** -1.3
    numbers = PHANTOM.partition("[bands.red]")[0] + (
        f"[bands.red]\nshare = 0.25\nmua = {mua!r}\nmusp = {musp!r}\n"
        "[[bands.red.regions]]\nmua = 0.2\nmusp = 0.8\nn = 1.4\n"
    )
    found, expected = (described(tmp_path, text).bands["red"] for text in (PHANTOM, numbers))
    assert found.share == expected.share
    assert (found.wavelength_nm, expected.wavelength_nm) == (650, None)
    assert expected.media[0] == Medium(mua, musp, 1.37)
    assert found.media[1] == expected.media[1]
    for name in ("mua", "musp", "n"):
        assert getattr(found.media[0], name) == pytest.approx(getattr(expected.media[0], name), rel=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("blood = 0.02", "blood = 1.02", r"\[red\]: 'blood' must be in \[0, 1\], got 1.02"),
        ("water = 0.6", "water = -0.1", r"'water' must be in \[0, 1\], got -0.1"),
        ("saturation = 0.7", "saturation = 70", r"'saturation' must be in \[0, 1\], got 70"),
        ("saturation = 0.7", "", "'saturation' is missing"),
        ("fat = 0.1", "fat = 0.5", "'water' . 'fat' must be at most 1, got 1.1"),
        ("wavelength_nm = 650", "wavelength_nm = 1010", r"must be in 450 … 1000 .* oxyhaemoglobin, got 1010"),
        ("wavelength_nm = 650", "wavelength_nm = 0.65", r"'wavelength_nm' must be in 200 … 2500 nm, got 0.65"),
        ("wavelength_nm = 650", "", "'blood' needs 'wavelength_nm'"),
        ("blood = 0.02", "blood = 0.02\nmua = 0.1", "'mua' and 'blood' exclude each other"),
        ("scattering = 1.1", "scattering = 1.1\nmusp = 1", "'musp' and 'scattering' exclude each other"),
        ("scattering = 1.1", "scattering = 0", "'scattering' must be > 0 and finite, got 0"),
        ("scattering_power = 1.3", "scattering_power = -1", r"'scattering_power' must be in \[0, 4\], got -1"),
        ("scattering_power = 1.3", "", r"'scattering_power' is missing"),
        ("blood = 0.02", "", "'saturation' means nothing here"),
        ("fat = 0.1", "lipid = 0.1", "'lipid' means nothing here"),
        ("fat = 0.1", 'fat = "much"', "'fat' must be a number"),
        ("mua = 0.2\nscattering = 0.8", "blood = 2\nscattering = 0.8", r"regions\]\] number 1: 'blood' must be in"),
    ],
)
def test_bad_composition(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in PHANTOM
    with pytest.raises(FluxError, match=words) as caught:
        described(tmp_path, PHANTOM.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_unknown_absorber() -> None:
    with pytest.raises(FluxError, match="absorber 'melanin' is unknown"):
        absorption("melanin", 600)
