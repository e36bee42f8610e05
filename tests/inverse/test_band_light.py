"""Images of another light than their band's, or of several lights in one fit, are told in one line."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse import calibrate
from mitsuba_fspt.inverse.band_light import light_notes, light_of_images, tell_bands
from mitsuba_fspt.runtime.errors import InversionError

STATED = {"red": 650.0, "green": 560.0, "blue": None}
UNKNOWN = math.nan


def image(**metadata):
    return fspt.Image(np.ones((2, 2)), metadata=metadata)


@pytest.mark.parametrize(
    ("lights", "words"),
    [
        ({"red": 650.0, "green": 560.0}, None),
        ({"red": 663.0, "green": 552.0, "blue": 480.0}, None),
        ({"red": UNKNOWN, "green": UNKNOWN}, None),
        ({None: 500.0}, None),
        ({"blue": 650.0}, None),  # the file does not name its light
        ({"red": 560.0, "green": 650.0}, "'red' have light of 560 nm, that of band 'green' rather than its own, 650"),
        ({"green": 650.0}, "'green' have light of 650 nm, that of band 'red' rather than its own, 560"),
        ({"red": 650.0, "blue": 650.0}, "'red' have light of 650 nm, as have those of band 'blue'"),
        ({"red": 700.0}, "'red' have light of 700 nm, the phantom file has 650 nm for it"),
    ],
)
def test_images_of_another_band_are_told(lights, words, caplog):
    """Rationale: images of two bands in exchange were located with each other's coefficients, without a word.

    A filter's mean wavelength may be some nm beside the band's own, and a file need not name any.
    """
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        tell_bands("locate", lights, STATED)
    assert len(caplog.records) == (words is not None)
    assert (words or "") in caplog.text


@pytest.mark.parametrize(("other", "told"), [(660.0, 0), (660.4, 0), (None, 0), (560.0, 1)])
def test_images_of_several_lights_in_one_fit_are_told(other, told, caplog):
    second = {} if other is None else {"wavelength_nm": other}
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        found = light_of_images([image(wavelength_nm=660.0), image(**second)], "invert")
    assert caplog.text.count("images of one fit are of different light, 560 and 660 nm") == told
    assert found == pytest.approx(610.0 if told else 660.0, abs=0.5)


def test_light_that_is_none_is_refused_and_may_be_missing():
    assert math.isnan(light_of_images([image(), image()], "invert"))
    with pytest.raises(InversionError, match="invert: image 0: 'spectrum' of its metadata is damaged"):
        light_of_images([image(spectrum="abc")], "invert")


SPECTRUM = "[[540, 0], [560, 1], [580, 0]]"


@pytest.mark.parametrize(
    ("lens", "light", "told"),
    [
        ({"wavelength_nm": 560.0}, {"wavelength_nm": 660.0}, True),
        ({"wavelength_nm": 560.0}, {"wavelength_nm": 568.0}, False),
        ({"spectrum": SPECTRUM}, {"wavelength_nm": 560.0}, False),
        ({"spectrum": SPECTRUM}, {"wavelength_nm": 600.0}, True),
        ({"wavelength_nm": 560.0}, {}, False),
        ({}, {"wavelength_nm": 660.0}, False),
    ],
)
def test_the_light_of_a_lens_with_a_filter_is_that_of_its_images(lens, light, told, caplog):
    """Rationale: of a filter with 0.38 at 560 and 0.68 at 660 nm, J_n came out 1.8 times too large without a word."""
    notes = light_notes(1, light, lens | {"transmittance": 0.38})
    assert len(notes) == told
    known = {"pixel_pitch": 0.5, **lens, "transmittance": 0.38}
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        rendered = fspt.Image(np.ones((4, 4)), metadata=known)
        given = fspt.Image(np.ones((4, 4)), np.ones((4, 4)), metadata={"pixel_pitch": 0.5, **light})
        calibrate.measured_of([given], [{}], [rendered], 1)
    assert caplog.text.count("the lens of its view 560 nm, for which it has the transmittance 0.38") == told
