"""Sliders: which parameters have one, and ranges by what they set."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsuba_fspt.rendering.scene_xml import read_text, read_xml
from mitsuba_fspt.viewer.sliders import sliders_of

SCENES = Path(__file__).parents[2] / "scenes"


def sliders(text, **given):
    return {slider.name: slider for slider in sliders_of(read_text(text, given))}


@pytest.mark.parametrize("scene", sorted(SCENES.glob("*.xml")), ids=lambda path: path.stem)
def test_sliders_of_the_scenes_have_their_values_and_leave_out_size_accuracy_and_seeds(scene):
    found = sliders_of(read_xml(scene, {}))
    assert "f_number" in {slider.name for slider in found}
    for slider in found:
        assert slider.name not in ("width", "height", "rtol", "seed", "spp")
        assert slider.low <= slider.value <= slider.high
        assert slider.low < slider.high
        assert slider.step > 0
        assert slider.scale == "linear" or slider.low > 0


def test_ranges_follow_what_a_parameter_sets_and_not_its_name():
    found = sliders(
        """<scene version="3.0.0"><default name="n" value="4"/><default name="t" value="0.5"/>
        <default name="a" value="270"/><default name="w" value="64"/><default name="file" value="b.ply"/>
        <default name="unused" value="1"/><default name="here" value="$t"/>
        <integrator type="fspt_integral"><float name="rtol" value="$here"/></integrator>
        <sensor type="fspt_lens"><float name="f_number" value="$n"/><float name="magnification" value="$t"/>
        <film type="hdrfilm"><integer name="width" value="$w"/></film></sensor>
        <shape type="ply"><string name="filename" value="$file"/>
        <transform name="to_world"><rotate z="1" angle="$a"/></transform></shape></scene>"""
    )
    assert list(found) == ["n", "t", "a"]
    assert found["n"].scale == "stops"
    assert found["n"].lens
    assert (found["a"].low, found["a"].high, found["a"].unit, found["a"].lens) == (-360, 360, "°", False)
    assert (found["t"].low, found["t"].high, found["t"].scale) == (0.125, 2, "log")


def test_given_values_are_where_the_sliders_stand():
    text = (SCENES / "nylon_cylinder.xml").read_text()
    assert sliders(text, f_number="2.8")["f_number"].value == 2.8
    assert sliders(text, f_number="64")["f_number"].high == 64
    assert (sliders(text)["view"].low, sliders(text)["view"].high) == (-180, 180)


def test_shares_end_at_1_and_refractive_indices_at_that_of_air():
    tissue, rig = (
        {slider.name: (slider.low, slider.high) for slider in sliders_of(read_xml(SCENES / name, {}))}
        for name in ("nylon_cylinder_tissue.xml", "mirror_rig.xml")
    )
    assert tissue["albedo"] == rig["reflectance"] == (0, 1)
    assert tissue["int_ior"] == (1, 2)
