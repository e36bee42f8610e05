"""A scene that changes in place gives the images of scenes that are loaded."""

from __future__ import annotations

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.rendering.live_scene import LiveScene
from mitsuba_fspt.runtime.errors import SceneError

SCENE = """<scene version="3.0.0">
    <default name="f_number" value="4"/> <default name="distance" value="160"/> <default name="turn" value="0"/>
    <default name="aside" value="0"/> <default name="lift" value="0"/>
    <integrator type="fspt_integral"/>
    <sensor type="fspt_lens">
        <float name="focal_length" value="50"/> <float name="f_number" value="$f_number"/>
        <float name="focus_distance" value="150"/> <float name="pixel_pitch" value="0.5"/>
        <float name="lens_diameter" value="20"/>
        <transform name="to_world"><lookat origin="$distance, 0, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film>
    </sensor>
    <shape type="cube" id="box">
        <transform name="to_world"><scale x="4" y="3" z="2"/><rotate z="1" angle="$turn"/>
            <translate z="$lift"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="2"/></emitter>
    </shape>
    <shape type="sphere" id="bead">
        <float name="radius" value="1"/> <point name="center" x="2" y="5" z="0"/>
        <transform name="to_world"><rotate z="1" angle="$turn"/><translate y="$aside"/></transform>
        <emitter type="fspt_surface"><float name="exitance" value="1"/></emitter>
    </shape>
</scene>"""
SMALL = SCENE.replace('"32"', '"16"').replace('"24"', '"12"').replace('value="0.5"', 'value="1"')  # the same field
# For comparisons to the bit, which any accuracy serves.
AT_1_PERCENT = '"fspt_integral"><float name="rtol" value="0.01"/></integrator>'
COARSE = SMALL.replace('"fspt_integral"/>', AT_1_PERCENT)


LENS = {"focal_length": 50.0, "f_number": 4.0, "focus_distance": 150.0, "pixel_pitch": 0.5}


@pytest.fixture(scope="module")
def coarse(mono):
    return LiveScene(COARSE, {})


def test_lens_numbers_and_placement_change_in_place_to_the_bit(coarse):
    coarse.image({})
    loads = coarse.loads
    for values in ({"f_number": 2.8}, {"f_number": "8", "distance": 170}, {}):
        image, loaded = coarse.image(values), fspt.render(fspt.load(COARSE, **values))
        for plane in ("power", "error", "coverage"):
            assert np.array_equal(getattr(image, plane), getattr(loaded, plane))
        assert {k: image.metadata[k] for k in ("parameters", "scene", "f_number")} == {
            k: loaded.metadata[k] for k in ("parameters", "scene", "f_number")
        }
    assert coarse.loads == loads


def test_a_draft_of_a_turned_phantom_loads_nothing_and_the_image_is_that_of_the_loaded_scene(coarse):
    """The lens that turns the other way sees the same; a turn the same way would be off by half the peak."""
    coarse.image({})
    loads, wanted = coarse.loads, fspt.render(fspt.load(COARSE, turn=25))
    draft = coarse.draft({"turn": 25}, rtol=1e-2, max_nodes=200_000)
    assert coarse.loads == loads
    assert np.abs(draft.power - wanted.power).max() <= 2e-2 * wanted.power.max()
    assert np.array_equal(coarse.image({"turn": 25}).power, wanted.power)
    assert coarse.loads == loads + 1


def test_the_draft_of_a_monte_carlo_is_one_of_few_samples(mono):
    live = LiveScene(SCENE.replace('"fspt_integral"', '"path"'))
    draft, image = live.draft({}), live.image({})
    assert [draft.metadata["method"], image.metadata["method"]] == ["path", "path"]
    assert draft.metadata["spp"] < image.metadata["spp"] / 10
    assert draft.power.sum() == pytest.approx(image.power.sum(), rel=0.05)


def test_shapes_that_move_alone_are_moved_in_place_and_the_image_is_that_of_the_loaded_scene(coarse):
    """Mesh and sphere, one after the other and back; a shape left where it was would be off by its own radiance."""
    coarse.image({})
    loads = coarse.loads
    for values in ({"aside": 3}, {"lift": 1.5, "aside": -2}, {"lift": 1.5, "turn": 20}, {}):
        draft = coarse.draft(values, rtol=1e-2, max_nodes=200_000)
        wanted = fspt.render(fspt.load(COARSE, **values))
        assert np.abs(draft.power - wanted.power).max() <= 2e-2 * wanted.power.max()
    assert coarse.loads == loads
    assert np.array_equal(coarse.image(values).power, wanted.power)


def test_a_mesh_file_that_changed_is_loaded_again(mono, tmp_path):
    """Half the size, a quarter of the power: the silhouette's area counts."""
    path = tmp_path / "body.obj"
    faces = "f 1 2 3\nf 1 3 4\n"

    def write(side):
        corners = [(0, -side, -side), (0, side, -side), (0, side, side), (0, -side, side)]
        path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + faces)

    write(4)
    start = SCENE.index('    <shape type="cube"')
    live = LiveScene(
        SCENE[:start]
        + f"""<shape type="obj"><string name="filename" value="{path}"/><boolean name="face_normals" value="true"/>
        <emitter type="fspt_surface"><float name="exitance" value="2"/></emitter></shape></scene>""".replace("\\", "/")
    )
    before = live.image({}).power.sum()
    write(2)
    assert live.image({}).power.sum() == pytest.approx(before / 4, rel=0.01)
    assert live.loads == 2


