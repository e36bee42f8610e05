"""What a method does not treat in a scene is reported in the metadata and in one line on stderr."""

from __future__ import annotations

import pytest
from small_scenes import ball, lens, mi, world_scene, write_scene

import mitsuba_fspt as fspt

ABSORBING = {"type": "homogeneous", "sigma_t": 0.05, "albedo": 0.0}
MEDIUM = "borders on a participating medium: this method neither absorbs nor scatters light in it"
SMALL = {"size": 8, "pitch": 1.8}


def box(**more):
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale(12), "bsdf": {"type": "null"}, **more}


def told(scene, **settings):
    """The warnings of an image by this method, "" without any."""
    return fspt.render(scene, **settings).metadata.get("warnings", "")


@pytest.mark.parametrize("settings", [{}, {"method": "path", "spp": 4}])
@pytest.mark.parametrize("side", ["interior", "exterior"])
def test_a_medium_is_reported(side, settings):
    scene = world_scene(ball(), box(**{side: ABSORBING}), sensor=lens(**SMALL))
    assert f"shape_1 {MEDIUM}" in told(scene, **settings)
    assert MEDIUM not in told(world_scene(ball(), box(), sensor=lens(**SMALL)), **settings)


def test_a_medium_around_the_lens_is_reported():
    assert f"camera {MEDIUM}" in told(world_scene(ball(), sensor=lens(**SMALL, medium=ABSORBING)))


def test_volpath_treats_media():
    scene = world_scene(ball(), box(interior=ABSORBING), sensor=lens(**SMALL), integrator={"type": "volpath"})
    assert told(scene, spp=4) == ""


def test_a_medium_is_reported_on_stderr(run, tmp_path):
    slab = """
    <shape type="cube" id="fog">
        <transform name="to_world"><scale value="12"/></transform>
        <bsdf type="null"/>
        <medium type="homogeneous" name="interior"><float name="albedo" value="0"/></medium>
    </shape>"""
    output = tmp_path / "o.exr"
    code, _, warned = run("render", write_scene(tmp_path / "s.xml", more=slab), "-o", output)
    assert code == 0
    assert warned.startswith(f"fspt: {output}: fog {MEDIUM}")
    assert warned.count("\n") == 1


def test_a_blend_of_mirror_and_white_is_reported():
    """Mitsuba divides a mirror's light by the density of the scattering part: at half and half it loses up to 24 %."""
    mirror = {"type": "conductor"}
    rectangle = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 9, 0])}
    scenes = (
        world_scene(ball(), rectangle | {"bsdf": {"type": "blendbsdf", "weight": 0.5, **parts}}, sensor=lens(**SMALL))
        for parts in ({"a": mirror, "b": {"type": "diffuse"}}, {"a": mirror, "b": {"type": "null"}})
    )
    mixed, pure = (told(scene, method="path", spp=4) for scene in scenes)
    assert "shape_1 blends a specular and a scattering part" in mixed
    assert pure == ""


@pytest.mark.parametrize("bsdf", [{"type": "null"}, {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}])
def test_a_glowing_surface_that_lets_light_pass_is_reported_for_path(bsdf):
    """The integral takes J_n as it is, Mitsuba's path dims it by the share that passes."""
    scene, bare = (world_scene(ball() | more, sensor=lens(**SMALL)) for more in ({"bsdf": bsdf}, {}))
    assert "shape_0 glows and lets light pass" in told(scene, method="path", spp=4)
    assert told(scene) == ""
    assert fspt.render(scene).power == pytest.approx(fspt.render(bare).power, rel=1e-3)


@pytest.mark.parametrize("settings", [{"rtol": 0.1}, {"method": "path", "spp": 4}])
def test_diffraction_is_reported_from_one_pixel_on(settings):
    """On pixels of 1.8 mm, 1.22 · 600 nm · N · 1.5 is one pixel at f/1639."""
    for f_number, pixels in ((1600, 0.976), (1700, 1.037)):
        image = fspt.render(world_scene(ball(), sensor=lens(**SMALL, f_number=f_number)), **settings)
        assert image.metadata["airy_radius"] / 1.8 == pytest.approx(pixels, rel=1e-3)
        line = "at f/1700 the Airy disc has a radius of 1.04 pixels (1.87 mm on the film at 600 nm)"
        assert (line in image.metadata.get("warnings", "")) == (pixels > 1)


def test_explain_has_the_airy_radius_at_the_wavelength_of_the_filter(tmp_path):
    (tmp_path / "filter.csv").write_text("500,0.2\n700,0.5\n")
    light = {"transmittance_curve": str(tmp_path / "filter.csv"), "wavelength_nm": 660.0}
    rows = {row.what: row.why for row in fspt.explain(world_scene(ball(), sensor=lens(**SMALL, **light)), rtol=0.1)}
    assert rows["diffraction"] == "Airy radius 0.0097 mm on the film, 0.0054 pixels, at 660 nm"
