"""Emission spectra of dyes: light that the rest of the package takes, against numbers of the sources."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_fspt.optics.dye_spectra import FOLDER, dye_spectrum
from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.runtime.errors import ImageError

# nm, counts over those of the maximum, of rows of the sources on both sides of it.
EOSIN_Y = ((520, 4.7412e6 / 2.0586e7), (543, 1), (580, 9.9831e6 / 2.0586e7), (650, 1.2595e6 / 2.0586e7))
RHODAMINE_6G = ((540.05, 13479 / 33857), (559.99, 1), (599.95, 11022 / 33857), (650, 1599 / 33857))


@pytest.mark.parametrize(("dye", "rows", "mean"), [("eosin_y", EOSIN_Y, 566.2), ("rhodamine_6g", RHODAMINE_6G, 574.3)])
def test_dye_is_light(dye: str, rows: tuple[tuple[float, float], ...], mean: float) -> None:
    """A file is a `spectrum`; its rows are those of the source within 1 %. Seen to fail with rows shifted by 5 nm."""
    light = Light.given(spectrum=dye_spectrum(dye))
    assert light is not None
    assert light.spectrum is not None
    assert light.mean_wavelength_nm == pytest.approx(mean, abs=0.1)
    assert light.spectrum.values.max() == 1
    for nm, share in rows:
        assert light.spectrum.on(np.array([nm]))[0] == pytest.approx(share, rel=0.01)


def test_files_state_their_source() -> None:
    files = sorted(FOLDER.iterdir())
    assert [path.name for path in files] == ["eosin_y.csv", "rhodamine_6g.csv"]
    for path in files:
        text = path.read_text(encoding="utf-8")
        assert "# Source: " in text
        assert "Thinned" in text


def test_unknown_dye() -> None:
    with pytest.raises(ImageError, match=r"dye 'luciferin' is unknown\. Give one of eosin_y, rhodamine_6g"):
        dye_spectrum("luciferin")