def test_a_lens_that_cannot_be_leaves_a_usable_scene(coarse):
    good = coarse.image({}).power
    for values, model, word in (
        ({"f_number": -1}, None, "f_number"),
        ({}, "none", "model"),
        ({"turn": "x"}, None, "turn"),
    ):
        with pytest.raises(fspt.FsptError, match=word):
            coarse.image(values, model)
        assert np.array_equal(coarse.image({}).power, good)


def test_a_lens_with_times_of_a_shutter(mono):
    """Mitsuba's sensors have them; they are no numbers of the lens. Seen to fail with a KeyError."""
    text = SMALL.replace("<film", '<float name="shutter_open" value="0"/> <film')
    live = LiveScene(text)
    for distance in (160, 170):
        assert live.scene({"distance": distance}).sensors()[0].camera.centre[0] == distance
    assert live.loads == 1


def test_a_sensor_that_is_no_whole_number_is_refused():
    with pytest.raises(SceneError, match=r"scene: 'sensor' must be a whole number, got 0\.5\b"):
        LiveScene(SMALL, sensor=0.5)


def test_another_model_of_the_lens(coarse):
    changed = COARSE.replace('"fspt_lens">', '"fspt_lens"><string name="model" value="hrrt"/>')
    wanted = fspt.render(fspt.load(changed)).power
    assert np.array_equal(coarse.image({}, "hrrt").power, wanted)
    assert not np.array_equal(coarse.image({}).power, wanted)


def test_the_surface_point_of_a_pixel(mono):
    """The line of sight on the axis meets the box at x = 4, 156 mm from the lens; focused there the disc is a point."""
    live = LiveScene(SCENE, {})
    place = live.surface_point({}, None, 16, 12)
    assert place.shape == "box"
    assert place.exitance == pytest.approx(2)
    assert place.position[0] == pytest.approx(4, abs=1e-4)
    assert place.depth == pytest.approx(156, abs=1e-3)
    # R_b = (D/2) |u - z|/z · v/(u p) with v = 75: thin lens, f/4.
    assert place.radius == pytest.approx(6.25 * 6 / 156 * 75 / 150 / 0.5, rel=1e-4)
    assert (place.column, place.row) == pytest.approx((16.5, 12.5), abs=0.05)
    assert live.surface_point({}, None, 0, 0) is None


def test_the_surface_point_behind_a_mirror_and_a_pane(mono):
    """Mirror on the axis at x = 100, at 45 degrees; box with its face at y = 36: seen at 60 + 36 mm from x = 160."""
    before = SCENE.replace(
        '<shape type="cube" id="box">',
        """<shape type="rectangle" id="mirror"><bsdf type="twosided"><bsdf type="conductor"/></bsdf>
            <transform name="to_world"><lookat origin="100, 0, 0" target="110, 10, 0" up="0, 0, 1"/></transform></shape>
        <shape type="rectangle" id="pane"><bsdf type="thindielectric"/>
            <transform name="to_world"><scale value="20"/><rotate x="1" angle="90"/>
            <translate x="100" y="20"/></transform></shape>
        <shape type="cube" id="box">""",
    )
    turned = before.replace('z="2"/><rotate z="1" angle="$turn"/>', 'z="2"/><translate x="100" y="39"/>')
    place = LiveScene(turned).surface_point({}, None, 16, 12)
    assert (place.shape, place.by_way_of, place.exitance) == ("box", ("mirror", "pane"), pytest.approx(2))
    assert place.position[1] == pytest.approx(36, abs=1e-4)
    assert place.depth == pytest.approx(96, abs=1e-3)
    # The disc of a point of the virtual detector plane that the straight line of sight would meet at this depth.
    assert place.radius == pytest.approx(6.25 * 54 / 96 * 75 / 150 / 0.5, rel=1e-4)
    assert (place.column, place.row) == pytest.approx((16.5, 12.5), abs=0.05)


def test_the_second_of_two_lenses(mono):
    """Each lens changes in place, as if it were the only one."""
    one = SCENE.replace('"fspt_integral"/>', AT_1_PERCENT)
    first = one[one.index("    <sensor") : one.index("    <shape")]
    other = first.replace('"50"', '"35"').replace("$distance, 0, 0", "0, $distance, 0").replace('"32"', '"20"')
    two = one.replace(first, first + other)
    live = LiveScene(two, sensor=1)
    for values in ({}, {"f_number": 8, "distance": 170}):
        wanted = fspt.render(fspt.load(two, **values), sensor=1)
        assert np.array_equal(live.image(values).power, wanted.power)
        assert live.draft(values).power.sum() == pytest.approx(wanted.power.sum(), rel=0.05, abs=0)
    assert live.loads == 1
    assert live.surface_point({}, None, 10, 12).position[1] == pytest.approx(3, abs=1e-3)
    with pytest.raises(fspt.FsptError, match="sensor 2 does not exist, the scene has 2"):
        LiveScene(two, sensor=2).image({})


def test_a_loaded_scene_is_taken_with_its_values_unless_it_was_changed(mono):
    scene = fspt.load(COARSE, f_number=8)
    live = LiveScene(scene)
    assert np.array_equal(live.image({}).power, fspt.render(scene).power)
    parameters = mono.traverse(scene)
    parameters["box.emitter.exitance.value"] = 3.0
    parameters.update()
    with pytest.raises(fspt.FsptError, match=r"'box.emitter.exitance.value' was changed"):
        LiveScene(scene)


def test_what_was_not_loaded_from_a_file_or_text_is_refused(mono):
    for scene in (fspt.load({"type": "scene", "lens": {"type": "fspt_lens", **LENS}}), 3):
        with pytest.raises(fspt.FsptError, match="to change it, it must be a file"):
            LiveScene(scene)
