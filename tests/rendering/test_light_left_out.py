"""Light that a method does not follow: its depth is in the metadata, its share is reported, and `compare` names it."""

from __future__ import annotations

import pytest
from small_scenes import ball, lens, mi, world_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.rendering.monte_carlo import depth_of

FILM = {"size": 12, "pitch": 1.2, "f_number": 2.8}
SAMPLES = {"method": "path", "spp": 512, "seed": 3}
PLACE = mi.ScalarTransform4f


def on_a_table(*more):
    """A sphere above a white table, seen from the side."""
    table = {
        "type": "rectangle",
        "to_world": PLACE().translate([0, 0, -5.5]).scale(30),
        "bsdf": {"type": "diffuse", "reflectance": 0.8},
    }
    from_above = PLACE().look_at([120, 0, 80], [0, 0, -2], [0, 0, 1])
    return world_scene(ball(), table, *more, sensor=lens(**FILM, to_world=from_above))


@pytest.fixture(scope="module")
def scene():
    return on_a_table()


@pytest.fixture(scope="module")
def images(scene):
    """By the integral, by path as it chooses its depth itself, and by path over three segments."""
    return fspt.render(scene), fspt.render(scene, **SAMPLES), fspt.render(scene, **SAMPLES, max_depth=3)


def test_the_depth_and_the_share_are_in_the_metadata(images):
    """The share is that of two renders: what three segments contain and one does not."""
    integral, straight, three = images
    assert (straight.metadata["max_depth"], three.metadata["max_depth"]) == (1, 3)
    assert "max_depth" not in integral.metadata
    truth = 1 - integral.total_power / three.total_power
    assert truth > 0.05
    for image in (integral, straight):
        share, error = (image.metadata[key] for key in ("light_left_out", "light_left_out_error"))
        assert share == pytest.approx(truth, abs=4 * error)
        assert error < 0.1 * share
    assert three.metadata["light_left_out"] == 0


def test_every_method_that_leaves_it_out_reports_it(images):
    integral, straight, three = (image.metadata.get("warnings", "") for image in images)
    assert "which Eq. 9 leaves out. Render with method path and max_depth 3 to see it" in integral
    assert "after more than max_depth = 1 segments, which are left out. Give max_depth = 3 to see it" in straight
    assert straight.startswith("shape_1 scatters or leads light on: about ")
    assert three == ""


def test_compare_names_the_light_of_one_image(images):
    """The integral is right: it was condemned at p 1e-15 for light that only Monte Carlo contained."""
    integral, straight, three = images
    found = fspt.compare(integral, three)
    assert found.light_of_one.image == "standard"
    assert found.ratio == pytest.approx(found.light_of_one.ratio, abs=4 * found.light_of_one.ratio_error)
    assert found.z_test is None
    assert found.to_dict()["light_of_one"]["share"] == integral.metadata["light_left_out"]
    assert "light  only the standard contains" in found.render_text()
    assert fspt.compare(three, integral).light_of_one.image == "calculated"
    same = fspt.compare(integral, straight)
    assert same.light_of_one is None
    assert same.z_test.p_value > 1e-3


def test_mirrors_beyond_the_longest_path_are_reported():
    """A mirror behind the sphere: one segment shows none of it, and the integral contains it."""
    mirror = {"type": "rectangle", "to_world": PLACE().translate([-8, 0, 0]).rotate([0, 1, 0], 90).scale(20)}
    scene = world_scene(ball(), mirror | {"bsdf": {"type": "conductor"}}, sensor=lens(**FILM))
    path = {"method": "path", "spp": 16}
    straight, all_of_it = fspt.render(scene, **path, max_depth=1), fspt.render(scene, **path)
    assert all_of_it.metadata["max_depth"] == 9
    assert "warnings" not in all_of_it.metadata
    truth = 1 - straight.total_power / all_of_it.total_power
    assert straight.metadata["light_left_out"] == pytest.approx(truth, abs=0.02)
    assert "shape_1" in straight.metadata["warnings"]
    assert fspt.compare(fspt.render(scene, rtol=1e-2), straight).light_of_one.image == "calculated"


@pytest.mark.parametrize(
    ("integrator", "depth"),
    [
        ({"type": "path"}, -1),
        ({"type": "path", "max_depth": 4}, 4),
        ({"type": "ptracer", "max_depth": 2}, 2),
        ({"type": "volpath", "max_depth": 5}, 5),
        ({"type": "direct"}, 2),
    ],
)
def test_depth_of_the_scenes_own_integrator(integrator, depth):
    assert depth_of(mi.load_dict(integrator)) == depth
